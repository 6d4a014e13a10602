#include "verdict.hpp"

#include "degeneracy.hpp"
#include "focal_check.hpp"
#include "homography.hpp"
#include "homography_fit.hpp"
#include "pose_refinement.hpp"
#include "statistics.hpp"

#include <algorithm>
#include <numeric>
#include <utility>

namespace mgca::detail {
namespace {

// The fundamental matrix that may contradict the intrinsics: a run on few, well-chosen matches.
constexpr double kFundamentalThresholdPx = 1.0;
constexpr int kFundamentalIterations = 1000;
// A plane in doubt is looked for quickly first, at a generous threshold.
constexpr double kQuickPlanePx = 3.0, kPlanePx = 2.0;
// A plane on which fewer of the inliers lie is one of several of a scene with depth. Where the matches off it have fewer
// false alarms, log10, no other plane explains the pair.
constexpr double kLeastPlaneShare = 0.7, kClearParallaxLog10Nfa = -20.0;
// Inliers that are hardly more than a pose takes must be this share of the list, which else holds as many by chance.
constexpr double kFewShare = 2.0 / 3.0;

Correspondences valid_matches(const PairInput& pair) {
    Correspondences valid;
    for (std::size_t i = 0; i < pair.valid.size(); ++i) {
        if (pair.valid[i] != 0) {
            valid.push_back(pair.correspondences[i]);
        }
    }
    return valid;
}

/// True where the distinct matches are fewer than a pose takes, or, without intrinsics, a fundamental matrix.
bool too_few(const PairInput& pair) {
    return distinct_rows(valid_matches(pair)).size() < (pair.calibrated() ? kMinMatches : kFirmMatches);
}

Correspondences in_pixels(const PairInput& pair, const Correspondences& matches) {
    Correspondences pixels;
    for (const Correspondence& match : matches) {
        pixels.push_back(pair.pixels(match));
    }
    return pixels;
}

/// Mask of all matches from the distances of the valid ones.
Mask mask_within(const PairInput& pair, const std::vector<double>& distances, double threshold) {
    Mask mask(pair.valid.size(), 0);
    std::size_t k = 0;
    for (std::size_t i = 0; i < mask.size(); ++i) {
        if (pair.valid[i] != 0) {
            mask[i] = distances[k++] < threshold ? 1 : 0;
        }
    }
    return mask;
}

/// Positions, among the witnesses, of the matches that agree with the model.
Rows near_rows(const Evidence& evidence, const Rows& witnesses, const cv::Matx33d& M, double threshold) {
    Rows near;
    for (const std::size_t position : witnesses) {
        if (sampson_distance(evidence.correspondences[position], M) < threshold) {
            near.push_back(position);
        }
    }
    return near;
}

bool lie_on_a_line(const Correspondences& inliers, double threshold, const Support& support) {
    for (const int image : {0, 2}) {
        std::vector<cv::Point2d> points;
        for (const Correspondence& match : inliers) {
            points.emplace_back(match[image], match[image + 1]);
        }
        if (explains(line_distances(points, threshold), threshold, support)) {
            return true;
        }
    }
    return false;
}

/// True where F, which knows no intrinsics, explains far more of the matches than the caller's allow.
bool contradicts_intrinsics(const PairInput& pair, const Correspondences& fitted, const Support& support,
                            const Options& options) {
    if (!pair.calibrated() || 2 * static_cast<std::size_t>(support.count) >= fitted.size()) {
        return false;
    }
    EstimatorOptions run;
    run.method = Estimator::prosac;
    run.threshold_px = kFundamentalThresholdPx;
    run.confidence = options.confidence;
    run.max_iterations = kFundamentalIterations;
    run.seed = options.seed;
    const auto F = fit_epipolar(fitted, pair.focal_px(), run, false);
    if (!F) {
        return false;
    }
    const Support free = measure_support(fitted, *F, kRefinePx / pair.focal_px());
    return free.count >= kIntrinsicsSupportFactor * support.count + kMinSupport &&
           free.log10_nfa < kLowSupportLog10Nfa;
}

/// Whether the model is to be withheld, and whether it is doubtful. The confidence decides; a fundamental matrix, which
/// has none, must be more than chance.
std::pair<bool, bool> doubts(const TwoViewModel& model, const Support& support, bool weak,
                             const Coefficients& coefficients) {
    if (model.confidence) {
        return {*model.confidence < coefficients.verdict[0], *model.confidence < coefficients.verdict[1]};
    }
    return {support.log10_nfa > kUnrelatedLog10Nfa, weak};
}

/// The model as it is, with the mask of all matches.
void keep_model(const PairInput& pair, const TwoViewModel& model, double mask_threshold_px, Verdict& verdict) {
    const cv::Matx33d F = fundamental_from_essential(model.M, pair.intrinsics1.K, pair.intrinsics2.K);
    verdict.mask.assign(pair.valid.size(), 0);
    for (std::size_t i = 0; i < pair.valid.size(); ++i) {
        if (pair.valid[i] != 0) {
            const double distance_px = pair.calibrated() ? pair.epipolar_distance_px(i, model.M)
                                                         : sampson_distance(pair.pixels(pair.correspondences[i]), F);
            verdict.mask[i] = distance_px < mask_threshold_px ? 1 : 0;
        }
    }
    verdict.E = model.E;
    verdict.F = pair.fundamental_in_units(F);
    verdict.R = model.pose.R;
    verdict.t = model.pose.t;
    verdict.status = Status::ok;
}

/// A homography of the pixels as the model, with the mask of all matches.
void keep_homography(const PairInput& pair, const cv::Matx33d& H, Status status, double mask_threshold_px,
                     Verdict& verdict) {
    const auto distances = sampson_distances_to_homography(in_pixels(pair, valid_matches(pair)), H);
    verdict.mask = mask_within(pair, distances, mask_threshold_px);
    verdict.status = status;
    verdict.E.reset();
    verdict.F.reset();
    verdict.R.reset();
    verdict.t.reset();
    verdict.H = pair.homography_in_units(H);
}

/// Change the verdict and return true where a rotation alone explains as many matches, so that they say nothing of a
/// translation.
///
/// @param fitted what bears witness. inliers: those that agree with the model.
bool test_rotation(const PairInput& pair, const TwoViewModel& model, const Correspondences& fitted,
                   const Correspondences& inliers, const Support& support, double mask_threshold_px, Verdict& verdict) {
    const cv::Matx33d R = fit_rotation(inliers, kRefinePx / pair.focal_px());
    const cv::Matx33d H = pair.intrinsics2.K * R * pair.intrinsics1.K.inv();
    // Of a zoom both in pixels, whose noise is that of the keypoints in either image.
    const Correspondences pixels = in_pixels(pair, fitted);
    const std::vector<double> rotation_px = sampson_distances_to_homography(pixels, H);
    if (!explains(rotation_px, kRefinePx, support, kDirectionFreedom)) {
        return false;
    }
    // All of them, for those that agree with the model are chosen by how little noise they have along one direction.
    const cv::Matx33d F = fundamental_from_essential(model.M, pair.intrinsics1.K, pair.intrinsics2.K);
    if (pair.calibrated() && !prefers_rotation(rotation_px, sampson_distances(pixels, F))) {
        return false;
    }
    keep_homography(pair, H, Status::pure_rotation, mask_threshold_px, verdict);
    verdict.R = R;
    return true;
}

HomographyOptions plane_options(const Options& options) {
    HomographyOptions result;
    result.threshold = kPlanePx;
    result.confidence = options.confidence;
    result.seed = options.seed;
    return result;
}

/// The homography after least squares on all matches that agree with it: also on those that the network did not see,
/// which hardly meet a homography by accident.
cv::Matx33d polished_on_all(const PairInput& pair, const cv::Matx33d& H, const Options& options) {
    return polish_homography(in_pixels(pair, valid_matches(pair)), H, plane_options(options));
}

/// The homography of the pixels that the matches support best, before that.
std::optional<cv::Matx33d> supported_homography(const PairInput& pair, const Evidence& evidence,
                                                const Options& options) {
    return estimate_homography(in_pixels(pair, evidence.correspondences), plane_options(options),
                               evidence.network ? evidence.network->scores : std::vector<double>{});
}

/// The same after it; the given one where none is found.
cv::Matx33d best_homography(const PairInput& pair, const Evidence& evidence, const Options& options,
                            const cv::Matx33d& quick) {
    const auto H = supported_homography(pair, evidence, options);
    return H ? polished_on_all(pair, *H, options) : quick;
}

/// The verdict with the homography that explains the inliers as well, where there is one: nearly all of them; or most,
/// and the others are no more than what an epipolar model, which is free to move about a plane, gathers by accident.
///
/// @param fitted what bears witness. inliers: those that agree with the model.
void test_plane(const PairInput& pair, const TwoViewModel& model, const Evidence& evidence,
                const Correspondences& fitted, const Correspondences& inliers, const Support& support,
                const Options& options, Verdict& verdict) {
    const Correspondences pixels = in_pixels(pair, inliers);
    const auto quick = fit_homography(pixels, kHomographyThresholdFactor * kRefinePx, options.seed);
    if (!quick) {
        return;
    }
    const std::vector<double> distances = homography_distances(pixels, *quick);
    const bool explained = explains(distances, kRefinePx, support);
    const auto near = std::count_if(distances.begin(), distances.end(), [](double distance) {
        return distance < kExplainedThresholdFactor * kRefinePx;
    });
    if (!explained && static_cast<double>(near) < kLeastPlaneShare * static_cast<double>(distances.size())) {
        return;
    }
    std::optional<cv::Matx33d> H;
    if (!explained) {
        const Correspondences witnesses = in_pixels(pair, fitted);
        const cv::Matx33d F = fundamental_from_essential(model.M, pair.intrinsics1.K, pair.intrinsics2.K);
        const double log10_nfa = parallax_false_alarms(witnesses, *quick, F, kRefinePx);
        if (log10_nfa < kClearParallaxLog10Nfa) {
            return;
        }
        if (log10_nfa <= kParallaxLog10Nfa) {
            H = best_homography(pair, evidence, options, *quick);
            if (parallax_false_alarms(witnesses, *H, F, kRefinePx) <= kParallaxLog10Nfa) {
                return;
            }
        }
    }
    verdict.status = Status::planar;
    verdict.H = pair.homography_in_units(H ? *H : polished_on_all(pair, *quick, options));
    if (!pair.calibrated()) {
        // Seven points on a plane leave F a family of solutions: it still sorts matches but holds no pose.
        verdict.E.reset();
        verdict.R.reset();
        verdict.t.reset();
    }
}

/// A plane that explains a pair whose pose is doubtful, more than chance would; else the verdict as it is.
Verdict plane_or(const Verdict& verdict, const PairInput& pair, const Evidence& evidence, double mask_threshold_px,
                 const Options& options) {
    const Correspondences rows = in_pixels(pair, evidence.correspondences);
    const Correspondences sharp = in_pixels(pair, evidence.take(evidence.accepted()));
    const auto quick = fit_homography(sharp, kQuickPlanePx, options.seed, true);
    if (!quick || homography_false_alarms(sharp, *quick, kPlanePx) > kMeaningfulLog10Nfa) {
        return verdict;
    }
    // Beside a pose the plane is a remark.
    const cv::Matx33d H =
        verdict.F ? polished_on_all(pair, *quick, options) : best_homography(pair, evidence, options, *quick);
    const double log10_nfa = homography_false_alarms(rows, H, kPlanePx);
    const std::vector<double> distances = sampson_distances_to_homography(sharp, H);
    const auto agreeing = static_cast<int>(
        std::count_if(distances.begin(), distances.end(), [](double distance) { return distance < kPlanePx; }));
    if (log10_nfa > kMeaningfulLog10Nfa || agreeing < kMinSupport) {
        return verdict;
    }
    Verdict plane = verdict;
    plane.support = agreeing;
    plane.log10_false_alarms = log10_nfa;
    keep_homography(pair, H, Status::planar, mask_threshold_px, plane);
    return plane;
}

}  // namespace

Verdict judge(const PairInput& pair, const std::optional<TwoViewModel>& model, const Evidence& evidence,
              double mask_threshold_px, const Coefficients& coefficients, const Options& options) {
    Verdict verdict;
    verdict.mask.assign(pair.valid.size(), 0);
    if (too_few(pair)) {
        verdict.status = Status::too_few_matches;
        return verdict;
    }
    if (!model) {
        return verdict;
    }
    const double threshold = kRefinePx / pair.focal_px();
    Rows witnesses = evidence.above(0.0);
    Rows near = near_rows(evidence, witnesses, model->M, threshold);
    if (near.size() < kFirmMatches) {
        witnesses.resize(evidence.size());
        std::iota(witnesses.begin(), witnesses.end(), std::size_t{0});
        near = near_rows(evidence, witnesses, model->M, threshold);
    }
    const bool doubted =
        !pair.calibrated() || static_cast<double>(near.size()) < kFewShare * static_cast<double>(witnesses.size());
    if (near.size() < (doubted ? kFirmMatches : kMinMatches)) {
        return plane_or(verdict, pair, evidence, mask_threshold_px, options);
    }
    const Correspondences fitted = evidence.take(witnesses), inliers = evidence.take(near);
    const Support support = measure_support(fitted, model->M, threshold);
    if (lie_on_a_line(inliers, threshold, support)) {
        return verdict;
    }
    verdict.support = support.count;
    verdict.log10_false_alarms = support.log10_nfa;
    const bool weak = support.count < kMinSupport || support.log10_nfa > kLowSupportLog10Nfa;
    if (!weak && test_rotation(pair, *model, fitted, inliers, support, mask_threshold_px, verdict)) {
        return verdict;
    }
    const bool suspicious = contradicts_intrinsics(pair, fitted, support, options);
    auto [withheld, doubtful] = doubts(*model, support, weak, coefficients);
    doubtful = doubtful || near.size() < kFirmMatches;
    if (withheld && !suspicious) {
        verdict.status = Status::unrelated;
        return plane_or(verdict, pair, evidence, mask_threshold_px, options);
    }
    const double residual = median(sampson_distances(inliers, model->M));
    const double noise = std::max(kToSigma * residual, kLeastNoisePx / pair.focal_px());
    verdict.translation_sigma_deg = direction_uncertainty_deg(inliers, model->pose, noise);
    keep_model(pair, model->answer(), mask_threshold_px, verdict);
    if (suspicious) {
        verdict.status = Status::suspicious_intrinsics;
        return verdict;
    }
    if (doubtful) {
        verdict.H = plane_or(verdict, pair, evidence, mask_threshold_px, options).H;
        verdict.status = Status::low_support;
        return verdict;
    }
    test_plane(pair, *model, evidence, fitted, inliers, support, options, verdict);
    if (pair.calibrated()) {
        verdict.focal_factor = better_focal_factor(fitted, model->pose, threshold);
        if (verdict.focal_factor) {
            verdict.status = Status::suspicious_intrinsics;
        }
    }
    return verdict;
}

Verdict judge_homography(const PairInput& pair, const Evidence& evidence, double mask_threshold_px,
                         const Options& options) {
    Verdict verdict;
    verdict.mask.assign(pair.valid.size(), 0);
    if (distinct_rows(valid_matches(pair)).size() < 4) {
        verdict.status = Status::too_few_matches;
        return verdict;
    }
    const auto H = supported_homography(pair, evidence, options);
    if (!H) {
        return verdict;
    }
    // The best by score first: chance is counted on the heads of the list.
    Rows order(evidence.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    if (evidence.network) {
        const std::vector<double>& scores = evidence.network->scores;
        std::stable_sort(order.begin(), order.end(),
                         [&](std::size_t a, std::size_t b) { return scores[a] > scores[b]; });
    }
    const PlaneSupport support = plane_support(in_pixels(pair, evidence.take(order)), *H, kPlanePx);
    verdict.support = support.count;
    verdict.log10_false_alarms = support.log10_nfa;
    verdict.status = Status::unrelated;
    if (support.log10_nfa < kMeaningfulLog10Nfa) {
        keep_homography(pair, polished_on_all(pair, *H, options), Status::ok, mask_threshold_px, verdict);
    }
    return verdict;
}

Verdict verdict_by_scores(const PairInput& pair, Mask kept) {
    Verdict verdict;
    if (too_few(pair)) {
        verdict.status = Status::too_few_matches;
        verdict.mask.assign(kept.size(), 0);
        return verdict;
    }
    const auto count = static_cast<std::size_t>(std::count(kept.begin(), kept.end(), 1));
    verdict.status = count >= kFirmMatches ? Status::ok : Status::low_support;
    verdict.mask = std::move(kept);
    return verdict;
}

}  // namespace mgca::detail
