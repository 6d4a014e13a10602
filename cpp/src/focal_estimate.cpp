#include "focal_estimate.hpp"

#include "focal_pair.hpp"
#include "pose_refinement.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>
#include <utility>

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
// Nobody zooms by more, usually: standard deviation of the logarithm of the ratio of which matches tell nothing.
constexpr double kLargestRatioSigma = 0.5;
// How often a pose is within 10 degrees of the truth, by the log odds of the fit's confidence, which takes the focal
// lengths for known, and the logarithm of the degrees by which they leave it open: focal_estimate.py.
constexpr double kOddsWeight = 0.66, kSigmaWeight = -0.80, kOffset = 0.06;
// From here on it is no more than even, whatever the fit says.
constexpr double kEvenSigmaDeg = 10.0;
constexpr double kLeastSigmaDeg = 0.05, kLargestSigmaDeg = 180.0;
constexpr double kLeastConfidence = 1e-3;
// Under a focal length far from the right one matches lie this far off before the pose is refined.
constexpr double kReachPx = 16.0;
constexpr int kRounds = 6;
constexpr std::size_t kMaxRows = 300, kMinRows = 12;
// Keypoints are not better than this.
constexpr double kBestNoisePx = 0.1;
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

using FactorGrid = std::array<double, kFactors>;

/// The best pose under a factor, if there is one, and the squared Sampson errors that it leaves, each cut off, summed,
/// in squared pixels.
struct FocalTrial {
    std::optional<Pose> pose;
    double cost_px = kInfinity;
};

/// The pose that suits a factor on the guess, from F.
FocalTrial pose_under(const Correspondences& rows, const cv::Matx33d& F, double factor, double focal_px) {
    const cv::Matx33d zoom = cv::Matx33d::diag({factor, factor, 1.0});
    Correspondences scaled;
    for (const Correspondence& row : rows) {
        scaled.push_back(row / factor);
    }
    const double focal = focal_px * factor;
    const auto start = pose_from_essential(project_to_essential(zoom * F * zoom), scaled, focal / kReachPx);
    if (!start) {
        return {};
    }
    const double threshold = kThresholdPx / focal;
    const Pose pose =
        refine_pose(scaled, refine_pose(scaled, *start, kReachPx / focal, kRounds), threshold, kRounds);
    return {pose, truncated_cost(scaled, pose, threshold) * focal * focal};
}

/// The factor that both images share, and the position of the nearest on the grid.
///
/// @param costs in squared pixels, over the grid. count: number of matches behind them.
std::pair<std::optional<FocalEstimate>, std::size_t> shared_factor(const FactorGrid& logs, FactorGrid costs,
                                                                   std::size_t count) {
    double least = kInfinity;
    for (const double cost : costs) {
        least = std::isfinite(cost) ? std::min(least, cost) : least;
    }
    if (!std::isfinite(least)) {
        return {std::nullopt, 0};
    }
    // The noise is what the best of them leaves.
    const double noise = std::max(least / static_cast<double>(count), kBestNoisePx * kBestNoisePx);
    for (std::size_t i = 0; i < kFactors; ++i) {
        const double unusual = (logs[i] - kUsual) / kUsualSpread;
        costs[i] = std::isfinite(costs[i]) ? costs[i] / noise + unusual * unusual : kInfinity;
    }
    const auto lowest = static_cast<std::size_t>(std::min_element(costs.begin(), costs.end()) - costs.begin());
    const std::size_t best = std::clamp<std::size_t>(lowest, 1, kFactors - 2);
    const double before = costs[best - 1], at = costs[best], after = costs[best + 1];
    if (!std::isfinite(before) || !std::isfinite(at) || !std::isfinite(after)) {
        return {std::nullopt, best};
    }
    // A parabola through three points of equal distance.
    const double width = logs[best + 1] - logs[best];
    const double curvature = (before - 2.0 * at + after) / (2.0 * width * width);
    const double slope = (after - before) / (2.0 * width);
    if (!(curvature > 0.0)) {
        return {std::nullopt, best};
    }
    const double log_factor = std::clamp(logs[best] - slope / (2.0 * curvature), logs[best - 1], logs[best + 1]);
    // A sum of squares over the noise rises by one at a standard deviation, if matches were independent.
    const double sigma = std::hypot(kSigmaFactor / std::sqrt(curvature), kLeastSigma);
    return {FocalEstimate{cv::Vec2d::all(std::exp(log_factor)), cv::Vec2d::all(sigma), 0.0}, best};
}

