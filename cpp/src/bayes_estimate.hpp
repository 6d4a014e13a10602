// The pose that is expected to lie nearest to the truth, where the matches leave that open;
// mgca_filter/fit/bayes_estimate.py.

#pragma once

#include "choice.hpp"

#include <optional>
#include <vector>

namespace mgca::detail {

/// The pose, of all that are drawn around the hypotheses, that is expected to lie nearest to the truth; nothing where the
/// matches hold no hypothesis, or no pose explains enough of them.
///
/// @param matches each keypoint once. scores: probabilities of the matches.
/// @param hypotheses at least one. scale: of the noise, as the choice found it.
std::optional<Pose> expected_best(const Correspondences& matches, const std::vector<double>& scores,
                                  const std::vector<Pose>& hypotheses, double scale, double focal_px,
                                  const Coefficients& coefficients);

}  // namespace mgca::detail
