// Matches two images, or reads keypoints and matches from a file, filters the matches and prints the answer as JSON.

#include "mgca_filter.hpp"

#include <opencv2/opencv.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <exception>
#include <iostream>
#include <limits>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

constexpr int kFound = 0, kNothingFound = 1, kUsage = 2;

constexpr const char* kHelp =
    "usage: mgca_match_cpp IMAGE1 IMAGE2 --model FILE --K fx,fy,cx,cy [--K2 fx,fy,cx,cy] [--threshold PX]\n"
    "       mgca_match_cpp --matches FILE --model FILE --K fx,fy,cx,cy [--K2 fx,fy,cx,cy] [--threshold PX]\n"
    "  --model      ONNX file of mgca_filter\n"
    "  --K, --K2    intrinsics in pixels; without --K2 both images share them\n"
    "  --threshold  inlier threshold of the final mask, pixels (default 1)\n"
    "  --matches    file of cv::FileStorage with keypoints1, keypoints2 (N, 4: x, y, size, angle),\n"
    "               matches (M, 2: rows of both) and distances (M, 1 or M, 2: nearest, second nearest)\n"
    "Exit status: 0 = geometry found, 1 = none, 2 = usage or error.\n";

struct Arguments {
    std::vector<std::string> images;
    std::string matches_file;
    std::string model_file;
    cv::Matx33d K1, K2;
    mgca::FilterOptions options;
};

/// Keypoints and matches of one pair; `knn_matches` is empty where only the nearest neighbours are known.
struct PutativeMatches {
    std::vector<cv::KeyPoint> keypoints1, keypoints2;
    std::vector<cv::DMatch> matches;
    std::vector<std::vector<cv::DMatch>> knn_matches;
};

std::vector<double> parse_numbers(const std::string& text, std::size_t count, const std::string& option) {
    std::vector<double> values;
    std::istringstream stream(text);
    for (std::string part; std::getline(stream, part, ',');) {
        std::istringstream number(part);
        double value = 0.0;
        if (!(number >> value) || !number.eof()) {
            throw std::invalid_argument(option + ": not a number: '" + part + "'");
        }
        values.push_back(value);
    }
    if (values.size() != count) {
        throw std::invalid_argument(option + ": expected " + std::to_string(count) + " number(s), got '" + text + "'");
    }
    return values;
}

cv::Matx33d parse_intrinsics(const std::string& text, const std::string& option) {
    const std::vector<double> k = parse_numbers(text, 4, option);
    return {k[0], 0.0, k[2], 0.0, k[1], k[3], 0.0, 0.0, 1.0};
}

Arguments parse_arguments(const std::vector<std::string>& words) {
    Arguments arguments;
    std::string K1, K2;
    for (std::size_t i = 0; i < words.size(); ++i) {
        if (words[i].rfind("--", 0) != 0) {
            arguments.images.push_back(words[i]);
            continue;
        }
        const std::string& option = words[i];
        if (++i == words.size()) {
            throw std::invalid_argument(option + ": unknown, or its value is missing");
        }
        if (option == "--model") {
            arguments.model_file = words[i];
        } else if (option == "--matches") {
            arguments.matches_file = words[i];
        } else if (option == "--K") {
            K1 = words[i];
        } else if (option == "--K2") {
            K2 = words[i];
        } else if (option == "--threshold") {
            arguments.options.threshold_px = parse_numbers(words[i], 1, option)[0];
        } else {
            throw std::invalid_argument(option + ": unknown");
        }
    }
    if (arguments.images.size() != (arguments.matches_file.empty() ? 2U : 0U)) {
        throw std::invalid_argument("expected two images, or --matches");
    }
    if (arguments.model_file.empty() || K1.empty()) {
        throw std::invalid_argument("expected --model and --K");
    }
    arguments.K1 = parse_intrinsics(K1, "--K");
    arguments.K2 = K2.empty() ? arguments.K1 : parse_intrinsics(K2, "--K2");
    return arguments;
}

