// Least squares on the relative pose: Levenberg-Marquardt on the truncated Sampson error of all matches.
//
// The pose has five degrees of freedom: a rotation vector applied on the left of R, and two steps of the unit
// translation on its tangent plane (as PoseLib does; Hartley & Zisserman, 2nd ed., sec. 11.4.3).

#pragma once

#include "mgca_epipolar.hpp"

#include <opencv2/core.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

namespace mgca {
namespace detail {

using Vec5d = cv::Vec<double, 5>;
using Matx55d = cv::Matx<double, 5, 5>;

/// What a pose leaves of one match.
struct Residual {
    cv::Vec3d ray;              // of image 1, in the second camera
    cv::Vec3d plane;            // x2 × t: normal of the epipolar plane
    double error = 0.0;         // x2^T E x1
    double squared_norm = 1.0;  // of the line normals

    Residual(const Correspondence& match, const Pose& pose)
        : ray(pose.R * ray1(match)), plane(ray2(match).cross(pose.t)), error(ray.dot(plane)) {
        const cv::Vec3d line2 = pose.t.cross(ray), line1 = pose.R.t() * plane;
        squared_norm = std::max(
            line2[0] * line2[0] + line2[1] * line2[1] + line1[0] * line1[0] + line1[1] * line1[1],
            std::numeric_limits<double>::min());
    }

    double squared_distance() const { return error * error / squared_norm; }
};

/// Sum of squared Sampson distances, each cut off at the threshold.
inline double truncated_cost(const std::vector<Correspondence>& matches, const Pose& pose, double threshold) {
    double cost = 0.0;
    for (const Correspondence& match : matches) {
        cost += std::min(Residual(match, pose).squared_distance(), threshold * threshold);
    }
    return cost;
}

/// Two unit vectors orthogonal to t.
inline std::array<cv::Vec3d, 2> tangent_basis(const cv::Vec3d& t) {
    const auto closer_to_zero = [](double a, double b) { return std::abs(a) < std::abs(b); };
    const auto smallest = std::min_element(t.val, t.val + 3, closer_to_zero);
    cv::Vec3d axis;
    axis[static_cast<int>(smallest - t.val)] = 1.0;
    const cv::Vec3d first = cv::normalize(t.cross(axis));
    return {first, t.cross(first)};
}

/// Rotation about a vector by its length in radians (Rodrigues).
inline cv::Matx33d rotation_from_vector(const cv::Vec3d& vector) {
    const double angle = cv::norm(vector);
    if (angle < 1e-12) {
        return cv::Matx33d::eye() + cross_matrix(vector);
    }
    const cv::Matx33d k = cross_matrix(vector * (1.0 / angle));
    return cv::Matx33d::eye() + std::sin(angle) * k + (1.0 - std::cos(angle)) * (k * k);
}

inline Pose apply_step(const Pose& pose, const Vec5d& step) {
    const auto basis = tangent_basis(pose.t);
    return {rotation_from_vector({step[0], step[1], step[2]}) * pose.R,
            cv::normalize(pose.t + step[3] * basis[0] + step[4] * basis[1])};
}

/// Gauss-Newton matrix and gradient of the squared Sampson distances of the matches within the threshold.
struct NormalEquations {
    Matx55d hessian;
    Vec5d gradient;
    int count = 0;  // of those matches

    NormalEquations(const std::vector<Correspondence>& matches, const Pose& pose, double threshold) {
        const auto basis = tangent_basis(pose.t);
        for (const Correspondence& match : matches) {
            const Residual residual(match, pose);
            if (!(residual.squared_distance() < threshold * threshold)) {
                continue;
            }
            // The line normals are held fixed: their derivative changes the step little and doubles the work.
            const double scale = 1.0 / std::sqrt(residual.squared_norm);
            const cv::Vec3d ray = residual.ray * scale;
            const cv::Vec3d by_rotation = ray.cross(residual.plane), by_translation = ray.cross(ray2(match));
            const Vec5d row(by_rotation[0], by_rotation[1], by_rotation[2], by_translation.dot(basis[0]),
                            by_translation.dot(basis[1]));
            hessian += row * row.t();
            gradient += residual.error * scale * row;
            ++count;
        }
    }

    /// The step against the gradient; shorter, the more damping.
    Vec5d step(double damping) const {
        constexpr double kSmallestCurvature = 1e-12;
        Matx55d damped = hessian;
        for (int k = 0; k < 5; ++k) {
            damped(k, k) += damping * (hessian(k, k) + kSmallestCurvature);
        }
        return damped.solve(-gradient, cv::DECOMP_LU);
    }
};

}  // namespace detail

/// Refine a pose on the matches within the threshold (Sampson distance, normalised), which are chosen anew in every
/// round; the truncated cost never rises.
inline Pose refine_pose(const std::vector<Correspondence>& matches, Pose pose, double threshold) {
    constexpr int kRounds = 10, kMinInliers = 6;
    // Steps so short that they need more damping than the largest no longer pay.
    constexpr double kInitialDamping = 1e-4, kMaxDamping = 1.0, kConvergedDecrease = 1e-4;
    double cost = detail::truncated_cost(matches, pose, threshold);
    double damping = kInitialDamping;
    for (int round = 0; round < kRounds; ++round) {
        const detail::NormalEquations equations(matches, pose, threshold);
        if (equations.count < kMinInliers) {
            break;
        }
        const double previous = cost;
        for (; damping < kMaxDamping; damping *= 10.0) {
            const Pose candidate = detail::apply_step(pose, equations.step(damping));
            const double candidate_cost = detail::truncated_cost(matches, candidate, threshold);
            if (candidate_cost < cost) {
                pose = candidate;
                cost = candidate_cost;
                damping *= 0.1;
                break;
            }
        }
        if (cost > (1.0 - kConvergedDecrease) * previous) {
            break;
        }
    }
    return pose;
}

}  // namespace mgca
