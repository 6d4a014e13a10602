#include "bayes_estimate.hpp"

#include "evidence.hpp"
#include "pose_refinement.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <functional>
#include <limits>
#include <numeric>

namespace mgca::detail {
namespace {

// Hypotheses that are drawn around: so many at most, so far apart at least, and no log-likelihood so far below the best.
constexpr std::size_t kCentres = 8;
constexpr double kApartDeg = 0.5, kDepth = 20.0;
// Poses drawn around each beside itself, in standard deviations times the spread; a direction that nothing holds has a
// deviation of the widest, radians.
constexpr std::size_t kDrawn = 96;
constexpr double kSpread = 1.5, kWidest = 0.3;
// Matches this close to a centre, pixels, tell how firmly it is held, times the scale of the noise; those within the
// reach of any centre tell the poses drawn from each other.
constexpr double kHoldingPx = 2.0, kReachPx = 6.0;
// Where focal lengths are huge, what a direction adds to the information may be less than the rounding of the others.
constexpr double kRounding = 1e-12;
// Matches are not independent: their log-likelihood counts half.
constexpr double kTempering = 0.5;
// A pose this many degrees from the truth is worth half.
constexpr double kHalfWorthDeg = 16.0;
// Draws of less than this share of the largest weight do not count.
constexpr double kLeastWeight = 1e-3;
// An answer explains this share of the matches that the best hypothesis does, and no fewer than a pose takes.
constexpr double kExplainedShare = 0.6;

// Dimensions that meet in the transform of Box and Muller: those that give the least covariance.
constexpr std::array<std::size_t, 3> kRadii{3, 1, 5}, kTurns{0, 4, 2};

/// A pose that was drawn, and the log-density by which it was, up to a constant.
struct Draw {
    Pose pose;
    double log_proposal;
};

/// Points that fill a standard normal distribution evenly, the first of them 0: an additive recurrence in six dimensions
/// and the transform of Box and Muller.
const std::array<Vec5d, kDrawn + 1>& quasi_normals() {
    static const std::array<Vec5d, kDrawn + 1> points = [] {
        double ratio = 1.0;
        for (int i = 0; i < 64; ++i) {  // of x ** 7 = x + 1
            ratio = std::pow(1.0 + ratio, 1.0 / 7.0);
        }
        std::array<Vec5d, kDrawn + 1> drawn{};
        for (std::size_t n = 1; n <= kDrawn; ++n) {
            std::array<double, 6> uniform{};
            for (std::size_t k = 0; k < uniform.size(); ++k) {
                const double step = std::pow(ratio, -static_cast<double>(k + 1));
                uniform[k] = std::fmod(0.5 + static_cast<double>(n) * step, 1.0);
            }
            for (int k = 0; k < 5; ++k) {
                const auto pair = static_cast<std::size_t>(k % 3);
                const double radius = std::sqrt(-2.0 * std::log(uniform[kRadii[pair]]));
                const double turn = 2.0 * CV_PI * uniform[kTurns[pair]];
                drawn[n][k] = radius * (k < 3 ? std::cos(turn) : std::sin(turn));
            }
        }
        return drawn;
    }();
    return points;
}

/// Lower triangular root of a symmetric, positive definite matrix (Cholesky).
Matx55d lower_root(const Matx55d& matrix) {
    Matx55d root;
    for (int i = 0; i < 5; ++i) {
        for (int j = 0; j <= i; ++j) {
            double rest = matrix(i, j);
            for (int k = 0; k < j; ++k) {
                rest -= root(i, k) * root(j, k);
            }
            root(i, j) = i == j ? std::sqrt(rest) : rest / root(j, j);
        }
    }
    return root;
}

/// Solves rootᵀ x = b.
Vec5d solve_transposed(const Matx55d& root, const Vec5d& b) {
    Vec5d x;
    for (int i = 4; i >= 0; --i) {
        double rest = b[i];
        for (int k = i + 1; k < 5; ++k) {
            rest -= root(k, i) * x[k];
        }
        x[i] = rest / root(i, i);
    }
    return x;
}

/// What the matches of a pair say of a pose.
class Posterior {
public:
    Posterior(const Correspondences& matches, const std::vector<double>& scores, double scale, double focal_px,
              const Coefficients& coefficients)
        : matches_(matches),
          weights_(scores),
          counts_(independent_counts(matches, scores, coefficients)),
          coefficients_(coefficients),
          noise_(kNoisePx * scale / focal_px) {
        coefficients_.noise_scales = {scale};
        for (const double score : scores) {
            probability_.push_back(score_prior(score, coefficients));
        }
    }

    /// Log-densities of poses up to a constant, from their residuals on a selection of the matches.
    std::vector<double> log_density(const std::vector<Residuals>& residuals, const std::vector<std::size_t>& rows) const {
        std::vector<double> probability, counts, counted;
        for (const std::size_t i : rows) {
            probability.push_back(probability_[i]);
            counts.push_back(counts_[i]);
            counted.push_back(weights_[i] * counts_[i]);
        }
        const auto likelihood = log_likelihoods(residuals, probability, coefficients_, counts);
        std::vector<double> density = support_bonus(residuals, counted, coefficients_, matches_.size());
        for (std::size_t h = 0; h < density.size(); ++h) {
            density[h] += likelihood[h][0];
        }
        return density;
    }