/// SIFT on a grey copy of at most 1200 px; keypoints in pixels of the image. The settings of the training data.
cv::Mat detect(const std::string& file, std::vector<cv::KeyPoint>& keypoints) {
    constexpr int kMaxSide = 1200;
    const cv::Mat image = cv::imread(file, cv::IMREAD_COLOR);
    if (image.empty()) {
        throw std::runtime_error(file + ": not a readable image");
    }
    cv::Mat grey;
    cv::cvtColor(image, grey, cv::COLOR_BGR2GRAY);
    const double scale = std::min(1.0, static_cast<double>(kMaxSide) / std::max(grey.cols, grey.rows));
    if (scale < 1.0) {
        const cv::Size size(std::max(1, cvRound(grey.cols * scale)), std::max(1, cvRound(grey.rows * scale)));
        cv::resize(grey, grey, size, 0.0, 0.0, cv::INTER_AREA);
    }
    cv::Mat descriptors;
    cv::SIFT::create(2000, 3, 1e-5)->detectAndCompute(grey, cv::noArray(), keypoints, descriptors);
    if (scale < 1.0) {
        // Pixels are areas, so the half pixel at the border scales as well.
        const double scale_x = static_cast<double>(grey.cols) / image.cols;
        const double scale_y = static_cast<double>(grey.rows) / image.rows;
        for (cv::KeyPoint& keypoint : keypoints) {
            keypoint.pt.x = static_cast<float>((keypoint.pt.x + 0.5) / scale_x - 0.5);
            keypoint.pt.y = static_cast<float>((keypoint.pt.y + 0.5) / scale_y - 0.5);
            keypoint.size = static_cast<float>(keypoint.size / std::sqrt(scale_x * scale_y));
        }
    }
    return descriptors;
}

PutativeMatches match_images(const std::string& file1, const std::string& file2) {
    PutativeMatches putative;
    const cv::Mat descriptors1 = detect(file1, putative.keypoints1);
    const cv::Mat descriptors2 = detect(file2, putative.keypoints2);
    if (!descriptors1.empty() && !descriptors2.empty()) {
        cv::BFMatcher(cv::NORM_L2).knnMatch(descriptors1, descriptors2, putative.knn_matches, 2);
    }
    for (const std::vector<cv::DMatch>& candidates : putative.knn_matches) {
        putative.matches.push_back(candidates.front());
    }
    return putative;
}

/// A matrix of one of the `widths`, or an empty one.
cv::Mat read_matrix(const cv::FileStorage& storage, const std::string& name, int type, const std::set<int>& widths) {
    cv::Mat matrix;
    storage[name] >> matrix;
    if (!matrix.empty() && (matrix.channels() != 1 || widths.count(matrix.cols) == 0)) {
        throw std::runtime_error(name + ": a matrix of " + std::to_string(matrix.cols) + " columns is not expected");
    }
    matrix.convertTo(matrix, type);
    return matrix;
}

cv::FileStorage open_storage(const std::string& file) {
    try {
        cv::FileStorage storage(file, cv::FileStorage::READ);
        if (storage.isOpened()) {
            return storage;
        }
    } catch (const cv::Exception&) {  // no YAML, XML or JSON
    }
    throw std::runtime_error(file + ": not a readable file of cv::FileStorage");
}

PutativeMatches read_matches(const std::string& file) {
    const cv::FileStorage storage = open_storage(file);
    PutativeMatches putative;
    for (const auto& [name, keypoints] :
         {std::pair{"keypoints1", &putative.keypoints1}, std::pair{"keypoints2", &putative.keypoints2}}) {
        const cv::Mat values = read_matrix(storage, name, CV_32F, {4});
        for (int i = 0; i < values.rows; ++i) {
            const float* row = values.ptr<float>(i);
            keypoints->emplace_back(row[0], row[1], row[2], row[3]);
        }
    }
    const cv::Mat indices = read_matrix(storage, "matches", CV_32S, {2});
    const cv::Mat distances = read_matrix(storage, "distances", CV_32F, {1, 2});
    if (distances.rows != indices.rows) {
        throw std::runtime_error(file + ": expected as many rows of distances as of matches");
    }
    for (int i = 0; i < indices.rows; ++i) {
        const cv::DMatch nearest(indices.at<int>(i, 0), indices.at<int>(i, 1), distances.at<float>(i, 0));
        putative.matches.push_back(nearest);
        if (distances.cols == 2) {
            const cv::DMatch second(nearest.queryIdx, -1, distances.at<float>(i, 1));  // only its distance counts
            putative.knn_matches.push_back({nearest, second});
        }
    }
    return putative;
}

