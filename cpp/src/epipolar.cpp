#include "epipolar.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace mgca::detail {

Correspondences take(const Correspondences& matches, const std::vector<std::size_t>& positions) {
    Correspondences taken;
    taken.reserve(positions.size());
    for (const std::size_t position : positions) {
        taken.push_back(matches[position]);
    }
    return taken;
}

cv::Matx33d cross_matrix(const cv::Vec3d& t) { return {0.0, -t[2], t[1], t[2], 0.0, -t[0], -t[1], t[0], 0.0}; }

cv::Matx33d essential_from_pose(const Pose& pose) {
    const cv::Matx33d E = cross_matrix(pose.t) * pose.R;
    const double norm = cv::norm(E);
    return norm > 0.0 ? E * (1.0 / norm) : E;
}

cv::Matx33d fundamental_from_essential(const cv::Matx33d& E, const cv::Matx33d& K1, const cv::Matx33d& K2) {
    const cv::Matx33d F = K2.inv().t() * E * K1.inv();
    return F * (1.0 / cv::norm(F));
}

double sampson_distance(const Correspondence& match, const cv::Matx33d& E) {
    const cv::Vec3d line2 = E * ray1(match), line1 = E.t() * ray2(match);
    const double squared_norm =
        line2[0] * line2[0] + line2[1] * line2[1] + line1[0] * line1[0] + line1[1] * line1[1];
    return std::abs(ray2(match).dot(line2)) / std::sqrt(std::max(squared_norm, std::numeric_limits<double>::min()));
}

std::vector<double> sampson_distances(const Correspondences& matches, const cv::Matx33d& E) {
    std::vector<double> distances(matches.size());
    std::transform(matches.begin(), matches.end(), distances.begin(),
                   [&](const Correspondence& match) { return sampson_distance(match, E); });
    return distances;
}

double parallax(const Correspondence& match, const cv::Matx33d& R) {
    const cv::Vec3d x1 = ray1(match), x2 = ray2(match);
    const double cosine = (R * x1).dot(x2);
    return std::sqrt(std::max(1.0 - cosine * cosine / (x1.dot(x1) * x2.dot(x2)), 0.0));
}

cv::Matx33d project_to_essential(const cv::Matx33d& M) {
    cv::Matx33d U, Vt;
    cv::Matx31d values;
    cv::SVD::compute(M, values, U, Vt);
    return U * cv::Matx33d::diag({1.0, 1.0, 0.0}) * Vt * (1.0 / std::sqrt(2.0));
}

std::array<Pose, 4> decompose_essential(const cv::Matx33d& M) {
    cv::Matx33d U, Vt;
    cv::Matx31d values;
    cv::SVD::compute(M, values, U, Vt);
    const double sign = cv::determinant(U) * cv::determinant(Vt) < 0.0 ? -1.0 : 1.0;
    const cv::Matx33d W(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    cv::Matx33d smaller = sign * (U * W * Vt), larger = sign * (U * W.t() * Vt);
    if (cv::trace(larger) > cv::trace(smaller)) {
        std::swap(smaller, larger);
    }
    cv::Vec3d t(U(0, 2), U(1, 2), U(2, 2));
    const auto longer = [](double a, double b) { return std::abs(a) < std::abs(b); };
    if (*std::max_element(t.val, t.val + 3, longer) < 0.0) {
        t = -t;
    }
    return {Pose{smaller, t}, Pose{smaller, -t}, Pose{larger, t}, Pose{larger, -t}};
}

bool usable(const cv::Matx33d& M) {
    return std::all_of(M.val, M.val + 9, [](double value) { return std::isfinite(value); }) &&
           std::any_of(M.val, M.val + 9, [](double value) { return value != 0.0; });
}

}  // namespace mgca::detail
