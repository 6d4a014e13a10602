// Robust fit of the relative pose to scored matches: several starts beside the network's own answer, refined, and the
// choice between them.

#pragma once

#include "mgca_epipolar.hpp"
#include "mgca_estimators.hpp"
#include "mgca_pose_refinement.hpp"
#include "mgca_ranking.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

namespace mgca {

/// Fewer distinct matches than this give no pose.
constexpr std::size_t kMinMatches = 8;

/// Settings of the robust fit.
struct RobustFitOptions {
    double threshold_px = 0.5;         ///< Sampson distance that the estimator takes for an inlier, pixels.
    double refine_threshold_px = 1.0;  ///< Where refinement and support cut the error off, pixels.
    double confidence = 0.999;         ///< Probability that a sample without outliers was drawn.
    int max_iterations = 5000;         ///< Largest number of samples of a start.
    int seed = 0;                      ///< Of the random numbers, not negative.
};

namespace detail {

/// One run of the estimator: it sees the matches above a margin; its threshold is a multiple of the fit's.
struct Start {
    double margin;
    double threshold_factor;
};

// The estimator stops at the first model that looks good enough and misses better ones; what it sees decides which it
// meets. Up to four views of the matches, and the choice by support, find most of what any one of them would.
constexpr std::array<Start, 4> kStarts{{{-1.0, 2.0}, {-1.0, 1.0}, {0.0, 2.0}, {-2.0, 1.0}}};

struct SupportedPose {
    Pose pose;
    double support = 0.0;
};

/// The pose of most support; of equals the first.
inline const SupportedPose& best_of(const std::vector<SupportedPose>& poses) {
    return *std::max_element(poses.begin(), poses.end(), [](const SupportedPose& a, const SupportedPose& b) {
        return a.support < b.support;
    });
}

/// The pose of an essential matrix, refined on the matches; nothing where none of them is near it.
inline std::optional<Pose> refined_pose(const std::vector<Correspondence>& seen, const cv::Matx33d& E,
                                        double threshold) {
    const std::optional<Pose> pose = pose_from_essential(E, near_model(seen, E, threshold));
    return pose ? std::optional<Pose>(refine_pose(seen, *pose, threshold)) : std::nullopt;
}

/// What start number `index` finds, refined; each start draws other samples.
inline std::optional<Pose> run_start(const RankedMatches& matches, std::size_t index, double focal_px,
                                     const RobustFitOptions& options) {
    const Start& start = kStarts[index];
    const double threshold = options.refine_threshold_px / focal_px;
    const std::vector<Correspondence> seen = matches.above(start.margin);
    const auto seed = (static_cast<unsigned>(options.seed) + static_cast<unsigned>(index)) &
                      static_cast<unsigned>(std::numeric_limits<int>::max());
    const std::optional<cv::Matx33d> E =
        fit_essential(seen, start.threshold_factor * options.threshold_px / focal_px, options.confidence,
                      options.max_iterations, static_cast<int>(seed));
    return E ? refined_pose(seen, *E, threshold) : std::nullopt;
}

/// True where the best-supported pose has been found twice.
inline bool agree(const std::vector<SupportedPose>& poses) {
    constexpr double kAgreementDeg = 1.0, kAgreementSupportShare = 0.97;
    if (poses.empty()) {
        return false;
    }
    const SupportedPose& best = best_of(poses);
    return std::any_of(poses.begin(), poses.end(), [&](const SupportedPose& other) {
        return &other != &best && other.support > kAgreementSupportShare * best.support &&
               pose_error_deg(other.pose, best.pose) < kAgreementDeg;
    });
}

/// Refined poses that the dominant plane of a pose's inliers allows.
///
/// Where most matches lie on one plane two poses explain them about equally well, and sampling meets one of them by
/// chance. The few matches off the plane, and the depths, tell which is right.
inline std::vector<SupportedPose> plane_rivals(const RankedMatches& matches, const SupportedPose& best,
                                               double threshold, int seed) {
    // A homography constrains both coordinates and planes are seldom perfect: it gets twice the threshold.
    constexpr double kHomographyThresholdFactor = 2.0;
    // A pose is worth refining when it starts with this share of the support to beat.
    constexpr double kRivalSupportShare = 0.5;
    const std::vector<Correspondence> accepted = matches.above(0.0);
    const std::optional<cv::Matx33d> H =
        fit_homography(near_model(accepted, essential_from_pose(best.pose), threshold),
                       kHomographyThresholdFactor * threshold, seed);
    std::vector<SupportedPose> rivals;
    for (const Pose& start : H ? poses_from_homography(*H) : std::vector<Pose>{}) {
        if (matches.support(start, threshold) > kRivalSupportShare * best.support) {
            const Pose pose = refine_pose(accepted, start, threshold);
            rivals.push_back({pose, matches.support(pose, threshold)});
        }
    }
    return rivals;
}

}  // namespace detail

/// Fit the relative pose: the best-supported one among the network's own and those of the starts, all refined, which
/// end as soon as two agree, and the rivals that the dominant plane of the best of them allows.
///
/// @param network_essential the network's own E, of any scale; one that is not finite is passed over.
/// @param focal_px mean focal length, pixels: converts the thresholds.
/// @return the pose; nothing where the matches are fewer than kMinMatches, no pose is found, or fewer than kMinMatches
///     of the accepted ones agree with it. Never throws for data.
inline std::optional<Pose> estimate_pose(const RankedMatches& matches, const cv::Matx33d& network_essential,
                                         double focal_px, const RobustFitOptions& options) {
    if (matches.size() < kMinMatches) {
        return std::nullopt;
    }
    const double threshold = options.refine_threshold_px / focal_px;
    std::vector<detail::SupportedPose> poses;
    const auto add = [&](const std::optional<Pose>& pose) {
        if (pose) {
            poses.push_back({*pose, matches.support(*pose, threshold)});
        }
    };
    if (cv::checkRange(network_essential)) {
        add(detail::refined_pose(matches.above(0.0), network_essential, threshold));
    }
    for (std::size_t index = 0; index < detail::kStarts.size() && !detail::agree(poses); ++index) {
        add(detail::run_start(matches, index, focal_px, options));
    }
    if (poses.empty()) {
        return std::nullopt;
    }
    poses = {detail::best_of(poses)};
    const auto rivals = detail::plane_rivals(matches, poses.front(), threshold, options.seed);
    poses.insert(poses.end(), rivals.begin(), rivals.end());
    const Pose best = detail::best_of(poses).pose;
    if (near_model(matches.above(0.0), essential_from_pose(best), threshold).size() < kMinMatches) {
        return std::nullopt;
    }
    return best;
}

}  // namespace mgca
