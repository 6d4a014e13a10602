#include "verdict.hpp"

#include "degeneracy.hpp"
#include "focal_check.hpp"
#include "homography.hpp"

#include <algorithm>
#include <numeric>
#include <utility>

namespace mgca::detail {
namespace {

// The fundamental matrix that may contradict the intrinsics: a run on few, well-chosen matches.
constexpr double kFundamentalThresholdPx = 1.0;
constexpr int kFundamentalIterations = 1000;

Correspondences valid_matches(const PairInput& pair) {
    Correspondences valid;
    for (std::size_t i = 0; i < pair.valid.size(); ++i) {
        if (pair.valid[i] != 0) {
            valid.push_back(pair.correspondences[i]);
        }
    }
    return valid;
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
std::pair<bool, bool> doubts(const TwoViewModel& model, const Support& support, const Coefficients& coefficients) {
    if (model.confidence) {
        return {*model.confidence < coefficients.verdict[0], *model.confidence < coefficients.verdict[1]};
    }
    const bool few = support.count < kMinSupport || support.log10_nfa > kLowSupportLog10Nfa;
    return {support.log10_nfa > kUnrelatedLog10Nfa, few};
}

/// The model as it is, with the mask of all matches.
void keep_model(const PairInput& pair, const TwoViewModel& model, double mask_threshold_px, Verdict& verdict) {
    const cv::Matx33d F = fundamental_from_essential(model.M, pair.intrinsics1.K, pair.intrinsics2.K);
    const Correspondences valid = valid_matches(pair);
    std::vector<double> distances;
    if (pair.calibrated()) {
        distances = sampson_distances(valid, model.M);
        for (double& distance : distances) {
            distance *= pair.focal_px();
        }
    } else {
        distances = sampson_distances(in_pixels(pair, valid), F);
    }
    verdict.mask = mask_within(pair, distances, mask_threshold_px);
    verdict.E = model.E;
    verdict.F = pair.fundamental_in_units(F);
    verdict.R = model.pose.R;
    verdict.t = model.pose.t;
    verdict.status = Status::ok;
}

/// Replace the verdict where a rotation or a plane explains the inliers as well.
void test_degenerate(const PairInput& pair, const Correspondences& inliers, const Support& support,
                     double mask_threshold_px, int seed, Verdict& verdict) {
    const Correspondences pixels = in_pixels(pair, inliers);
    const cv::Matx33d R = fit_rotation(inliers, kRefinePx / pair.focal_px());
    const cv::Matx33d H = pair.intrinsics2.K * R * pair.intrinsics1.K.inv();
    if (explains(homography_distances(pixels, H), kRefinePx, support)) {
        const auto distances = homography_distances(in_pixels(pair, valid_matches(pair)), H);
        verdict.status = Status::pure_rotation;
        verdict.mask = mask_within(pair, distances, mask_threshold_px);
        verdict.E.reset();
        verdict.F.reset();
        verdict.t.reset();
        verdict.R = R;
        verdict.H = pair.homography_in_units(H);
        return;
    }
    const auto plane = fit_homography(pixels, kHomographyThresholdFactor * kRefinePx, seed);
    if (plane && explains(homography_distances(pixels, *plane), kRefinePx, support)) {
        verdict.status = Status::planar;
        verdict.H = pair.homography_in_units(*plane);
        if (!pair.calibrated()) {
            // Seven points on a plane leave F a family of solutions: it still sorts matches but holds no pose.
            verdict.E.reset();
            verdict.R.reset();
            verdict.t.reset();
        }
    }
}

}  // namespace

Verdict judge(const PairInput& pair, const std::optional<TwoViewModel>& model, const Evidence& evidence,
              double mask_threshold_px, const Coefficients& coefficients, const Options& options) {
    Verdict verdict;
    verdict.mask.assign(pair.valid.size(), 0);
    if (distinct_rows(valid_matches(pair)).size() < kMinMatches) {
        verdict.status = Status::too_few_matches;
        return verdict;
    }
    if (!model) {
        return verdict;
    }
    const double threshold = kRefinePx / pair.focal_px();
    Rows witnesses = evidence.above(0.0);
    Rows near = near_rows(evidence, witnesses, model->M, threshold);
    if (near.size() < kMinMatches) {
        witnesses.resize(evidence.size());
        std::iota(witnesses.begin(), witnesses.end(), std::size_t{0});
        near = near_rows(evidence, witnesses, model->M, threshold);
    }
    if (near.size() < kMinMatches) {
        return verdict;
    }
    const Correspondences fitted = evidence.take(witnesses), inliers = evidence.take(near);
    const Support support = measure_support(fitted, model->M, threshold);
    if (lie_on_a_line(inliers, threshold, support)) {
        return verdict;
    }
    verdict.support = support.count;
    verdict.log10_false_alarms = support.log10_nfa;
    const bool suspicious = contradicts_intrinsics(pair, fitted, support, options);
    const auto [withheld, doubtful] = doubts(*model, support, coefficients);
    if (withheld && !suspicious) {
        verdict.status = Status::unrelated;
        return verdict;
    }
    keep_model(pair, *model, mask_threshold_px, verdict);
    if (suspicious) {
        verdict.status = Status::suspicious_intrinsics;
        return verdict;
    }
    if (doubtful) {
        verdict.status = Status::low_support;
        return verdict;
    }
    if (pair.calibrated()) {
        verdict.focal_factor = better_focal_factor(fitted, model->pose, threshold);
        if (verdict.focal_factor) {
            verdict.status = Status::suspicious_intrinsics;
            return verdict;
        }
    }
    test_degenerate(pair, inliers, support, mask_threshold_px, options.seed, verdict);
    return verdict;
}

Verdict verdict_by_scores(const PairInput& pair, Mask kept) {
    Verdict verdict;
    if (distinct_rows(valid_matches(pair)).size() < kMinMatches) {
        verdict.status = Status::too_few_matches;
        verdict.mask.assign(kept.size(), 0);
        return verdict;
    }
    const auto count = static_cast<std::size_t>(std::count(kept.begin(), kept.end(), 1));
    verdict.status = count >= kMinMatches ? Status::ok : Status::low_support;
    verdict.mask = std::move(kept);
    return verdict;
}

}  // namespace mgca::detail
