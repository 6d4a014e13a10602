// Least squares on the pose: Levenberg-Marquardt on a robust cost of the Sampson errors of all matches;
// mgca_filter/geometry/pose_refinement.py.
//
// The pose has five degrees of freedom: a rotation vector applied on the left of R, and two steps of the unit
// translation on its tangent plane (as PoseLib does; Hartley & Zisserman, 2nd ed., sec. 11.4.3).

#pragma once

#include "epipolar.hpp"

#include <vector>

namespace mgca::detail {

constexpr int kMinRefinedInliers = 6;

using Vec5d = cv::Vec<double, 5>;
using Matx55d = cv::Matx<double, 5, 5>;

/// Refine a pose on the matches within the threshold (Sampson distance, normalised), which are chosen anew in every
/// round; the truncated cost never rises.
Pose refine_pose(const Correspondences& matches, const Pose& start, double threshold, int rounds = 10);

/// Refine a pose by a Cauchy loss: a match counts the less, the farther off it is in terms of its noise; the cost never
/// rises.
///
/// @param scale Sampson distance at which a match counts half, normalised. weights: what it counts beside, above 0.
/// @param reach Sampson distance beyond which matches are left out, normalised.
Pose refine_pose_by_weights(const Correspondences& matches, const Pose& start, const std::vector<double>& scale,
                            const std::vector<double>& weights, double reach, int rounds = 15);

/// Sum of squared Sampson distances, each cut off at the threshold: what MSAC minimises.
double truncated_cost(const Correspondences& matches, const Pose& pose, double threshold);

/// Standard deviation of a pose along its worst direction, degrees, from the curvature of its inliers' cost: between
/// 0.001 and 90, and 90 with fewer than six inliers.
///
/// @param noise standard deviation of the Sampson distance, normalised.
double pose_uncertainty_deg(const Correspondences& inliers, const Pose& pose, double noise);

/// The same of the direction of translation alone, at most 90: from the curvature where that says that it is small, else
/// from the likelihoods of directions all around, for over a few pixels of parallax the cost is no paraboloid. What the
/// rotation takes up of the same residuals is accounted for.
double direction_uncertainty_deg(const Correspondences& inliers, const Pose& pose, double noise);

/// Information that weighted matches hold on a pose: their squared residuals' curvature by the five steps.
Matx55d pose_information(const Correspondences& matches, const Pose& pose, const std::vector<double>& weights);

/// The pose after a step: a rotation vector on the left of R, then two moves across t.
Pose apply_step(const Pose& pose, const Vec5d& step);

/// Rotation about a vector by its length in radians (Rodrigues).
cv::Matx33d rotation_from_vector(const cv::Vec3d& vector);

}  // namespace mgca::detail
