// Robust fit of the relative pose of two calibrated images to matches sorted by promise: OpenCV's PROSAC, then least
// squares on the pose, also from the poses that the dominant plane allows.
//
// Conventions: X2 = R X1 + t and x2^T E x1 = 0, points on the normalised image planes (pixels times the inverse of K).

#pragma once

#include <opencv2/core.hpp>
#if CV_VERSION_MAJOR >= 5
#include <opencv2/geometry.hpp>
#else
#include <opencv2/calib3d.hpp>
#endif

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <iterator>
#include <limits>
#include <optional>
#include <set>
#include <utility>
#include <vector>

namespace mgca {

/// One match on the normalised image planes: x1, y1, x2, y2.
using Correspondence = cv::Vec4d;

/// Relative pose: rotation, and translation of unit length.
struct Pose {
    cv::Matx33d R = cv::Matx33d::eye();
    cv::Vec3d t;
};

/// Settings of the robust fit.
struct RobustFitOptions {
    double threshold_px = 0.5;         ///< Sampson distance that the estimator takes for an inlier, pixels.
    double refine_threshold_px = 1.0;  ///< Where the refinement cuts the error off, pixels.
    double confidence = 0.999;         ///< Probability that a sample without outliers was drawn.
    int max_iterations = 5000;         ///< Largest number of samples.
    int seed = 0;                      ///< Of the estimator's random numbers.
};

/// Fewer distinct matches than this give no model.
constexpr int kMinMatches = 8;

/// Matrix of the cross product with t.
inline cv::Matx33d cross_matrix(const cv::Vec3d& t) {
    return {0.0, -t[2], t[1], t[2], 0.0, -t[0], -t[1], t[0], 0.0};
}

/// Essential matrix of unit Frobenius norm.
inline cv::Matx33d essential_from_pose(const Pose& pose) {
    const cv::Matx33d E = cross_matrix(pose.t) * pose.R;
    return E * (1.0 / cv::norm(E));
}

/// First-order distance of a match to the epipolar geometry, in the unit of the coordinates.
inline double sampson_distance(const Correspondence& match, const cv::Matx33d& E) {
    const cv::Vec3d x1(match[0], match[1], 1.0), x2(match[2], match[3], 1.0);
    const cv::Vec3d line2 = E * x1, line1 = E.t() * x2;
    const double squared =
        line2[0] * line2[0] + line2[1] * line2[1] + line1[0] * line1[0] + line1[1] * line1[1];
    return std::abs(x2.dot(line2)) / std::sqrt(std::max(squared, std::numeric_limits<double>::min()));
}

namespace detail {

using Correspondences = std::vector<Correspondence>;

inline Correspondences near_model(const Correspondences& matches, const cv::Matx33d& E, double threshold) {
    Correspondences near;
    std::copy_if(matches.begin(), matches.end(), std::back_inserter(near),
                 [&](const Correspondence& match) { return sampson_distance(match, E) < threshold; });
    return near;
}

/// True where the point closest to both viewing rays has positive depth in both cameras.
inline bool in_front(const Correspondence& match, const Pose& pose) {
    const cv::Vec3d a = pose.R * cv::Vec3d(match[0], match[1], 1.0), b(match[2], match[3], 1.0);
    const double aa = a.dot(a), bb = b.dot(b), ab = a.dot(b), at = a.dot(pose.t), bt = b.dot(pose.t);
    if (aa * bb - ab * ab <= 1e-15 * aa * bb) {
        return true;  // parallel rays meet at infinity
    }
    return ab * bt - bb * at > 0.0 && aa * bt - ab * at > 0.0;
}

/// Sum of squared Sampson distances, each cut off at the threshold; with `cheirality` a match that triangulates behind
/// a camera counts as cut off.
inline double truncated_cost(const Correspondences& matches, const Pose& pose, double threshold,
                             bool cheirality = false) {
    const cv::Matx33d E = cross_matrix(pose.t) * pose.R;
    double cost = 0.0;
    for (const Correspondence& match : matches) {
        const bool possible = !cheirality || in_front(match, pose);
        const double distance = possible ? std::min(sampson_distance(match, E), threshold) : threshold;
        cost += distance * distance;
    }
    return cost;
}

/// Two unit vectors orthogonal to t.
inline std::array<cv::Vec3d, 2> tangent_basis(const cv::Vec3d& t) {
    cv::Vec3d axis;
    const auto closer_to_zero = [](double a, double b) { return std::abs(a) < std::abs(b); };
    const auto smallest = std::min_element(t.val, t.val + 3, closer_to_zero);
    axis[static_cast<int>(smallest - t.val)] = 1.0;
    const cv::Vec3d first = cv::normalize(t.cross(axis));
    return {first, t.cross(first)};
}

using Vec5d = cv::Vec<double, 5>;
using Matx55d = cv::Matx<double, 5, 5>;

/// The pose after a step: rotation vector applied on the left of R, then t moved on its tangent plane.
inline Pose apply_step(const Pose& pose, const Vec5d& step) {
    cv::Matx33d turn;
    cv::Rodrigues(cv::Vec3d(step[0], step[1], step[2]), turn);
    cv::Matx33d U, Vt;
    cv::Matx31d values;
    cv::SVD::compute(turn * pose.R, values, U, Vt);  // stays a rotation however many the steps
    const auto basis = tangent_basis(pose.t);
    return {U * Vt, cv::normalize(pose.t + step[3] * basis[0] + step[4] * basis[1])};
}

/// Gauss-Newton matrix and gradient of the sum of squared Sampson distances.
inline std::pair<Matx55d, Vec5d> normal_equations(const Correspondences& matches, const Pose& pose) {
    const cv::Matx33d T = cross_matrix(pose.t), E = T * pose.R;
    const auto basis = tangent_basis(pose.t);
    const std::array<cv::Matx33d, 5> derivatives{
        T * cross_matrix({1, 0, 0}) * pose.R, T * cross_matrix({0, 1, 0}) * pose.R,
        T * cross_matrix({0, 0, 1}) * pose.R, cross_matrix(basis[0]) * pose.R, cross_matrix(basis[1]) * pose.R};
    Matx55d hessian = Matx55d::zeros();
    Vec5d gradient;
    for (const Correspondence& match : matches) {
        const cv::Vec3d x1(match[0], match[1], 1.0), x2(match[2], match[3], 1.0);
        const cv::Vec3d line2 = E * x1, line1 = E.t() * x2;
        const double squared =
            line2[0] * line2[0] + line2[1] * line2[1] + line1[0] * line1[0] + line1[1] * line1[1];
        const double scale = std::sqrt(std::max(squared, std::numeric_limits<double>::min()));
        const double residual = x2.dot(line2) / scale;
        Vec5d row;
        for (int k = 0; k < 5; ++k) {
            const cv::Vec3d d_line2 = derivatives[k] * x1, d_line1 = derivatives[k].t() * x2;
            const double d_scale = (line2[0] * d_line2[0] + line2[1] * d_line2[1] + line1[0] * d_line1[0] +
                                    line1[1] * d_line1[1]) / scale;
            row[k] = (x2.dot(d_line2) - residual * d_scale) / scale;
        }
        hessian += row * row.t();
        gradient += residual * row;
    }
    return {hessian, gradient};
}

/// Refine a pose on the matches within the threshold (normalised), which are chosen anew in every round
/// (Levenberg-Marquardt); the truncated cost never rises.
inline Pose refine_pose(const Correspondences& matches, Pose pose, double threshold) {
    constexpr int kRounds = 10, kMinInliers = 6;
    constexpr double kMaxDamping = 1e6, kSmallestCurvature = 1e-12, kConvergedDecrease = 1e-4;
    double cost = truncated_cost(matches, pose, threshold);
    double damping = 1e-4;
    for (int round = 0; round < kRounds; ++round) {
        const Correspondences near = near_model(matches, cross_matrix(pose.t) * pose.R, threshold);
        if (near.size() < kMinInliers) {
            break;
        }
        const auto [hessian, gradient] = normal_equations(near, pose);
        const double previous = cost;
        for (; damping < kMaxDamping; damping *= 10.0) {
            Matx55d damped = hessian;
            for (int k = 0; k < 5; ++k) {
                damped(k, k) += damping * (hessian(k, k) + kSmallestCurvature);
            }
            const Vec5d step = damped.solve(-gradient, cv::DECOMP_LU);
            const Pose candidate = apply_step(pose, step);
            const double candidate_cost = truncated_cost(matches, candidate, threshold);
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

/// OpenCV's estimator settings; with this local optimisation they give what its USAC_PROSAC preset gives at seed 0.
inline cv::UsacParams usac_params(cv::SamplingMethod sampler, double threshold, double confidence, int max_iterations,
                                  int seed) {
    cv::UsacParams params;
    params.sampler = sampler;
    params.score = cv::SCORE_METHOD_MSAC;
    params.loMethod = cv::LOCAL_OPTIM_INNER_LO;
    params.loIterations = 20;
    params.loSampleSize = 12;
    params.threshold = threshold;
    params.confidence = confidence;
    params.maxIterations = max_iterations;
    params.randomGeneratorState = seed;
    return params;
}

/// Points of one image, multiplied by `scale`.
inline std::vector<cv::Point2d> points(const Correspondences& matches, int image, double scale = 1.0) {
    std::vector<cv::Point2d> points;
    points.reserve(matches.size());
    for (const Correspondence& match : matches) {
        points.emplace_back(match[2 * image - 2] * scale, match[2 * image - 1] * scale);
    }
    return points;
}

inline bool all_finite(const cv::Mat& matrix) { return cv::checkRange(matrix); }

/// Poses under which the plane that most of the matches lie on maps one image to the other; up to four.
inline std::vector<Pose> poses_from_plane(const Correspondences& matches, double threshold, int seed) {
    if (matches.size() < 4) {
        return {};
    }
    std::vector<Pose> poses;
    try {
        // OpenCV holds some constants in pixels: in units of the threshold, any coordinates look like pixels to it.
        const double unit = 1.0 / threshold;
        const cv::Mat H = cv::findHomography(points(matches, 1, unit), points(matches, 2, unit), cv::noArray(),
                                             usac_params(cv::SAMPLING_UNIFORM, 1.0, 0.999, 1000, seed));
        if (H.size() != cv::Size(3, 3) || !all_finite(H)) {
            return {};
        }
        const cv::Matx33d S = cv::Matx33d::diag({unit, unit, 1.0});
        const cv::Matx33d normalized = S.inv() * cv::Matx33d(H) * S;
        if (std::abs(normalized(2, 2)) < 1e-12) {
            return {};
        }
        std::vector<cv::Mat> rotations, translations, normals;
        cv::decomposeHomographyMat(normalized * (1.0 / normalized(2, 2)), cv::Matx33d::eye(), rotations, translations,
                                   normals);
        for (std::size_t i = 0; i < rotations.size(); ++i) {
            const double length = cv::norm(translations[i]);
            if (all_finite(rotations[i]) && std::isfinite(length) && length > 1e-9) {
                const cv::Matx31d t(translations[i]);
                poses.push_back({cv::Matx33d(rotations[i]), cv::Vec3d(t(0), t(1), t(2)) * (1.0 / length)});
            }
        }
    } catch (const cv::Exception&) {
        return {};
    }
    return poses;
}

/// Refine the pose and its rivals from the dominant plane; the one of least truncated cost. Where most matches lie on
/// a plane, two poses explain them about equally well and sampling meets one of them by chance.
inline Pose refine_best_start(const Correspondences& matches, const Pose& start, double threshold, int seed) {
    constexpr double kPlaneThresholdFactor = 2.0, kRivalCostFactor = 1.5;
    std::vector<Pose> poses{refine_pose(matches, start, threshold)};
    const Correspondences near = near_model(matches, essential_from_pose(poses[0]), threshold);
    const double limit = kRivalCostFactor * truncated_cost(matches, poses[0], threshold);
    for (const Pose& rival : poses_from_plane(near, kPlaneThresholdFactor * threshold, seed)) {
        if (truncated_cost(matches, rival, threshold) < limit) {
            poses.push_back(refine_pose(matches, rival, threshold));
        }
    }
    return *std::min_element(poses.begin(), poses.end(), [&](const Pose& a, const Pose& b) {
        return truncated_cost(matches, a, threshold, true) < truncated_cost(matches, b, threshold, true);
    });
}

/// The matches without repetitions, in their order: one that is listed ten times supports a model once.
inline Correspondences distinct(const Correspondences& matches) {
    std::set<std::array<double, 4>> seen;
    Correspondences kept;
    std::copy_if(matches.begin(), matches.end(), std::back_inserter(kept), [&](const Correspondence& match) {
        return seen.insert({match[0], match[1], match[2], match[3]}).second;
    });
    return kept;
}

/// The essential matrix by OpenCV's PROSAC, unit Frobenius norm; nothing where it finds none.
inline std::optional<cv::Matx33d> sample_essential(const Correspondences& matches, double focal_px,
                                                   const RobustFitOptions& options) {
    const double threshold = options.threshold_px / focal_px;
    const cv::Matx33d identity = cv::Matx33d::eye();
    const cv::UsacParams params =
        usac_params(cv::SAMPLING_PROSAC, threshold, options.confidence, options.max_iterations, options.seed);
    cv::Mat stacked;  // OpenCV may stack several models
    try {
        stacked = cv::findEssentialMat(points(matches, 1), points(matches, 2), identity, identity, cv::noArray(),
                                       cv::noArray(), cv::noArray(), params);
    } catch (const cv::Exception&) {
        return std::nullopt;
    }
    std::optional<cv::Matx33d> best;
    double best_cost = 0.0;
    for (int row = 0; row + 3 <= stacked.rows; row += 3) {
        const cv::Mat block = stacked.rowRange(row, row + 3);
        if (block.cols != 3 || !all_finite(block) || cv::countNonZero(block) == 0) {
            continue;
        }
        const cv::Matx33d model(block);
        double cost = 0.0;
        for (const Correspondence& match : matches) {
            const double distance = std::min(sampson_distance(match, model), threshold);
            cost += distance * distance;
        }
        if (!best || cost < best_cost) {
            best = model * (1.0 / cv::norm(model));
            best_cost = cost;
        }
    }
    return best;
}

/// The pose of a (nearly) essential matrix that puts most of the matches in front of both cameras.
inline std::optional<Pose> pose_from_essential(const cv::Matx33d& M, const Correspondences& matches) {
    if (matches.empty()) {
        return std::nullopt;
    }
    cv::Matx33d U, Vt;
    cv::Matx31d values;
    cv::SVD::compute(M, values, U, Vt);
    const cv::Matx33d E = U * cv::Matx33d::diag({1.0, 1.0, 0.0}) * Vt * (1.0 / std::sqrt(2.0));
    constexpr double kAnyDistance = 1e9;  // recoverPose drops points farther than 50 baselines unless told otherwise
    cv::Mat R, t;
    try {
        cv::recoverPose(E, points(matches, 1), points(matches, 2), cv::Matx33d::eye(), R, t, kAnyDistance);
    } catch (const cv::Exception&) {
        return std::nullopt;
    }
    if (!all_finite(R) || !all_finite(t)) {
        return std::nullopt;
    }
    return Pose{cv::Matx33d(R), cv::Vec3d(t.at<double>(0), t.at<double>(1), t.at<double>(2))};
}

}  // namespace detail

/// Fit the relative pose to matches that are sorted, the most promising first.
///
/// @param matches on the normalised image planes, finite.
/// @param focal_px mean focal length, pixels: converts the thresholds.
/// @return the pose; nothing where the distinct matches are fewer than kMinMatches, no pose is found, or fewer than
///     kMinMatches agree with it. Never throws for data.
inline std::optional<Pose> estimate_pose(const std::vector<Correspondence>& matches, double focal_px,
                                         const RobustFitOptions& options) {
    const detail::Correspondences rows = detail::distinct(matches);
    if (rows.size() < kMinMatches) {
        return std::nullopt;
    }
    const std::optional<cv::Matx33d> sampled = detail::sample_essential(rows, focal_px, options);
    if (!sampled) {
        return std::nullopt;
    }
    const double threshold = options.refine_threshold_px / focal_px;
    const std::optional<Pose> start =
        detail::pose_from_essential(*sampled, detail::near_model(rows, *sampled, threshold));
    if (!start) {
        return std::nullopt;
    }
    const Pose pose = detail::refine_best_start(rows, *start, threshold, options.seed);
    if (detail::near_model(matches, essential_from_pose(pose), threshold).size() < kMinMatches) {
        return std::nullopt;
    }
    return pose;
}

}  // namespace mgca
