// Do the matches agree with the focal length? The pose is refined under longer and shorter ones as well;
// mgca_filter/fit/focal_check.py.

#pragma once

#include "epipolar.hpp"

#include <optional>

namespace mgca::detail {

/// The factor on both focal lengths under which the matches agree markedly better; nothing = those given will do.
///
/// @param matches on the normalised image planes of the given intrinsics, the most promising first.
/// @param threshold Sampson distance where the error is cut off, normalised.
std::optional<double> better_focal_factor(const Correspondences& matches, const Pose& pose, double threshold);

}  // namespace mgca::detail