/// `null` stands for what JSON cannot write: NaN and infinity.
template <typename T>
std::string json(T value) {
    if (!std::isfinite(static_cast<double>(value))) {
        return "null";
    }
    std::ostringstream text;
    text.precision(std::numeric_limits<T>::max_digits10);
    text << +value;
    return text.str();
}

template <typename Iterator>
std::string json_array(Iterator begin, Iterator end) {
    std::string text = "[";
    for (Iterator item = begin; item != end; ++item) {
        text += (item == begin ? "" : ", ") + json(*item);
    }
    return text + "]";
}

std::string json_matrix(const cv::Matx33d& matrix) {
    std::string text = "[";
    for (int row = 0; row < 3; ++row) {
        text += (row == 0 ? "" : ", ") + json_array(matrix.val + 3 * row, matrix.val + 3 * row + 3);
    }
    return text + "]";
}

void print(std::ostream& out, const PutativeMatches& putative, const mgca::FilterResult& result) {
    const auto array = [&](const char* name, const auto& values) {
        out << " \"" << name << "\": " << json_array(values.begin(), values.end()) << ",\n";
    };
    out << "{\n \"opencv\": \"" << CV_VERSION << "\",\n \"runtime\": \"" << mgca::Network::runtime() << "\",\n";
    out << " \"points\": [";
    for (std::size_t i = 0; i < putative.matches.size(); ++i) {
        const cv::DMatch& match = putative.matches[i];
        const cv::Point2f p1 = putative.keypoints1[static_cast<std::size_t>(match.queryIdx)].pt;
        const cv::Point2f p2 = putative.keypoints2[static_cast<std::size_t>(match.trainIdx)].pt;
        const std::array<float, 4> points{p1.x, p1.y, p2.x, p2.y};
        out << (i == 0 ? "" : ", ") << json_array(points.begin(), points.end());
    }
    out << "],\n";
    array("scores", result.scores);
    array("logits", result.logits);
    array("network_mask", result.network_mask);
    array("mask", result.mask);
    if (result.geometry) {
        const mgca::TwoViewGeometry& geometry = *result.geometry;
        out << " \"E\": " << json_matrix(geometry.E) << ",\n \"R\": " << json_matrix(geometry.R)
            << ",\n \"t\": " << json_array(geometry.t.val, geometry.t.val + 3) << "\n}\n";
    } else {
        out << " \"E\": null,\n \"R\": null,\n \"t\": null\n}\n";
    }
}

int run(const Arguments& arguments) {
    const mgca::MgcaFilter filter(arguments.model_file, arguments.options);
    const PutativeMatches putative = arguments.images.empty()
                                         ? read_matches(arguments.matches_file)
                                         : match_images(arguments.images[0], arguments.images[1]);
    const auto filter_pair = [&](const auto& matches) {
        return filter(putative.keypoints1, putative.keypoints2, matches, arguments.K1, arguments.K2);
    };
    const mgca::FilterResult result =
        putative.knn_matches.empty() ? filter_pair(putative.matches) : filter_pair(putative.knn_matches);
    print(std::cout, putative, result);
    return result.geometry ? kFound : kNothingFound;
}

}  // namespace

int main(int argc, char** argv) {
    const std::vector<std::string> words(argv + 1, argv + argc);
    if (words.size() == 1 && words[0] == "--help") {
        std::cout << kHelp;
        return EXIT_SUCCESS;
    }
    Arguments arguments;
    try {
        arguments = parse_arguments(words);
    } catch (const std::exception& error) {
        std::cerr << "mgca_match_cpp: " << error.what() << "\n" << kHelp;
        return kUsage;
    }
    try {
        return run(arguments);
    } catch (const std::exception& error) {
        std::cerr << "mgca_match_cpp: " << error.what() << "\n";
        return kUsage;
    }
}
