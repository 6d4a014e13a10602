// Focal lengths of both images from their matches alone: those under which a pose agrees best;
// mgca_filter/fit/focal_estimate.py.

#pragma once

#include "evidence.hpp"
#include "robust_fit.hpp"

#include <vector>

namespace mgca::detail {

/// Focal lengths of both images.
struct FocalEstimate {
    cv::Vec2d factors;  // on the guessed ones, of image 1 and 2; equal where both images share the factor
    cv::Vec2d sigmas;   // standard deviations of their logarithms: 0.1 is ten per cent
    double ratio_sigma = 0.0;  // the same of their ratio; where both images share the factor, how surely they do
};

/// The focal lengths under which the matches agree best with a pose, the most plausible first: two different factors
/// where the matches ask for them, then one that both images share; none where the matches are few.
///
/// @param evidence scored matches on the image planes normalised by the guessed focal lengths. F: in the same
/// coordinates.
std::vector<FocalEstimate> estimate_focals(const Evidence& evidence, const cv::Matx33d& F);

/// Standard deviation of a pose, along its worst direction, that comes of the focal lengths' alone, degrees.
///
/// @param evidence, model under the estimated focal lengths.
double pose_sigma_deg(const Evidence& evidence, const TwoViewModel& model, const FocalEstimate& estimate);

/// Probability that a pose is within 10 degrees under focal lengths that are not known but estimated.
///
/// @param confidence of the fit, which takes them for known; the answer is never above it.
/// @param sigma_deg as of pose_sigma_deg.
double confidence_under_estimate(double confidence, double sigma_deg);

/// True where nearly as many matches agree with an essential matrix as with the F that knows no intrinsics.
bool agrees_as_well(const Evidence& evidence, const TwoViewModel& model, const Evidence& free,
                    const TwoViewModel& free_model);

}  // namespace mgca::detail
