// Two-view geometry of calibrated images.
//
// Conventions, in all headers: X2 = R X1 + t and x2^T E x1 = 0, points on the normalised image planes (pixels times the
// inverse of K).

#pragma once

#include <opencv2/core.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <optional>
#include <vector>

namespace mgca {

/// One match on the normalised image planes: x1, y1, x2, y2.
using Correspondence = cv::Vec4d;

/// Relative pose: rotation, and translation of unit length.
struct Pose {
    cv::Matx33d R = cv::Matx33d::eye();
    cv::Vec3d t;
};

/// The viewing ray of a match in image 1, in the coordinates of camera 1.
inline cv::Vec3d ray1(const Correspondence& match) { return {match[0], match[1], 1.0}; }

/// The viewing ray of a match in image 2, in the coordinates of camera 2.
inline cv::Vec3d ray2(const Correspondence& match) { return {match[2], match[3], 1.0}; }

/// Matrix of the cross product with t.
inline cv::Matx33d cross_matrix(const cv::Vec3d& t) {
    return {0.0, -t[2], t[1], t[2], 0.0, -t[0], -t[1], t[0], 0.0};
}

/// Essential matrix of unit Frobenius norm.
inline cv::Matx33d essential_from_pose(const Pose& pose) {
    const cv::Matx33d E = cross_matrix(pose.t) * pose.R;
    return E * (1.0 / cv::norm(E));
}

/// First-order distance of a match to the epipolar geometry, in the unit of the coordinates (Hartley & Zisserman, 2nd
/// ed., eq. 11.9).
inline double sampson_distance(const Correspondence& match, const cv::Matx33d& E) {
    const cv::Vec3d line2 = E * ray1(match), line1 = E.t() * ray2(match);
    const double squared_norm =
        line2[0] * line2[0] + line2[1] * line2[1] + line1[0] * line1[0] + line1[1] * line1[1];
    return std::abs(ray2(match).dot(line2)) / std::sqrt(std::max(squared_norm, std::numeric_limits<double>::min()));
}

/// The matches closer to the epipolar geometry than the threshold, in their order.
inline std::vector<Correspondence> near_model(const std::vector<Correspondence>& matches, const cv::Matx33d& E,
                                              double threshold) {
    std::vector<Correspondence> near;
    std::copy_if(matches.begin(), matches.end(), std::back_inserter(near),
                 [&](const Correspondence& match) { return sampson_distance(match, E) < threshold; });
    return near;
}

/// True where the point closest to both viewing rays has positive depth in both cameras; parallel rays meet at
/// infinity.
inline bool in_front(const Correspondence& match, const Pose& pose) {
    const cv::Vec3d a = pose.R * ray1(match), b = ray2(match);
    const double aa = a.dot(a), bb = b.dot(b), ab = a.dot(b), at = a.dot(pose.t), bt = b.dot(pose.t);
    if (aa * bb - ab * ab <= 1e-15 * aa * bb) {
        return true;
    }
    return ab * bt - bb * at > 0.0 && aa * bt - ab * at > 0.0;
}

/// The pose of the essential matrix closest to M that puts most of the matches in front of both cameras, however far
/// they are; nothing without matches.
inline std::optional<Pose> pose_from_essential(const cv::Matx33d& M, const std::vector<Correspondence>& matches) {
    if (matches.empty()) {
        return std::nullopt;
    }
    cv::Matx33d U, Vt;
    cv::Matx31d values;
    cv::SVD::compute(M, values, U, Vt);
    U = U * (cv::determinant(U) < 0.0 ? -1.0 : 1.0);
    Vt = Vt * (cv::determinant(Vt) < 0.0 ? -1.0 : 1.0);
    const cv::Matx33d W(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    const cv::Matx33d R_a = U * W * Vt, R_b = U * W.t() * Vt;
    const cv::Vec3d t(U(0, 2), U(1, 2), U(2, 2));
    const std::array<Pose, 4> poses{Pose{R_a, t}, Pose{R_a, -t}, Pose{R_b, t}, Pose{R_b, -t}};
    const auto support = [&](const Pose& pose) {
        return std::count_if(matches.begin(), matches.end(),
                             [&](const Correspondence& match) { return in_front(match, pose); });
    };
    return *std::max_element(poses.begin(), poses.end(),
                             [&](const Pose& a, const Pose& b) { return support(a) < support(b); });
}

/// Larger of the angle between the rotations and that between the translations, whose sign is ignored; degrees.
inline double pose_error_deg(const Pose& a, const Pose& b) {
    const double cosine = (cv::trace(a.R.t() * b.R) - 1.0) / 2.0;
    const double rotation = std::acos(std::clamp(cosine, -1.0, 1.0));
    const double translation = std::atan2(cv::norm(a.t.cross(b.t)), std::abs(a.t.dot(b.t)));
    return std::max(rotation, translation) * 180.0 / CV_PI;
}

}  // namespace mgca
