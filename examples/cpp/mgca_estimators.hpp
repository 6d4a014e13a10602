// OpenCV's robust estimators: the essential matrix by PROSAC, and the poses that the dominant plane allows.

#pragma once

#include "mgca_epipolar.hpp"

#include <opencv2/core.hpp>
#if CV_VERSION_MAJOR >= 5
#include <opencv2/geometry.hpp>
#else
#include <opencv2/calib3d.hpp>
#endif

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <optional>
#include <vector>

namespace mgca {
namespace detail {

/// OpenCV's settings; with this local optimisation they give what its USAC_PROSAC preset gives at seed 0.
inline cv::UsacParams usac_params(cv::SamplingMethod sampler, double threshold, double confidence, int max_iterations,
                                  int seed) {
    cv::UsacParams params;
    params.sampler = sampler;
    params.score = cv::SCORE_METHOD_MSAC;
    params.loMethod = cv::LOCAL_OPTIM_INNER_LO;
    params.loIterations = 20;
    params.loSampleSize = 12;
    params.threshold = threshold;
    params.confidence = confidence;
    params.maxIterations = max_iterations;
    params.randomGeneratorState = seed;
    return params;
}

/// Points of one image in multiples of `unit`.
inline std::vector<cv::Point2d> points(const std::vector<Correspondence>& matches, int image, double unit = 1.0) {
    std::vector<cv::Point2d> points;
    points.reserve(matches.size());
    for (const Correspondence& match : matches) {
        points.emplace_back(match[2 * image - 2] / unit, match[2 * image - 1] / unit);
    }
    return points;
}

}  // namespace detail

/// The essential matrix by PROSAC, of unit Frobenius norm; nothing where OpenCV finds none.
///
/// @param matches distinct, the most promising first.
/// @param threshold Sampson distance of an inlier, normalised.
inline std::optional<cv::Matx33d> fit_essential(const std::vector<Correspondence>& matches, double threshold,
                                                double confidence, int max_iterations, int seed) {
    const cv::Matx33d identity = cv::Matx33d::eye();
    cv::Mat stacked;  // OpenCV may stack several models
    try {
        stacked = cv::findEssentialMat(
            detail::points(matches, 1), detail::points(matches, 2), identity, identity, cv::noArray(), cv::noArray(),
            cv::noArray(), detail::usac_params(cv::SAMPLING_PROSAC, threshold, confidence, max_iterations, seed));
    } catch (const cv::Exception&) {
        return std::nullopt;
    }
    std::optional<cv::Matx33d> best;
    double best_cost = 0.0;
    for (int row = 0; row + 3 <= stacked.rows; row += 3) {
        const cv::Mat block = stacked.rowRange(row, row + 3);
        if (block.cols != 3 || !cv::checkRange(block) || cv::countNonZero(block) == 0) {
            continue;
        }
        const cv::Matx33d model(block);
        double cost = 0.0;
        for (const Correspondence& match : matches) {
            const double distance = std::min(sampson_distance(match, model), threshold);
            cost += distance * distance;
        }
        if (!best || cost < best_cost) {
            best = model * (1.0 / cv::norm(model));
            best_cost = cost;
        }
    }
    return best;
}

/// Homography with x2 ~ H x1 that most matches obey, scaled to H(2, 2) = 1; nothing where OpenCV finds none.
///
/// @param threshold transfer error of an inlier, normalised.
inline std::optional<cv::Matx33d> fit_homography(const std::vector<Correspondence>& matches, double threshold,
                                                 int seed) {
    constexpr double kConfidence = 0.999;
    constexpr int kMaxIterations = 1000;
    if (matches.size() < 4) {
        return std::nullopt;
    }
    cv::Mat scaled;
    try {
        // OpenCV holds some constants in pixels: in units of the threshold, any coordinates look like pixels to it.
        scaled = cv::findHomography(
            detail::points(matches, 1, threshold), detail::points(matches, 2, threshold), cv::noArray(),
            detail::usac_params(cv::SAMPLING_UNIFORM, 1.0, kConfidence, kMaxIterations, seed));
    } catch (const cv::Exception&) {
        return std::nullopt;
    }
    if (scaled.size() != cv::Size(3, 3) || !cv::checkRange(scaled)) {
        return std::nullopt;
    }
    const cv::Matx33d S = cv::Matx33d::diag({1.0 / threshold, 1.0 / threshold, 1.0});
    const cv::Matx33d H = S.inv() * cv::Matx33d(scaled) * S;
    if (std::abs(H(2, 2)) < 1e-12) {
        return std::nullopt;
    }
    return H * (1.0 / H(2, 2));
}

/// Relative poses under which a plane induces H between normalised points: up to four (Malis & Vargas 2007), none where
/// H is a rotation.
inline std::vector<Pose> poses_from_homography(const cv::Matx33d& H) {
    std::vector<cv::Mat> rotations, translations, normals;
    try {
        cv::decomposeHomographyMat(H, cv::Matx33d::eye(), rotations, translations, normals);
    } catch (const cv::Exception&) {
        return {};
    }
    std::vector<Pose> poses;
    for (std::size_t i = 0; i < rotations.size(); ++i) {
        const double length = cv::norm(translations[i]);
        if (cv::checkRange(rotations[i]) && std::isfinite(length) && length > 1e-9) {
            const cv::Matx31d t(translations[i]);
            poses.push_back({cv::Matx33d(rotations[i]), cv::Vec3d(t(0), t(1), t(2)) * (1.0 / length)});
        }
    }
    return poses;
}

}  // namespace mgca
