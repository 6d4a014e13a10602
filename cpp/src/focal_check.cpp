#include "focal_check.hpp"

#include "pose_refinement.hpp"

#include <algorithm>
#include <array>
#include <cmath>

namespace mgca::detail {
namespace {

constexpr double kFocalStep = 1.2;
// Another focal length is believed where it lowers the truncated cost by this share of it, and by this many times the
// variance of the inliers' distances.
constexpr double kMinGainShare = 0.35, kMinGainVariances = 20.0;
// It is tried where the derivatives promise this much.
constexpr double kMinPromisedShare = 0.01, kMinPromisedVariances = 4.0;
// The pose under another focal length lies further off than a fine threshold lets refinement see.
constexpr double kCoarseFactor = 16.0;
constexpr int kCoarseRounds = 5;
constexpr std::size_t kMaxRows = 500;
constexpr int kMaxSteps = 8;
constexpr double kDifference = 1e-7;

/// The pose that suits the given focal lengths times a factor, and its cost in the unit of the given ones.
struct Trial {
    double factor;
    Pose pose;
    double cost;
};

Correspondences divided(const Correspondences& rows, double factor) {
    Correspondences result;
    result.reserve(rows.size());
    for (const Correspondence& match : rows) {
        result.push_back(match / factor);
    }
    return result;
}

/// The pose that suits a factor, from one that is near it.
Trial refined(const Correspondences& rows, double factor, const Pose& start, double threshold) {
    const Correspondences scaled = divided(rows, factor);
    const Pose pose = refine_pose(scaled, start, threshold / factor);
    return {factor, pose, truncated_cost(scaled, pose, threshold / factor) * factor * factor};
}

cv::Matx33d unscaled_essential(const Pose& pose) { return cross_matrix(pose.t) * pose.R; }

/// What a Gauss-Newton step takes off the squared distances of the inliers if it may change the focal length, beyond a
/// step on the pose alone; and 1 or -1: whether it makes the focal length longer.
std::pair<double, double> promised_gain(const Correspondences& near, const Trial& given) {
    const Pose& pose = given.pose;
    // Six small changes: three turns, two moves across t, a longer focal length. Distances have no sign, but neither has
    // the product of a distance and its derivative.
    const cv::Vec3d axis = std::abs(pose.t[0]) < 0.6 ? cv::Vec3d(1, 0, 0) : cv::Vec3d(0, 1, 0);
    const cv::Vec3d move = cv::normalize(pose.t.cross(axis)), other = pose.t.cross(move);
    std::vector<cv::Matx33d> changed;
    for (int k = 0; k < 3; ++k) {
        cv::Vec3d turn;
        turn[k] = kDifference;
        changed.push_back(cross_matrix(pose.t) * rotation_from_vector(turn) * pose.R);
    }
    changed.push_back(cross_matrix(pose.t + kDifference * move) * pose.R);
    changed.push_back(cross_matrix(pose.t + kDifference * other) * pose.R);
    const cv::Matx33d E = unscaled_essential(pose);
    constexpr double kLonger = 1.0 + kDifference;
    cv::Mat hessian = cv::Mat::zeros(6, 6, CV_64F), gradient = cv::Mat::zeros(6, 1, CV_64F);
    for (const Correspondence& match : near) {
        const double distance = sampson_distance(match, E);
        std::array<double, 6> row{};
        for (std::size_t k = 0; k < 5; ++k) {
            row[k] = (sampson_distance(match, changed[k]) - distance) / kDifference;
        }
        row[5] = (sampson_distance(match / kLonger, E) * kLonger - distance) / kDifference;
        for (int i = 0; i < 6; ++i) {
            for (int j = 0; j < 6; ++j) {
                hessian.at<double>(i, j) += row[static_cast<std::size_t>(i)] * row[static_cast<std::size_t>(j)];
            }
            gradient.at<double>(i) += row[static_cast<std::size_t>(i)] * distance;
        }
    }
    cv::Mat step, pose_step;
    const cv::Range five(0, 5);
    cv::solve(hessian, gradient, step, cv::DECOMP_SVD);
    cv::solve(hessian(five, five), gradient.rowRange(five), pose_step, cv::DECOMP_SVD);
    return {gradient.dot(step) - gradient.rowRange(five).dot(pose_step), step.at<double>(5) > 0.0 ? -1.0 : 1.0};
}

/// Multiply the factor by a step for as long as the cost falls.
Trial descend(const Correspondences& rows, Trial trial, double step, double threshold) {
    for (int i = 0; i < kMaxSteps; ++i) {
        const double factor = trial.factor * step;
        const double wide = kCoarseFactor * threshold / factor;
        const Pose coarse = refine_pose(divided(rows, factor), trial.pose, wide, kCoarseRounds);
        const Trial following = refined(rows, factor, coarse, threshold);
        if (following.cost >= trial.cost) {
            break;
        }
        trial = following;
    }
    return trial;
}

}  // namespace

std::optional<double> better_focal_factor(const Correspondences& matches, const Pose& pose, double threshold) {
    // What lies beyond the coarsest reach is wrong under every focal length, and says nothing of any.
    Correspondences rows;
    const cv::Matx33d found = unscaled_essential(pose);
    for (std::size_t i = 0; i < matches.size() && rows.size() < kMaxRows; ++i) {
        if (sampson_distance(matches[i], found) < kCoarseFactor * threshold) {
            rows.push_back(matches[i]);
        }
    }
    const Trial given = refined(rows, 1.0, pose, threshold);
    const cv::Matx33d E = unscaled_essential(given.pose);
    Correspondences near;
    double variance = 0.0;
    for (const Correspondence& match : rows) {
        const double distance = sampson_distance(match, E);
        if (distance < threshold) {
            near.push_back(match);
            variance += distance * distance;
        }
    }
    if (static_cast<int>(near.size()) < kMinRefinedInliers) {
        return std::nullopt;
    }
    variance /= static_cast<double>(near.size());
    const auto [promised, direction] = promised_gain(near, given);
    if (promised < std::max(kMinPromisedShare * given.cost, kMinPromisedVariances * variance)) {
        return std::nullopt;
    }
    const Trial best = descend(rows, given, std::pow(kFocalStep, direction), threshold);
    const double enough = std::max(kMinGainShare * given.cost, kMinGainVariances * variance);
    return given.cost - best.cost > enough ? std::optional(best.factor) : std::nullopt;
}

}  // namespace mgca::detail
