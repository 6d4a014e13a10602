#include "choice.hpp"

#include "pose_refinement.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <set>
#include <stdexcept>

namespace mgca::detail {
namespace {

// The signs of depths say something only where the rays are this far from parallel, pixels.
constexpr double kMinParallaxPx = 1.5;
// Without scores the share of right matches is at least and at most this.
constexpr double kMinShare = 0.02, kMaxShare = 0.8;
// Residuals between these, pixels, say how densely wrong matches lie around an epipolar line.
constexpr double kBackgroundLowPx = 6.0, kBackgroundHighPx = 18.0;
// Beyond this angle two hypotheses are alternatives and not the same answer.
constexpr double kAlternativeDeg = 5.0;
constexpr std::array<double, 3> kAgreementDeg{2.0, 5.0, 10.0};
// Shares of right matches in a group, and rounds in which they are found.
constexpr double kLeastShare = 1e-3, kLargestShare = 0.99;
constexpr int kShareRounds = 8;
// Gaps between log-likelihoods are compressed beyond this.
constexpr double kGapUnit = 3.0;
constexpr double kLargestPrior = 0.98;
// Hypotheses whose log-likelihoods differ by less are equally likely.
constexpr double kTie = 3.0;
constexpr double kTiny = 1e-12;
// Relative support is measured at these distances, pixels, which count this much.
constexpr std::array<double, 3> kSupportPx{1.0, 2.0, 4.0}, kSupportWeights{1.0, 1.0, 0.5};
// A density whose exponent is below this adds nothing to a likelihood in double precision.
constexpr double kLeastExponent = -60.0;

constexpr std::array<Feature, 6> kEarlyFeatures{
    Feature::log_count,    Feature::log_share,           Feature::plain_likelihood_to_alternative,
    Feature::share_behind, Feature::log_uncertainty_deg, Feature::log_significance,
};

/// Density of right matches at squared distances, up to a factor, for one scale of the noise.
double mixture_density(double squared, double scale, const Coefficients& coefficients) {
    double density = 0.0;
    for (std::size_t k = 0; k < coefficients.noise_px.size(); ++k) {
        const double sigma = scale * coefficients.noise_px[k];
        const double exponent = -0.5 / (sigma * sigma) * squared;
        if (exponent > kLeastExponent) {
            density += coefficients.noise_weights[k] / sigma * std::exp(exponent);
        }
    }
    return density;
}

/// log(1 + improbability) of seeing `count` where `background` is expected (Poisson, large deviations).
double significance(double count, double background) {
    const double expected = background + 0.5;
    return count <= expected ? 0.0 : std::log1p(count * std::log(count / expected) - (count - expected));
}

double logistic(double logit) { return 1.0 / (1.0 + std::exp(-std::clamp(logit, -40.0, 40.0))); }

template <typename Values>
std::size_t position_of_largest(const Values& values) {
    return static_cast<std::size_t>(std::max_element(values.begin(), values.end()) - values.begin());
}

/// Support of each hypothesis: sum of weight times 1 - (d / width)^2 over the matches within the width and in front.
std::vector<double> supports(const std::vector<Residuals>& residuals, const std::vector<double>& weights,
                             double width) {
    std::vector<double> sums;
    for (const Residuals& residual : residuals) {
        double sum = 0.0;
        for (std::size_t i = 0; i < weights.size(); ++i) {
            const double relative = residual.distance_px[i] / width;
            sum += residual.behind[i] != 0 ? 0.0 : weights[i] * std::max(1.0 - relative * relative, 0.0);
        }
        sums.push_back(sum);
    }
    return sums;
}

std::vector<double> checked(const Json& values, const char* name, std::size_t count) {
    if (!values.has(name)) {
        throw std::invalid_argument(std::string(name) + " is missing");
    }
    std::vector<double> numbers = values[name].numbers();
    if (numbers.empty() || (count != 0 && numbers.size() != count)) {
        throw std::invalid_argument(std::string(name) + ": expected " + (count == 0 ? "some" : std::to_string(count)) +
                                    " finite numbers, got " + std::to_string(numbers.size()));
    }
    return numbers;
}

/// What a match that is right with a probability stakes on it.
std::vector<double> odds_of(const std::vector<double>& probability, const Coefficients& coefficients) {
    std::vector<double> odds;
    odds.reserve(probability.size());
    for (const double p : probability) {
        odds.push_back(coefficients.outlier_width_px[0] * std::sqrt(2.0 / CV_PI) * p / (1.0 - p));
    }
    return odds;
}

/// Log-likelihood ratio of a hypothesis against all matches being wrong, for a scale of the noise.
double log_likelihood(const Residuals& residual, const std::vector<double>& odds, double scale,
                      const Coefficients& coefficients, const std::vector<double>& counts) {
    double sum = 0.0;
    for (std::size_t i = 0; i < odds.size(); ++i) {
        const double squared = residual.distance_px[i] * residual.distance_px[i];
        const double density = mixture_density(squared, scale, coefficients);
        if (density > 0.0) {
            const double sign = residual.behind[i] != 0 ? coefficients.seen_behind[0] : 1.0;
            sum += counts[i] * std::log1p(odds[i] * sign * density);
        }
    }
    return sum;
}

}  // namespace

Coefficients Coefficients::read(const Json& values) {
    Coefficients c;
    c.score_trust = checked(values, "score_trust", 3);
    c.noise_px = checked(values, "noise_px", 0);
    c.noise_weights = checked(values, "noise_weights", c.noise_px.size());
    c.noise_scales = checked(values, "noise_scales", 0);
    c.outlier_width_px = checked(values, "outlier_width_px", 1);
    c.seen_behind = checked(values, "seen_behind", 1);
    c.support_weight = checked(values, "support_weight", 1);
    c.crowding = checked(values, "crowding", 2);
    c.early_end = checked(values, "early_end", 5);
    c.settled = checked(values, "settled", 3);
    c.verdict = checked(values, "verdict", 2);
    c.confidence = checked(values, "confidence", kFeatureCount + 1);
    c.early_confidence = checked(values, "early_confidence", kEarlyFeatures.size() + 1);
    return c;
}

std::size_t Residuals::explained(double reach_px) const {
    std::size_t count = 0;
    for (std::size_t i = 0; i < distance_px.size(); ++i) {
        count += explains(i, reach_px) ? 1 : 0;
    }
    return count;
}

Residuals measure_residuals(const Correspondences& matches, const Pose& pose, double focal_px) {
    Residuals residuals;
    residuals.distance_px.reserve(matches.size());
    residuals.behind.reserve(matches.size());
    const double* R = pose.R.val;
    const double t0 = pose.t[0], t1 = pose.t[1], t2 = pose.t[2];
    const double least_parallax = (kMinParallaxPx / focal_px) * (kMinParallaxPx / focal_px);
    for (const Correspondence& match : matches) {
        const double x1 = match[0], y1 = match[1], x2 = match[2], y2 = match[3];
        const double r0 = R[0] * x1 + R[1] * y1 + R[2], r1 = R[3] * x1 + R[4] * y1 + R[5],
                     r2 = R[6] * x1 + R[7] * y1 + R[8];
        const double l0 = t1 * r2 - t2 * r1, l1 = t2 * r0 - t0 * r2, l2 = t0 * r1 - t1 * r0;
        const double error = l0 * x2 + l1 * y2 + l2;
        const double n0 = y2 * t2 - t1, n1 = t0 - x2 * t2, n2 = x2 * t1 - y2 * t0;
        const double m0 = R[0] * n0 + R[3] * n1 + R[6] * n2, m1 = R[1] * n0 + R[4] * n1 + R[7] * n2;
        const double squared_norm =
            std::max(l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1, std::numeric_limits<double>::min());
        residuals.distance_px.push_back(std::abs(error) * (focal_px / std::sqrt(squared_norm)));
        // A rotation keeps the length of a ray.
        const double aa = x1 * x1 + y1 * y1 + 1.0, bb = x2 * x2 + y2 * y2 + 1.0, ab = r0 * x2 + r1 * y2 + r2;
        const double at = r0 * t0 + r1 * t1 + r2 * t2, bt = x2 * t0 + y2 * t1 + t2;
        const bool parallax = aa * bb - ab * ab > least_parallax * aa * bb;
        residuals.behind.push_back(parallax && (ab * bt < bb * at || aa * bt < ab * at) ? 1 : 0);
    }
    return residuals;
}

double pose_angle_deg(const Pose& a, const Pose& b) {
    double trace = 0.0;
    for (int i = 0; i < 9; ++i) {
        trace += a.R.val[i] * b.R.val[i];
    }
    const double cosine = std::min(0.5 * (trace - 1.0), std::abs(a.t.dot(b.t)));
    return std::acos(std::clamp(cosine, -1.0, 1.0)) * 180.0 / CV_PI;
}

double score_prior(double score, const Coefficients& coefficients) {
    const std::vector<double>& trust = coefficients.score_trust;
    return std::min(trust[0] * std::pow(score, trust[1]) + trust[2], kLargestPrior);
}

std::vector<double> independent_counts(const Correspondences& matches, const std::vector<double>& weights,
                                       const Coefficients& coefficients) {
    if (matches.empty()) {
        return {};
    }
    const double side = coefficients.crowding[0], power = coefficients.crowding[1];
    Correspondence low = matches.front(), high = matches.front();
    for (const Correspondence& match : matches) {
        for (int k = 0; k < 4; ++k) {
            low[k] = std::min(low[k], match[k]);
            high[k] = std::max(high[k], match[k]);
        }
    }
    const double diagonal1 = std::hypot(high[0] - low[0], high[1] - low[1]);
    const double diagonal2 = std::hypot(high[2] - low[2], high[3] - low[3]);
    std::map<std::array<std::int64_t, 4>, double> sums;
    std::vector<std::array<std::int64_t, 4>> cells;
    for (std::size_t i = 0; i < matches.size(); ++i) {
        std::array<std::int64_t, 4>& cell = cells.emplace_back();
        for (int k = 0; k < 4; ++k) {
            const double width = side * std::max(k < 2 ? diagonal1 : diagonal2, kTiny);
            cell[static_cast<std::size_t>(k)] = static_cast<std::int64_t>(std::floor((matches[i][k] - low[k]) / width));
        }
        sums[cell] += weights[i];
    }
    std::vector<double> counts;
    for (const std::array<std::int64_t, 4>& cell : cells) {
        counts.push_back(std::pow(std::max(sums[cell], 1.0), -power));
    }
    return counts;
}

std::vector<std::vector<double>> log_likelihoods(const std::vector<Residuals>& residuals,
                                                 const std::vector<double>& probability,
                                                 const Coefficients& coefficients, const std::vector<double>& counts) {
    const std::vector<double> odds = odds_of(probability, coefficients);
    std::vector<std::vector<double>> likelihoods;
    for (const Residuals& residual : residuals) {
        std::vector<double>& row = likelihoods.emplace_back();
        for (const double scale : coefficients.noise_scales) {
            row.push_back(log_likelihood(residual, odds, scale, coefficients, counts));
        }
    }
    return likelihoods;
}

std::vector<double> support_bonus(const std::vector<Residuals>& residuals, const std::vector<double>& weights,
                                  const Coefficients& coefficients, std::size_t matches) {
    std::vector<double> mean(residuals.size(), 0.0);
    const double total = std::accumulate(kSupportWeights.begin(), kSupportWeights.end(), 0.0);
    for (std::size_t k = 0; k < kSupportPx.size(); ++k) {
        const std::vector<double> sums = supports(residuals, weights, kSupportPx[k]);
        const double largest = std::max(*std::max_element(sums.begin(), sums.end()), kTiny);
        for (std::size_t h = 0; h < sums.size(); ++h) {
            mean[h] += kSupportWeights[k] / total * sums[h] / largest;
        }
    }
    const double factor = coefficients.support_weight[0] * std::pow(static_cast<double>(matches), 1.5);
    std::transform(mean.begin(), mean.end(), mean.begin(),
                   [factor](double value) { return factor * std::log(std::max(value, kTiny)); });
    return mean;
}

Judgement judge_hypotheses(const Correspondences& matches, const std::optional<std::vector<double>>& scores,
                           const std::vector<Hypothesis>& hypotheses, double focal_px,
                           const std::vector<Pose>& network_poses, const Coefficients& coefficients) {
    const std::size_t count = matches.size(), number_of_hypotheses = hypotheses.size();
    std::vector<Residuals> residuals;
    std::size_t most_inliers = 0;
    std::vector<std::size_t> inliers;
    for (const Hypothesis& hypothesis : hypotheses) {
        const Residuals& residual = residuals.emplace_back(measure_residuals(matches, hypothesis.pose, focal_px));
        inliers.push_back(residual.explained());
        most_inliers = std::max(most_inliers, inliers.back());
    }
    const double share =
        std::clamp(static_cast<double>(most_inliers) / static_cast<double>(std::max<std::size_t>(count, 1)), kMinShare,
                   kMaxShare);
    const std::vector<double> weights = scores ? *scores : std::vector<double>(count, share);
    const std::vector<double> counts = independent_counts(matches, weights, coefficients);
    const auto plain_by_scale = log_likelihoods(residuals, std::vector<double>(count, share), coefficients, counts);
    auto by_scale = plain_by_scale;
    std::vector<double> probability(count, share);
    if (scores) {
        std::transform(weights.begin(), weights.end(), probability.begin(),
                       [&](double score) { return score_prior(score, coefficients); });
        by_scale = log_likelihoods(residuals, probability, coefficients, counts);
    }
    // One scale for all hypotheses: that of the most likely one.
    std::vector<double> best_by_scale(coefficients.noise_scales.size(), -std::numeric_limits<double>::infinity());
    for (const std::vector<double>& row : by_scale) {
        for (std::size_t s = 0; s < row.size(); ++s) {
            best_by_scale[s] = std::max(best_by_scale[s], row[s]);
        }
    }
    const std::size_t column = position_of_largest(best_by_scale);
    std::vector<double> likelihood, plain;
    for (std::size_t h = 0; h < number_of_hypotheses; ++h) {
        likelihood.push_back(by_scale[h][column]);
        plain.push_back(plain_by_scale[h][column]);
    }
    std::vector<double> merit = likelihood;
    std::vector<double> counted = weights;
    for (std::size_t i = 0; i < count; ++i) {
        counted[i] *= counts[i];
    }
    const std::vector<double> bonus = support_bonus(residuals, counted, coefficients, count);
    const std::vector<double> whole_bonus = support_bonus(residuals, weights, coefficients, count);
    for (std::size_t h = 0; h < number_of_hypotheses; ++h) {
        merit[h] += bonus[h];
    }
    // Crowded matches count less for one answer against another; between hypotheses of one answer, and near ties, all
    // matches tell the best.
    const std::size_t answer = position_of_largest(merit);
    const std::vector<double> odds = odds_of(probability, coefficients), once_each(count, 1.0);
    const double scale = coefficients.noise_scales[column];
    std::vector<double> whole_merit(number_of_hypotheses, -std::numeric_limits<double>::infinity());
    for (std::size_t h = 0; h < number_of_hypotheses; ++h) {
        const double angle = pose_angle_deg(hypotheses[h].pose, hypotheses[answer].pose);
        if (angle < kAlternativeDeg || merit[h] > merit[answer] - kTie) {
            whole_merit[h] = log_likelihood(residuals[h], odds, scale, coefficients, once_each) + whole_bonus[h];
        }
    }
    const std::size_t chosen = position_of_largest(whole_merit);
    const std::vector<double> support = supports(residuals, weights, 1.0);

    std::vector<double> angles;
    for (const Hypothesis& hypothesis : hypotheses) {
        angles.push_back(pose_angle_deg(hypothesis.pose, hypotheses[chosen].pose));
    }
    const auto gap = [&](const std::vector<double>& values) {
        double best_alternative = -std::numeric_limits<double>::infinity();
        for (std::size_t h = 0; h < number_of_hypotheses; ++h) {
            if (angles[h] > kAlternativeDeg) {
                best_alternative = std::max(best_alternative, values[h]);
            }
        }
        return values[chosen] - (std::isfinite(best_alternative) ? best_alternative : 0.0);
    };
    const auto other_families = [&](double limit) {
        std::set<Family> families;
        for (std::size_t h = 0; h < number_of_hypotheses; ++h) {
            if (hypotheses[h].family != hypotheses[chosen].family && angles[h] < limit) {
                families.insert(hypotheses[h].family);
            }
        }
        return static_cast<double>(families.size());
    };
    double to_network = 180.0;
    for (const Pose& pose : network_poses) {
        to_network = std::min(to_network, pose_angle_deg(hypotheses[chosen].pose, pose));
    }

    const Pose& pose = hypotheses[chosen].pose;
    const Residuals& residual = residuals[chosen];
    double around = 0.0, weighted_around = 0.0, weighted = 0.0, sum_of_weights = 0.0;
    std::size_t everything_near = 0;
    double near_two = 0.0;
    Correspondences firm;
    for (std::size_t i = 0; i < count; ++i) {
        const double distance = residual.distance_px[i];
        const bool front = residual.behind[i] == 0;
        sum_of_weights += weights[i];
        if (distance > kBackgroundLowPx && distance < kBackgroundHighPx) {
            around += 1.0;
            weighted_around += weights[i];
        }
        everything_near += distance < kInlierPx ? 1 : 0;
        weighted += distance < kInlierPx && front ? weights[i] : 0.0;
        near_two += distance < 2.0 && front ? counts[i] : 0.0;
        if (distance < 3.0 * kNoisePx * scale && front) {
            firm.push_back(matches[i]);
        }
    }
    const double width = kBackgroundHighPx - kBackgroundLowPx;
    const double number = static_cast<double>(inliers[chosen]), all = static_cast<double>(count);
    const double spread = pose_uncertainty_deg(firm, pose, kNoisePx * scale / focal_px);

    Judgement judgement;
    judgement.chosen = chosen;
    judgement.scale = scale;
    const auto set = [&](Feature feature, double value) {
        judgement.features[static_cast<std::size_t>(feature)] = value;
    };
    set(Feature::log_count, std::log(number + 1.0));
    set(Feature::log_weighted_count, std::log(weighted + 1.0));
    set(Feature::log_share, std::log((number + 1.0) / (all + 2.0)));
    set(Feature::log_weighted_share, std::log((weighted + 0.1) / (sum_of_weights + 0.2)));
    set(Feature::log_significance, significance(number, around / width));
    set(Feature::log_weighted_significance, significance(weighted, weighted_around / width));
    set(Feature::likelihood_per_inlier, likelihood[chosen] / (near_two + 5.0));
    set(Feature::likelihood_to_alternative, std::asinh(gap(likelihood) / kGapUnit));
    set(Feature::plain_likelihood_to_alternative, std::asinh(gap(plain) / kGapUnit));
    set(Feature::support_to_alternative, std::asinh(gap(support) / kGapUnit));
    set(Feature::plain_likelihood_to_best,
        std::asinh((plain[chosen] - *std::max_element(plain.begin(), plain.end())) / kGapUnit));
    set(Feature::weighted_support_to_best,
        std::asinh((support[chosen] - *std::max_element(support.begin(), support.end())) / kGapUnit));
    set(Feature::share_behind, 1.0 - number / static_cast<double>(std::max<std::size_t>(everything_near, 1)));
    set(Feature::near_network_3_deg, std::exp(-to_network / 3.0));
    set(Feature::near_network_10_deg, std::exp(-to_network / 10.0));
    set(Feature::no_network, network_poses.empty() ? 1.0 : 0.0);
    set(Feature::other_families_2_deg, other_families(kAgreementDeg[0]));
    set(Feature::other_families_5_deg, other_families(kAgreementDeg[1]));
    set(Feature::other_families_10_deg, other_families(kAgreementDeg[2]));
    set(Feature::log_scale, std::log(scale));
    set(Feature::log_matches, std::log(all + 1.0));
    set(Feature::log_sum_of_scores, std::log(sum_of_weights + 1.0));
    set(Feature::log_uncertainty_deg, std::log(spread));
    return judgement;
}

double confidence(const Judgement& judgement, const Coefficients& coefficients) {
    double logit = coefficients.confidence.back();
    for (std::size_t k = 0; k < kFeatureCount; ++k) {
        logit += judgement.features[k] * coefficients.confidence[k];
    }
    return logistic(logit);
}

double early_confidence(const Judgement& judgement, const Coefficients& coefficients) {
    double logit = coefficients.early_confidence.back();
    for (std::size_t k = 0; k < kEarlyFeatures.size(); ++k) {
        logit += judgement[kEarlyFeatures[k]] * coefficients.early_confidence[k];
    }
    return logistic(logit);
}

bool explains_list(const Judgement& judgement, const Coefficients& coefficients) {
    const std::vector<double>& rule = coefficients.early_end;
    return judgement[Feature::log_share] > std::log(rule[0]) && judgement[Feature::log_count] > std::log(rule[1]) &&
           judgement[Feature::share_behind] < rule[2] && judgement[Feature::log_uncertainty_deg] < std::log(rule[3]) &&
           judgement[Feature::plain_likelihood_to_alternative] > std::asinh(rule[4] / kGapUnit);
}

std::vector<double> posterior(const Residuals& residuals, const std::vector<Mask>& groups, double scale,
                              const Coefficients& coefficients) {
    const std::size_t count = residuals.distance_px.size();
    std::vector<double> ratio, probability(count, 0.0);
    for (std::size_t i = 0; i < count; ++i) {
        const double squared = residuals.distance_px[i] * residuals.distance_px[i];
        const double density = std::sqrt(2.0 / CV_PI) * mixture_density(squared, scale, coefficients);
        ratio.push_back(coefficients.outlier_width_px[0] * density *
                        (residuals.behind[i] != 0 ? coefficients.seen_behind[0] : 1.0));
    }
    for (const Mask& group : groups) {
        const auto members = static_cast<double>(std::count(group.begin(), group.end(), 1));
        double share = 0.5;
        for (int round = 0; round < kShareRounds && members > 0.0; ++round) {
            double sum = 0.0;
            for (std::size_t i = 0; i < count; ++i) {
                if (group[i] != 0) {
                    const double odds = share / (1.0 - share) * ratio[i];
                    probability[i] = odds / (1.0 + odds);
                    sum += probability[i];
                }
            }
            share = std::clamp(sum / members, kLeastShare, kLargestShare);
        }
    }
    return probability;
}

}  // namespace mgca::detail
