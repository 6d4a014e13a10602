// Choice among hypotheses, and the confidence of what was chosen; mgca_filter/fit/choice.py.

#pragma once

#include "epipolar.hpp"
#include "json.hpp"
#include "sources.hpp"

#include <array>
#include <cstddef>
#include <map>
#include <optional>
#include <string>
#include <vector>

namespace mgca::detail {

// Measurements of the chosen hypothesis, in the order of the coefficients of the confidence, which end in the offset.
enum class Feature : std::size_t {
    log_count,
    log_weighted_count,
    log_share,
    log_weighted_share,
    log_significance,
    log_weighted_significance,
    likelihood_per_inlier,
    likelihood_to_alternative,
    plain_likelihood_to_alternative,
    support_to_alternative,
    plain_likelihood_to_best,
    weighted_support_to_best,
    share_behind,
    near_network_3_deg,
    near_network_10_deg,
    no_network,
    other_families_2_deg,
    other_families_5_deg,
    other_families_10_deg,
    log_scale,
    log_matches,
    log_sum_of_scores,
    log_uncertainty_deg,
    count,  // number of the above
};
constexpr std::size_t kFeatureCount = static_cast<std::size_t>(Feature::count);

// Matches within this distance are explained.
constexpr double kInlierPx = 1.0;
// Half a pixel is the noise of SIFT's keypoints, more than enough; scales of the likelihood multiply it.
constexpr double kNoisePx = 0.5;

/// Coefficients by name, from the model file.
struct Coefficients {
    std::vector<double> score_trust, noise_px, noise_weights, noise_scales, outlier_width_px, seen_behind, early_end,
        support_weight, crowding, settled, verdict, confidence, early_confidence;

    /// Throws std::invalid_argument where one is missing, or has another length or values.
    static Coefficients read(const Json& values);
};

/// A pose that lies before the choice.
struct Hypothesis {
    Pose pose;
    Family family;
};

/// Residuals of one hypothesis on N matches.
struct Residuals {
    std::vector<double> distance_px;  // Sampson distances
    Mask behind;  // 1 where a match lies behind a camera and its rays are not nearly parallel

    /// Whether a match lies within a distance, pixels, of what the hypothesis wants, and in front of it.
    bool explains(std::size_t match, double reach_px = kInlierPx) const {
        return distance_px[match] < reach_px && behind[match] == 0;
    }
    /// How many do.
    std::size_t explained(double reach_px = kInlierPx) const;
};

/// The chosen hypothesis.
struct Judgement {
    std::size_t chosen = 0;
    std::array<double, kFeatureCount> features{};
    double scale = 1.0;  // of the noise

    double operator[](Feature feature) const { return features[static_cast<std::size_t>(feature)]; }
};

Residuals measure_residuals(const Correspondences& matches, const Pose& pose, double focal_px);

/// Larger of the angles of rotation and of direction (sign ignored) between two poses, degrees.
double pose_angle_deg(const Pose& a, const Pose& b);

/// What each match counts: less, the more of them lie together in both images.
///
/// @param weights probabilities of the matches.
std::vector<double> independent_counts(const Correspondences& matches, const std::vector<double>& weights,
                                       const Coefficients& coefficients);

/// Log-likelihood ratios against all matches being wrong: for each hypothesis one for each scale of the noise.
///
/// @param counts what each match counts.
std::vector<std::vector<double>> log_likelihoods(const std::vector<Residuals>& residuals,
                                                 const std::vector<double>& probability,
                                                 const Coefficients& coefficients, const std::vector<double>& counts);

/// What the support adds to the log-likelihood of each hypothesis: 0 for one that has the most at every distance.
///
/// @param weights what each match counts. matches: how many there are, where these are some of them.
std::vector<double> support_bonus(const std::vector<Residuals>& residuals, const std::vector<double>& weights,
                                  const Coefficients& coefficients, std::size_t matches);

/// Probability that a match of a score is right as the likelihood believes it.
double score_prior(double score, const Coefficients& coefficients);

/// Choose among hypotheses, at least one, and measure the chosen one.
///
/// @param matches each keypoint once. scores: probabilities of the matches, nothing before the network.
/// @param network_poses the poses that the network's own E allows, or none.
Judgement judge_hypotheses(const Correspondences& matches, const std::optional<std::vector<double>>& scores,
                           const std::vector<Hypothesis>& hypotheses, double focal_px,
                           const std::vector<Pose>& network_poses, const Coefficients& coefficients);

/// Probability that the chosen pose is within 10 degrees; early: of a choice without a network.
double confidence(const Judgement& judgement, const Coefficients& coefficients);
double early_confidence(const Judgement& judgement, const Coefficients& coefficients);

/// True where a pose found without the network needs none: the rule of the early end.
bool explains_list(const Judgement& judgement, const Coefficients& coefficients);

/// Probability that each match is right, from its residual alone: the scores of a pair that ended early.
///
/// @param groups matches that are right about equally often; each has its own share. What is in none gets 0.
std::vector<double> posterior(const Residuals& residuals, const std::vector<Mask>& groups, double scale,
                              const Coefficients& coefficients);

}  // namespace mgca::detail
