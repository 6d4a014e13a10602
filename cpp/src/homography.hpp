// Homographies p2 ~ H p1; mgca_filter/geometry/homography.py.

#pragma once

#include "epipolar.hpp"

#include <vector>

namespace mgca::detail {

/// Relative poses under which a plane induces H between normalised points: up to four (Malis & Vargas 2007), none where
/// H is a rotation.
std::vector<Pose> poses_from_homography(const cv::Matx33d& H);

/// Half the root of the summed squared transfer errors in both directions, one for each match, in the unit of the points;
/// infinite where a point maps to infinity.
std::vector<double> homography_distances(const Correspondences& matches, const cv::Matx33d& H);

}  // namespace mgca::detail