/// Of the logarithms of the factors: both may be off together, and, as far as their ratio is open, against each other;
/// where both images share one, too: that they do is an assumption.
cv::Matx22d covariance(const FocalEstimate& estimate) {
    const double together = estimate.sigmas[0] * estimate.sigmas[1];
    const double against = std::pow(0.5 * std::min(estimate.ratio_sigma, kLargestRatioSigma), 2);
    return {together + against, together - against, together - against, together + against};
}

}  // namespace

std::vector<FocalEstimate> estimate_focals(const Evidence& evidence, const cv::Matx33d& F) {
    const Correspondences agreeing = agreeing_with(evidence, F);
    const std::size_t step = std::max<std::size_t>(1, (agreeing.size() + kMaxRows - 1) / kMaxRows);
    Correspondences rows;
    for (std::size_t i = 0; i < agreeing.size(); i += step) {
        rows.push_back(agreeing[i]);
    }
    if (rows.size() < kMinRows) {
        return {};
    }
    FactorGrid logs{}, costs{};
    std::array<FocalTrial, kFactors> trials;
    for (std::size_t i = 0; i < kFactors; ++i) {
        const double part = static_cast<double>(i) / (kFactors - 1);
        logs[i] = std::log(kSmallestFactor) + part * std::log(kLargestFactor / kSmallestFactor);
        trials[i] = pose_under(rows, F, std::exp(logs[i]), evidence.focal_px);
        costs[i] = trials[i].cost_px;
    }
    const auto [shared, best] = shared_factor(logs, costs, rows.size());
    std::vector<FocalEstimate> estimates;
    double ratio_sigma = 0.0;
    if (trials[best].pose && std::isfinite(costs[best])) {
        double sum = 0.0;
        for (const double distance : sampson_distances(agreeing, F)) {
            sum += distance * distance;
        }
        const double noise =
            std::max(std::sqrt(sum / static_cast<double>(agreeing.size())), kBestNoisePx / evidence.focal_px);
        const FocalPairFit fit(rows, kThresholdPx / evidence.focal_px, noise, {kUsual, kUsualSpread});
        const auto [two, sigma_beside] = fit.differing(*trials[best].pose, logs[best]);
        ratio_sigma = sigma_beside;
        if (two) {
            estimates.push_back({{std::exp(two->logs[0]), std::exp(two->logs[1])},
                                 {std::hypot(two->sigmas[0], kLeastSigma), std::hypot(two->sigmas[1], kLeastSigma)},
                                 two->ratio_sigma});
        }
    }
    if (shared) {
        estimates.push_back({shared->factors, shared->sigmas, ratio_sigma});
    }
    return estimates;
}

double pose_sigma_deg(const Evidence& evidence, const TwoViewModel& model, const FocalEstimate& estimate) {
    const Correspondences rows = agreeing_with(evidence, model.M);
    if (rows.size() < kMinRows) {
        return kLargestSigmaDeg;
    }
    const cv::Matx<double, 5, 2> derivative = FocalPairFit(rows, kInfinity, 1.0, {0.0, 1.0}).pose_derivative(model.pose);
    const cv::Matx<double, 5, 5> moved = derivative * covariance(estimate) * derivative.t();
    double variance = 0.0;
    const auto add = [&](const cv::Mat& part) {
        cv::Mat values;
        cv::eigen(part, values);
        variance = std::max(variance, values.at<double>(0));
    };
    add(cv::Mat(moved.get_minor<3, 3>(0, 0)));
    add(cv::Mat(moved.get_minor<2, 2>(3, 3)));
    return std::clamp(std::sqrt(variance) * 180.0 / CV_PI, kLeastSigmaDeg, kLargestSigmaDeg);
}

double confidence_under_estimate(double confidence, double sigma_deg) {
    const double p = std::clamp(confidence, kLeastConfidence, 1.0 - kLeastConfidence);
    const double log_odds = kOddsWeight * std::log(p / (1.0 - p)) + kSigmaWeight * std::log(sigma_deg) + kOffset;
    const double largest = sigma_deg < kEvenSigmaDeg ? confidence : std::min(confidence, 0.5);
    return std::min(largest, 1.0 / (1.0 + std::exp(-log_odds)));
}

bool agrees_as_well(const Evidence& evidence, const TwoViewModel& model, const Evidence& free,
                    const TwoViewModel& free_model) {
    const auto count = static_cast<double>(agreeing_with(evidence, model.M).size());
    return count >= kLeastAgreement * static_cast<double>(agreeing_with(free, free_model.M).size());
}

}  // namespace mgca::detail