    /// Poses around one that a selection of the matches holds, itself the first.
    void draw(const Pose& pose, const std::vector<std::size_t>& holding, std::vector<Draw>& draws) const {
        Correspondences rows;
        std::vector<double> weights;
        for (const std::size_t i : holding) {
            rows.push_back(matches_[i]);
            weights.push_back(counts_[i] / (noise_ * noise_));
        }
        Matx55d information = pose_information(rows, pose, weights);
        const double damping = 1.0 / (kWidest * kWidest) + kRounding * cv::trace(information);
        double log_volume = 0.0;
        for (int k = 0; k < 5; ++k) {
            information(k, k) += damping;
        }
        const Matx55d root = lower_root(information);
        for (int k = 0; k < 5; ++k) {
            log_volume += std::log(root(k, k));
        }
        for (const Vec5d& normal : quasi_normals()) {
            const Pose drawn = apply_step(pose, kSpread * solve_transposed(root, normal));
            draws.push_back({drawn, log_volume - 0.5 * normal.dot(normal)});
        }
    }

private:
    const Correspondences& matches_;
    const std::vector<double>& weights_;
    std::vector<double> counts_, probability_;
    Coefficients coefficients_;
    double noise_;
};

/// The best poses that differ from each other, the best first.
std::vector<std::size_t> distinct(const std::vector<Pose>& poses, const std::vector<double>& log_density) {
    std::vector<std::size_t> order(poses.size()), centres;
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::stable_sort(order.begin(), order.end(),
                     [&](std::size_t a, std::size_t b) { return log_density[a] > log_density[b]; });
    for (const std::size_t one : order) {
        if (centres.size() == kCentres || log_density[one] < log_density[order[0]] - kDepth) {
            break;
        }
        if (std::all_of(centres.begin(), centres.end(),
                        [&](std::size_t other) { return pose_angle_deg(poses[one], poses[other]) > kApartDeg; })) {
            centres.push_back(one);
        }
    }
    return centres;
}

/// Weights of draws, the second largest 1: one draw alone never outweighs all others.
std::vector<double> weights_of(const std::vector<double>& log_density, const std::vector<Draw>& draws) {
    std::vector<double> weights;
    for (std::size_t s = 0; s < draws.size(); ++s) {
        weights.push_back(kTempering * log_density[s] - draws[s].log_proposal);
    }
    std::vector<double> sorted = weights;
    std::nth_element(sorted.begin(), sorted.begin() + 1, sorted.end(), std::greater<>());
    std::transform(weights.begin(), weights.end(), weights.begin(),
                   [&](double value) { return std::exp(std::min(value - sorted[1], 0.0)); });
    return weights;
}

}  // namespace

std::optional<Pose> expected_best(const Correspondences& matches, const std::vector<double>& scores,
                                  const std::vector<Pose>& hypotheses, double scale, double focal_px,
                                  const Coefficients& coefficients) {
    const Posterior posterior(matches, scores, scale, focal_px, coefficients);
    std::vector<Residuals> residuals;
    for (const Pose& pose : hypotheses) {
        residuals.push_back(measure_residuals(matches, pose, focal_px));
    }
    std::vector<std::size_t> all(matches.size());
    std::iota(all.begin(), all.end(), std::size_t{0});
    const std::vector<std::size_t> centres = distinct(hypotheses, posterior.log_density(residuals, all));
    std::vector<Draw> draws;
    std::vector<std::size_t> reached;
    for (const std::size_t i : all) {
        if (std::any_of(centres.begin(), centres.end(),
                        [&](std::size_t one) { return residuals[one].distance_px[i] < kReachPx; })) {
            reached.push_back(i);
        }
    }
    for (const std::size_t one : centres) {
        std::vector<std::size_t> holding;
        for (const std::size_t i : all) {
            if (residuals[one].explains(i, kHoldingPx * scale)) {
                holding.push_back(i);
            }
        }
        if (holding.size() >= static_cast<std::size_t>(kMinRefinedInliers)) {
            posterior.draw(hypotheses[one], holding, draws);
        }
    }
    if (draws.empty()) {
        return std::nullopt;
    }
    Correspondences rows;
    for (const std::size_t i : reached) {
        rows.push_back(matches[i]);
    }
    std::vector<Residuals> near;
    for (const Draw& draw : draws) {
        near.push_back(measure_residuals(rows, draw.pose, focal_px));
    }
    const std::vector<double> weights = weights_of(posterior.log_density(near, reached), draws);
    std::vector<std::size_t> heavy;
    for (std::size_t s = 0; s < draws.size(); ++s) {
        if (weights[s] > kLeastWeight) {
            heavy.push_back(s);
        }
    }
    const double least = std::max(kExplainedShare * static_cast<double>(residuals[centres[0]].explained()),
                                  static_cast<double>(kFirmMatches));
    std::optional<Pose> best;
    double most = -std::numeric_limits<double>::infinity();
    for (const std::size_t candidate : heavy) {
        if (static_cast<double>(near[candidate].explained()) < least) {
            continue;
        }
        double worth = 0.0;
        for (const std::size_t s : heavy) {
            const double relative = pose_angle_deg(draws[candidate].pose, draws[s].pose) / kHalfWorthDeg;
            worth += weights[s] / (1.0 + relative * relative);
        }
        if (worth > most) {
            most = worth;
            best = draws[candidate].pose;
        }
    }
    return best;
}

}  // namespace mgca::detail
