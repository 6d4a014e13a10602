// Frame-to-frame motion of a folder of images, and how long each step takes.
//
//     odometry FOLDER fx,fy,cx,cy [orb|flow] [MODEL [FIRST_LOOK]]
//
// orb matches ORB features, flow follows corners by optical flow from image to image. Every frame is compared with the last
// keyframe, which gives way where the images have moved far enough apart: between neighbours of a video the baseline is too
// short to tell a direction. Without MODEL the two models within the library are taken; MODEL alone is asked
// alone, which takes longer or is a little less accurate; FIRST_LOOK is a quicker one that is asked before it.

#include <mgca/filter.hpp>

#include <opencv2/core.hpp>
#if CV_VERSION_MAJOR >= 5
#include <opencv2/features.hpp>
#else
#include <opencv2/features2d.hpp>
#endif
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/tracking.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <iomanip>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

namespace {

using Clock = std::chrono::steady_clock;

constexpr int kFeatures = 1500;
// A keyframe is replaced once its matches have moved this far, pixels, or are this few.
constexpr double kKeyframeMotion = 30.0;
constexpr int kKeyframeMatches = 60;

double milliseconds_since(Clock::time_point started) {
    return std::chrono::duration<double, std::milli>(Clock::now() - started).count();
}

/// Matches between the keyframe and the last image.
struct Matched {
    mgca::Keypoints keypoints1, keypoints2;
    mgca::Matches matches;
};

/// Where matches come from.
class FrontEnd {
public:
    virtual ~FrontEnd() = default;
    /// Matches of the keyframe with this image; none before there is a keyframe.
    virtual Matched match(const cv::Mat& image) = 0;
    /// The last image is the keyframe from now on.
    virtual void renew() = 0;
};

class OrbFrontEnd : public FrontEnd {
public:
    Matched match(const cv::Mat& image) override {
        last_ = {};
        detector_->detectAndCompute(image, cv::noArray(), last_.keypoints, last_.descriptors);
        std::vector<std::vector<cv::DMatch>> matches;
        if (!keyframe_.descriptors.empty() && !last_.descriptors.empty()) {
            matcher_.knnMatch(keyframe_.descriptors, last_.descriptors, matches, 2);  // the filter reads the ratio
        }
        return {keyframe_.keypoints, last_.keypoints, matches};
    }

    void renew() override { keyframe_ = last_; }

private:
    struct Frame {
        std::vector<cv::KeyPoint> keypoints;
        cv::Mat descriptors;
    };

    cv::Ptr<cv::ORB> detector_ = cv::ORB::create(kFeatures);
    cv::BFMatcher matcher_{cv::NORM_HAMMING};
    Frame keyframe_, last_;
};

class FlowFrontEnd : public FrontEnd {
public:
    Matched match(const cv::Mat& image) override {
        if (!corners_.empty()) {
            std::vector<cv::Point2f> next;
            std::vector<unsigned char> found;
            cv::calcOpticalFlowPyrLK(last_, image, followed_, next, found, cv::noArray());
            std::vector<cv::Point2f> corners;  // those that are still seen
            followed_.clear();
            for (std::size_t i = 0; i < found.size(); ++i) {
                if (found[i] != 0) {
                    corners.push_back(corners_[i]);
                    followed_.push_back(next[i]);
                }
            }
            corners_ = std::move(corners);
        }
        last_ = image;
        return {corners_, followed_, mgca::Matches::same_rows(corners_.size())};
    }

