// Frame-to-frame motion of a folder of images, and how long each step takes.
//
//     odometry FOLDER MODEL fx,fy,cx,cy
//
// Every frame is compared with the last keyframe, which gives way where the images have moved far enough apart: between
// neighbours of a video the baseline is too short to tell a direction.

#include <mgca/filter.hpp>

#include <opencv2/core.hpp>
#if CV_VERSION_MAJOR >= 5
#include <opencv2/features.hpp>
#else
#include <opencv2/features2d.hpp>
#endif
#include <opencv2/imgcodecs.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <iomanip>
#include <iostream>
#include <string>
#include <vector>

namespace {

using Clock = std::chrono::steady_clock;

// A keyframe is replaced once its matches have moved this far, pixels, or are this few.
constexpr double kKeyframeMotion = 30.0;
constexpr int kKeyframeMatches = 60;

struct Frame {
    std::vector<cv::KeyPoint> keypoints;
    cv::Mat descriptors;
};

double milliseconds_since(Clock::time_point started) {
    return std::chrono::duration<double, std::milli>(Clock::now() - started).count();
}

double median_motion(const Frame& a, const Frame& b, const std::vector<std::vector<cv::DMatch>>& matches,
                     const mgca::Result& result) {
    std::vector<double> motions;
    for (std::size_t i = 0; i < matches.size(); ++i) {
        if (result.mask[i] != 0) {
            const cv::Point2f p = a.keypoints[static_cast<std::size_t>(matches[i][0].queryIdx)].pt;
            const cv::Point2f q = b.keypoints[static_cast<std::size_t>(matches[i][0].trainIdx)].pt;
            motions.push_back(cv::norm(p - q));
        }
    }
    if (motions.empty()) {
        return 0.0;
    }
    const auto middle = motions.begin() + static_cast<std::ptrdiff_t>(motions.size() / 2);
    std::nth_element(motions.begin(), middle, motions.end());
    return *middle;
}

int run(const std::string& folder, const std::string& model, const cv::Matx33d& K) {
    std::vector<std::filesystem::path> files;
    for (const auto& entry : std::filesystem::directory_iterator(folder)) {
        files.push_back(entry.path());
    }
    std::sort(files.begin(), files.end());

    const mgca::Filter filter(mgca::Model::from_file(model));
    const cv::Ptr<cv::ORB> detector = cv::ORB::create(1500);
    const cv::BFMatcher matcher(cv::NORM_HAMMING);
    Frame keyframe;
    double sum_features = 0.0, sum_filter = 0.0;
    int pairs = 0;
    std::cout << std::fixed << std::setprecision(1);
    for (const std::filesystem::path& file : files) {
        const cv::Mat image = cv::imread(file.string(), cv::IMREAD_GRAYSCALE);
        if (image.empty()) {
            continue;
        }
        const auto started = Clock::now();
        Frame frame;
        detector->detectAndCompute(image, cv::noArray(), frame.keypoints, frame.descriptors);
        std::vector<std::vector<cv::DMatch>> matches;
        if (!keyframe.descriptors.empty() && !frame.descriptors.empty()) {
            matcher.knnMatch(keyframe.descriptors, frame.descriptors, matches, 2);
        }
        const double features = milliseconds_since(started);
        if (keyframe.descriptors.empty()) {
            keyframe = std::move(frame);
            continue;
        }
        const auto filtering = Clock::now();
        const mgca::Result result = filter(keyframe.keypoints, frame.keypoints, matches, K);
        const double filtered = milliseconds_since(filtering);
        ++pairs;
        sum_features += features;
        sum_filter += filtered;
        std::cout << file.filename().string() << "  " << mgca::to_string(result.status) << "  " << result.num_inliers
                  << " of " << result.mask.size() << "  features and matching " << features << " ms, filter " << filtered
                  << " ms";
        if (result.R) {
            const double cosine = std::clamp((cv::trace(*result.R) - 1.0) / 2.0, -1.0, 1.0);
            std::cout << "  turn " << std::acos(cosine) * 180.0 / CV_PI << " degrees";
        }
        if (result.t) {
            std::cout << std::setprecision(2) << "  direction " << (*result.t)[0] << " " << (*result.t)[1] << " "
                      << (*result.t)[2] << std::setprecision(1);
        }
        std::cout << "\n";
        if (result.num_inliers < kKeyframeMatches ||
            median_motion(keyframe, frame, matches, result) > kKeyframeMotion) {
            keyframe = std::move(frame);
        }
    }
    if (pairs == 0) {
        std::cerr << folder << ": fewer than two readable images\n";
        return 1;
    }
    std::cout << pairs << " pairs: features and matching " << sum_features / pairs << " ms, filter "
              << sum_filter / pairs << " ms per frame\n";
    return 0;
}

}  // namespace

int main(int argc, char** argv) {
    double fx = 0.0, fy = 0.0, cx = 0.0, cy = 0.0;
    if (argc != 4 || std::sscanf(argv[3], "%lf,%lf,%lf,%lf", &fx, &fy, &cx, &cy) != 4) {
        std::cerr << "usage: odometry FOLDER MODEL fx,fy,cx,cy\n";
        return 2;
    }
    try {
        return run(argv[1], argv[2], {fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0});
    } catch (const std::exception& error) {
        std::cerr << "odometry: " << error.what() << "\n";
        return 2;
    }
}
