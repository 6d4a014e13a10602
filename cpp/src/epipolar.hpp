// Two-view geometry; mgca_filter/geometry/epipolar.py.

#pragma once

#include <opencv2/core.hpp>

#include <array>
#include <cstddef>
#include <vector>

namespace mgca::detail {

/// One match: x1, y1, x2, y2.
using Correspondence = cv::Vec4d;
using Correspondences = std::vector<Correspondence>;

/// One value for each match, 0 or 1.
using Mask = std::vector<unsigned char>;

/// Relative pose: rotation, and translation of unit length.
struct Pose {
    cv::Matx33d R = cv::Matx33d::eye();
    cv::Vec3d t;
};

/// The viewing ray of a match in either image, in the coordinates of its camera.
inline cv::Vec3d ray1(const Correspondence& match) { return {match[0], match[1], 1.0}; }
inline cv::Vec3d ray2(const Correspondence& match) { return {match[2], match[3], 1.0}; }

/// The matches at these positions.
Correspondences take(const Correspondences& matches, const std::vector<std::size_t>& positions);

/// Matrix of the cross product with t.
cv::Matx33d cross_matrix(const cv::Vec3d& t);

/// Essential matrix of unit Frobenius norm.
cv::Matx33d essential_from_pose(const Pose& pose);

/// F for pixels, of unit Frobenius norm.
cv::Matx33d fundamental_from_essential(const cv::Matx33d& E, const cv::Matx33d& K1, const cv::Matx33d& K2);

/// First-order distance of a match to the epipolar geometry, in the unit of the coordinates (Hartley & Zisserman, 2nd
/// ed., eq. 11.9).
double sampson_distance(const Correspondence& match, const cv::Matx33d& E);
std::vector<double> sampson_distances(const Correspondences& matches, const cv::Matx33d& E);

/// Sine of the angle between the viewing rays of a match, normalised, once the rotation is undone.
double parallax(const Correspondence& match, const cv::Matx33d& R);

/// Closest matrix with singular values (s, s, 0), scaled to unit Frobenius norm.
cv::Matx33d project_to_essential(const cv::Matx33d& M);

/// The four poses of the essential matrix closest to M (Hartley & Zisserman 9.6.2), the smaller rotation first; of a
/// direction the sign that makes its largest part positive, so that the order does not depend on who computes the singular
/// vectors.
std::array<Pose, 4> decompose_essential(const cv::Matx33d& M);

/// Finite and not all zero.
bool usable(const cv::Matx33d& M);

}  // namespace mgca::detail