    void renew() override {
        cv::goodFeaturesToTrack(last_, corners_, kFeatures, 0.01, 7.0);
        followed_ = corners_;
    }

private:
    cv::Mat last_;
    std::vector<cv::Point2f> corners_, followed_;  // in the keyframe, and where they are now
};

double median_motion(const Matched& matched, const mgca::Result& result) {
    std::vector<double> motions;
    for (std::size_t i = 0; i < result.mask.size(); ++i) {
        if (result.mask[i] != 0) {
            const auto row1 = static_cast<std::size_t>(matched.matches.index1[i]);
            const auto row2 = static_cast<std::size_t>(matched.matches.index2[i]);
            motions.push_back(cv::norm(matched.keypoints1.points[row1] - matched.keypoints2.points[row2]));
        }
    }
    if (motions.empty()) {
        return 0.0;
    }
    const auto middle = motions.begin() + static_cast<std::ptrdiff_t>(motions.size() / 2);
    std::nth_element(motions.begin(), middle, motions.end());
    return *middle;
}

void print_frame(const std::string& name, const mgca::Result& result, double features, double filtered) {
    std::cout << name << "  " << mgca::to_string(result.status) << "  " << result.num_inliers << " of "
              << result.mask.size() << "  features and matching " << features << " ms, filter " << filtered << " ms";
    if (result.R) {
        const double cosine = std::clamp((cv::trace(*result.R) - 1.0) / 2.0, -1.0, 1.0);
        std::cout << "  turn " << std::acos(cosine) * 180.0 / CV_PI << " degrees";
    }
    if (result.t) {
        std::cout << std::setprecision(2) << "  direction " << (*result.t)[0] << " " << (*result.t)[1] << " "
                  << (*result.t)[2] << std::setprecision(1);
    }
    std::cout << "\n";
}

int run(const std::string& folder, const cv::Matx33d& K, FrontEnd& front_end, const mgca::Filter& filter) {
    std::vector<std::filesystem::path> files;
    for (const auto& entry : std::filesystem::directory_iterator(folder)) {
        files.push_back(entry.path());
    }
    std::sort(files.begin(), files.end());

    double sum_features = 0.0, sum_filter = 0.0;
    int images = 0;
    std::cout << std::fixed << std::setprecision(1);
    for (const std::filesystem::path& file : files) {
        const cv::Mat image = cv::imread(file.string(), cv::IMREAD_GRAYSCALE);
        if (image.empty()) {
            continue;
        }
        const auto started = Clock::now();
        const Matched matched = front_end.match(image);
        const double features = milliseconds_since(started);
        if (++images == 1) {
            front_end.renew();
            continue;
        }
        const auto filtering = Clock::now();
        const mgca::Result result = filter(matched.keypoints1, matched.keypoints2, matched.matches, K);
        const double filtered = milliseconds_since(filtering);
        sum_features += features;
        sum_filter += filtered;
        print_frame(file.filename().string(), result, features, filtered);
        if (result.num_inliers < kKeyframeMatches || median_motion(matched, result) > kKeyframeMotion) {
            front_end.renew();
        }
    }
    if (images < 2) {
        std::cerr << folder << ": fewer than two readable images\n";
        return 1;
    }
    std::cout << images - 1 << " pairs: features and matching " << sum_features / (images - 1) << " ms, filter "
              << sum_filter / (images - 1) << " ms per frame\n";
    return 0;
}

}  // namespace

int main(int argc, char** argv) {
    double fx = 0.0, fy = 0.0, cx = 0.0, cy = 0.0;
    const std::string source = argc > 3 ? argv[3] : "orb";
    if (argc < 3 || argc > 6 || std::sscanf(argv[2], "%lf,%lf,%lf,%lf", &fx, &fy, &cx, &cy) != 4 ||
        (source != "orb" && source != "flow")) {
        std::cerr << "usage: odometry FOLDER fx,fy,cx,cy [orb|flow] [MODEL [FIRST_LOOK]]\n";
        return 2;
    }
    try {
        std::unique_ptr<FrontEnd> front_end;
        if (source == "flow") {
            front_end = std::make_unique<FlowFrontEnd>();
        } else {
            front_end = std::make_unique<OrbFrontEnd>();
        }
        const mgca::Model model = argc > 4 ? mgca::Model::from_file(argv[4]) : mgca::embedded_model();
        const mgca::Filter filter(argc > 5 ? model.with_first_look(mgca::Model::from_file(argv[5])) : model);
        return run(argv[1], {fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0}, *front_end, filter);
    } catch (const std::exception& error) {
        std::cerr << "odometry: " << error.what() << "\n";
        return 2;
    }
}
