#include "focal_estimate.hpp"

#include "pose_refinement.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace mgca::detail {
namespace {

// Factors on the guessed focal length that are tried: from extreme wide-angle lenses to telephoto ones.
constexpr int kFactors = 19;
constexpr double kSmallestFactor = 0.25, kLargestFactor = 4.0;
// Where cameras lie from the guess, in the logarithm: mean and standard deviation over the scenes of the training data.
constexpr double kUsual = -0.3, kUsualSpread = 0.35;
constexpr double kThresholdPx = 2.0;
// What makes of the curvature a standard deviation that two thirds of the training pairs keep.
constexpr double kSigmaFactor = 3.0, kLeastSigma = 0.04;
// Under a focal length far from the right one matches lie this far off before the pose is refined.
constexpr double kReachPx = 16.0;
constexpr int kRounds = 6;
constexpr std::size_t kMaxRows = 300, kMinRows = 12;
// With this share of the matches that agree with F an essential matrix takes its place.
constexpr double kLeastAgreement = 0.8;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

Correspondences agreeing_with(const Evidence& evidence, const cv::Matx33d& M) {
    Correspondences agreeing;
    for (const Correspondence& match : evidence.take(evidence.above(0.0))) {
        if (sampson_distance(match, M) < kRefinePx / evidence.focal_px) {
            agreeing.push_back(match);
        }
    }
    return agreeing;
}

/// Truncated squared Sampson errors in squared pixels, summed, of the best pose under a factor on the guess.
double cost_px(const Correspondences& rows, const cv::Matx33d& F, double factor, double focal_px) {
    const cv::Matx33d zoom = cv::Matx33d::diag({factor, factor, 1.0});
    Correspondences scaled;
    for (const Correspondence& row : rows) {
        scaled.push_back(row / factor);
    }
    const double focal = focal_px * factor;
    const auto start = pose_from_essential(project_to_essential(zoom * F * zoom), scaled, focal / kReachPx);
    if (!start) {
        return kInfinity;
    }
    const double threshold = kThresholdPx / focal;
    const Pose pose =
        refine_pose(scaled, refine_pose(scaled, *start, kReachPx / focal, kRounds), threshold, kRounds);
    return truncated_cost(scaled, pose, threshold) * focal * focal;
}

}  // namespace

std::optional<FocalEstimate> estimate_focal(const Evidence& evidence, const cv::Matx33d& F) {
    const Correspondences agreeing = agreeing_with(evidence, F);
    const std::size_t step = std::max<std::size_t>(1, (agreeing.size() + kMaxRows - 1) / kMaxRows);
    Correspondences rows;
    for (std::size_t i = 0; i < agreeing.size(); i += step) {
        rows.push_back(agreeing[i]);
    }
    if (rows.size() < kMinRows) {
        return std::nullopt;
    }
    std::array<double, kFactors> logs{}, costs{};
    double least = kInfinity;
    for (std::size_t i = 0; i < kFactors; ++i) {
        const double part = static_cast<double>(i) / (kFactors - 1);
        logs[i] = std::log(kSmallestFactor) + part * std::log(kLargestFactor / kSmallestFactor);
        costs[i] = cost_px(rows, F, std::exp(logs[i]), evidence.focal_px);
        least = std::min(least, costs[i]);
    }
    if (!std::isfinite(least)) {
        return std::nullopt;
    }
    // The noise is what the best of them leaves.
    const double noise = std::max(least / static_cast<double>(rows.size()), 0.1 * 0.1);
    for (std::size_t i = 0; i < kFactors; ++i) {
        const double unusual = (logs[i] - kUsual) / kUsualSpread;
        costs[i] = costs[i] / noise + unusual * unusual;
    }
    const auto lowest = static_cast<std::size_t>(std::min_element(costs.begin(), costs.end()) - costs.begin());
    const std::size_t best = std::clamp<std::size_t>(lowest, 1, kFactors - 2);
    const double before = costs[best - 1], at = costs[best], after = costs[best + 1];
    if (!std::isfinite(before) || !std::isfinite(at) || !std::isfinite(after)) {
        return std::nullopt;
    }
    // A parabola through three points of equal distance.
    const double width = logs[best + 1] - logs[best];
    const double curvature = (before - 2.0 * at + after) / (2.0 * width * width);
    const double slope = (after - before) / (2.0 * width);
    if (!(curvature > 0.0)) {
        return std::nullopt;
    }
    const double log_factor = std::clamp(logs[best] - slope / (2.0 * curvature), logs[best - 1], logs[best + 1]);
    // A sum of squares over the noise rises by one at a standard deviation, if matches were independent.
    return FocalEstimate{std::exp(log_factor), std::hypot(kSigmaFactor / std::sqrt(curvature), kLeastSigma)};
}

bool agrees_as_well(const Evidence& evidence, const TwoViewModel& model, const Evidence& free,
                    const TwoViewModel& free_model) {
    const auto count = static_cast<double>(agreeing_with(evidence, model.M).size());
    return count >= kLeastAgreement * static_cast<double>(agreeing_with(free, free_model.M).size());
}

}  // namespace mgca::detail
