// One pair of images: OpenCV's keypoints and matches to normalised coordinates and the network's attributes.

#pragma once

#include "mgca_epipolar.hpp"
#include "mgca_model.hpp"

#include <opencv2/core.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

namespace mgca {

/// One row of cv::DescriptorMatcher::knnMatch per match: the first candidate is the match, the second gives the ratio
/// of distances.
using KnnMatches = std::vector<std::vector<cv::DMatch>>;

/// The matches of one pair, in the order of the input.
struct Pair {
    std::vector<Correspondence> correspondences;  ///< Not finite where a match has no usable coordinates.
    std::vector<Attributes> attributes;
    std::vector<bool> valid;  ///< True where the coordinates are usable.
    double focal_px = 0.0;    ///< Mean focal length.
};

namespace detail {

constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();

inline void check_intrinsics(const cv::Matx33d& K, const char* name) {
    const bool finite = std::all_of(K.val, K.val + 9, [](double value) { return std::isfinite(value); });
    if (!finite || K(0, 0) <= 0.0 || K(1, 1) <= 0.0 || K(1, 0) != 0.0 || K(2, 0) != 0.0 || K(2, 1) != 0.0 ||
        K(2, 2) != 1.0) {
        throw std::invalid_argument(std::string(name) +
                                    ": expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0");
    }
}

inline void check_indices(const KnnMatches& matches, std::size_t count1, std::size_t count2) {
    const auto outside = [](int index, std::size_t count) {
        return index < 0 || static_cast<std::size_t>(index) >= count;
    };
    for (std::size_t i = 0; i < matches.size(); ++i) {
        if (!matches[i].empty() &&
            (outside(matches[i][0].queryIdx, count1) || outside(matches[i][0].trainIdx, count2))) {
            throw std::invalid_argument("matches[" + std::to_string(i) + "]: index out of range for " +
                                        std::to_string(count1) + " and " + std::to_string(count2) + " keypoints");
        }
    }
}

inline cv::Vec2d normalize_point(const cv::Point2f& point, const cv::Matx33d& K) {
    const double y = (point.y - K(1, 2)) / K(1, 1);
    return {(point.x - K(0, 2) - K(0, 1) * y) / K(0, 0), y};
}

/// Distance of a candidate; unknown where there is none, or where it was never set (OpenCV's largest float).
inline double descriptor_distance(const std::vector<cv::DMatch>& row, std::size_t candidate) {
    const double value = candidate < row.size() ? row[candidate].distance : kUnknown;
    return std::abs(value) < 1e38 ? value : kUnknown;
}

inline void encode_ratio(const std::vector<cv::DMatch>& row, Attributes& attributes) {
    const double nearest = descriptor_distance(row, 0), second = descriptor_distance(row, 1);
    if (std::isnan(nearest) || std::isnan(second)) {
        return;
    }
    // Two candidates at distance zero cannot be told apart.
    attributes[0] = static_cast<float>(second <= 0.0 ? 1.0 : std::clamp(nearest / second, 0.0, 1.0));
    attributes[5] = 1.0F;
}

inline void encode_shape(const cv::KeyPoint& first, const cv::KeyPoint& second, Attributes& attributes) {
    for (const cv::KeyPoint* keypoint : {&first, &second}) {
        if (!(keypoint->size > 0.0F && keypoint->angle >= 0.0F) || !std::isfinite(keypoint->size) ||
            !std::isfinite(keypoint->angle)) {
            return;
        }
    }
    const double turn = (static_cast<double>(second.angle) - first.angle) * CV_PI / 180.0;
    attributes[2] = static_cast<float>(std::log2(static_cast<double>(second.size) / first.size));
    attributes[3] = static_cast<float>(std::cos(turn));
    attributes[4] = static_cast<float>(std::sin(turn));
    attributes[7] = 1.0F;
}

/// True where no other match reaches the same keypoint of image 2 at a smaller distance; nothing where the distances
/// cannot say: some are missing, or several matches all have the same.
inline std::optional<std::vector<bool>> best_of_list(const KnnMatches& matches, std::size_t count2) {
    std::vector<double> smallest(count2, std::numeric_limits<double>::infinity());
    std::vector<double> distances;
    for (const std::vector<cv::DMatch>& row : matches) {
        if (row.empty()) {
            continue;
        }
        distances.push_back(descriptor_distance(row, 0));
        if (std::isnan(distances.back())) {
            return std::nullopt;
        }
        double& reached = smallest[static_cast<std::size_t>(row[0].trainIdx)];
        reached = std::min(reached, distances.back());
    }
    const auto [low, high] = std::minmax_element(distances.begin(), distances.end());
    if (distances.empty() || (distances.size() > 1 && *low == *high)) {
        return std::nullopt;
    }
    std::vector<bool> best;
    for (const std::vector<cv::DMatch>& row : matches) {
        best.push_back(!row.empty() &&
                       descriptor_distance(row, 0) <= smallest[static_cast<std::size_t>(row[0].trainIdx)]);
    }
    return best;
}

}  // namespace detail

/// Read the matches of a pair; arguments and what is thrown as in MgcaFilter.
inline Pair read_pair(const std::vector<cv::KeyPoint>& keypoints1, const std::vector<cv::KeyPoint>& keypoints2,
                      const KnnMatches& matches, const cv::Matx33d& K1, const cv::Matx33d& K2) {
    // Normalised coordinates beyond this (89.9 degrees off the axis) come from broken input, not from a lens.
    constexpr double kMaxNormalized = 1e3;
    detail::check_intrinsics(K1, "K1");
    detail::check_intrinsics(K2, "K2");
    detail::check_indices(matches, keypoints1.size(), keypoints2.size());
    const std::optional<std::vector<bool>> best = detail::best_of_list(matches, keypoints2.size());
    Pair pair;
    pair.focal_px = (K1(0, 0) + K1(1, 1) + K2(0, 0) + K2(1, 1)) / 4.0;
    for (std::size_t i = 0; i < matches.size(); ++i) {
        Attributes attributes{};
        Correspondence correspondence = Correspondence::all(detail::kUnknown);
        if (!matches[i].empty()) {
            const cv::KeyPoint& first = keypoints1[static_cast<std::size_t>(matches[i][0].queryIdx)];
            const cv::KeyPoint& second = keypoints2[static_cast<std::size_t>(matches[i][0].trainIdx)];
            const cv::Vec2d x1 = detail::normalize_point(first.pt, K1), x2 = detail::normalize_point(second.pt, K2);
            correspondence = {x1[0], x1[1], x2[0], x2[1]};
            detail::encode_shape(first, second, attributes);
        }
        detail::encode_ratio(matches[i], attributes);
        if (best) {
            attributes[1] = (*best)[i] ? 1.0F : 0.0F;
            attributes[6] = 1.0F;
        }
        pair.correspondences.push_back(correspondence);
        pair.attributes.push_back(attributes);
        pair.valid.push_back(std::all_of(correspondence.val, correspondence.val + 4,
                                         [](double x) { return std::abs(x) < kMaxNormalized; }));
    }
    return pair;
}

}  // namespace mgca
