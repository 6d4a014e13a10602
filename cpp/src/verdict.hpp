// From the fitted model to the answer: mask, matrices and status of a pair; mgca_filter/fit/verdict.py.

#pragma once

#include "pair.hpp"
#include "robust_fit.hpp"

#include <mgca/filter.hpp>

#include <optional>

namespace mgca::detail {

/// Status of a pair and what is left of its model; fields as in Result.
struct Verdict {
    Status status = Status::no_geometry;
    Mask mask;
    std::optional<cv::Matx33d> E, F, R;
    std::optional<cv::Vec3d> t;
    std::optional<cv::Matx33d> H;
    std::optional<int> support;
    std::optional<double> log10_false_alarms, focal_factor, translation_sigma_deg;
    bool mirrored = false;
};

/// Re-test all matches against the model and decide what it is worth.
///
/// @param evidence what the model was fitted to; what the network accepts bears witness.
Verdict judge(const PairInput& pair, const std::optional<TwoViewModel>& model, const Evidence& evidence,
              double mask_threshold_px, const Coefficients& coefficients, const Options& options);

/// The answer where the caller asks for a homography: the one that the matches support best, if it is no chance.
Verdict judge_homography(const PairInput& pair, const Evidence& evidence, double mask_threshold_px,
                         const Options& options);

/// Answer without a robust fit: the mask is the network's opinion, and there is no geometry to judge.
Verdict verdict_by_scores(const PairInput& pair, Mask kept);

}  // namespace mgca::detail
