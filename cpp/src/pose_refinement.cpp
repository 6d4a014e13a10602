#include "pose_refinement.hpp"

#include "least_squares.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace mgca::detail {
namespace {

constexpr double kInitialDamping = 1e-4;
// Steps so short that they need more damping than this no longer pay.
constexpr double kMaxDamping = 1.0;
constexpr double kSmallestCurvature = 1e-12;
constexpr double kConvergedDecrease = 1e-4, kFinelyConvergedDecrease = 1e-5;
// Matches farther than this many thresholds from the pose that refinement starts at are left out of it.
constexpr double kReach = 12.0;

// Below this the cost of directions is a paraboloid around the best. Rings and spokes that others are tried on.
constexpr double kLinearDeg = 0.1;
constexpr std::size_t kRings = 28, kSpokes = 12, kSpreadRows = 200;

/// What a pose leaves of one match.
struct SampsonTerm {
    double r0, r1, r2;     // ray of image 1, in the second camera
    double n0, n1, n2;     // x2 × t: normal of the epipolar plane
    double error;          // x2^T E x1
    double squared_norm;   // of the line normals

    SampsonTerm(const Correspondence& match, const Pose& pose) {
        const double* R = pose.R.val;
        const double t0 = pose.t[0], t1 = pose.t[1], t2 = pose.t[2];
        r0 = R[0] * match[0] + R[1] * match[1] + R[2];
        r1 = R[3] * match[0] + R[4] * match[1] + R[5];
        r2 = R[6] * match[0] + R[7] * match[1] + R[8];
        n0 = match[3] * t2 - t1;
        n1 = t0 - match[2] * t2;
        n2 = match[2] * t1 - match[3] * t0;
        error = r0 * n0 + r1 * n1 + r2 * n2;
        const double l0 = t1 * r2 - t2 * r1, l1 = t2 * r0 - t0 * r2;
        const double m0 = n0 * R[0] + n1 * R[3] + n2 * R[6], m1 = n0 * R[1] + n1 * R[4] + n2 * R[7];
        squared_norm = std::max(l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1, std::numeric_limits<double>::min());
    }

    double squared_distance() const { return error * error / squared_norm; }
};

/// Two unit vectors orthogonal to t.
std::array<cv::Vec3d, 2> tangent_basis(const cv::Vec3d& t) {
    const auto closer_to_zero = [](double a, double b) { return std::abs(a) < std::abs(b); };
    const auto smallest = std::min_element(t.val, t.val + 3, closer_to_zero);
    cv::Vec3d axis;
    axis[static_cast<int>(smallest - t.val)] = 1.0;
    const cv::Vec3d first = cv::normalize(t.cross(axis));
    return {first, t.cross(first)};
}

/// What a match adds to the cost, and how much it counts in the squares that stand for the cost near by.
struct Loss {
    double cost, weight;
};

/// The loss of a match of a squared Sampson distance, cut off at the threshold.
auto truncated_at(double threshold) {
    return [limit = threshold * threshold](std::size_t, double squared) {
        return squared < limit ? Loss{squared, 1.0} : Loss{limit, 0.0};
    };
}

/// Every match counts its squared distance.
constexpr auto kSquares = [](std::size_t, double squared) { return Loss{squared, 1.0}; };

/// Sum of the losses of all matches; `loss` takes the position of a match and its squared Sampson distance.
template <typename LossOf>
double cost_of(const Correspondences& matches, const Pose& pose, const LossOf& loss) {
    double cost = 0.0;
    for (std::size_t i = 0; i < matches.size(); ++i) {
        cost += loss(i, SampsonTerm(matches[i], pose).squared_distance()).cost;
    }
    return cost;
}

/// Gauss-Newton matrix and gradient of the squared Sampson distances, weighted.
struct NormalEquations {
    Matx55d hessian;
    Vec5d gradient;
    int count = 0;  // of the matches that count

    template <typename LossOf>
    NormalEquations(const Correspondences& matches, const Pose& pose, const LossOf& loss) {
        const auto basis = tangent_basis(pose.t);
        std::array<double, 15> upper{};
        for (std::size_t index = 0; index < matches.size(); ++index) {
            const Correspondence& match = matches[index];
            const SampsonTerm term(match, pose);
            const double weight = loss(index, term.squared_distance()).weight;
            if (!(weight > 0.0)) {
                continue;
            }
            // The line normals are held fixed: their derivative changes the step little and doubles the work.
            const double scale = 1.0 / std::sqrt(term.squared_norm);
            const double r0 = term.r0 * scale, r1 = term.r1 * scale, r2 = term.r2 * scale;
            const double x2 = match[2], y2 = match[3];
            const cv::Vec3d by_translation(r1 - r2 * y2, r2 * x2 - r0, r0 * y2 - r1 * x2);
            const std::array<double, 5> row{r1 * term.n2 - r2 * term.n1, r2 * term.n0 - r0 * term.n2,
                                            r0 * term.n1 - r1 * term.n0, by_translation.dot(basis[0]),
                                            by_translation.dot(basis[1])};
            std::size_t k = 0;
            for (std::size_t i = 0; i < 5; ++i) {
                for (std::size_t j = i; j < 5; ++j) {
                    upper[k++] += weight * row[i] * row[j];
                }
                gradient[static_cast<int>(i)] += weight * term.error * scale * row[i];
            }
            ++count;
        }
        std::size_t k = 0;
        for (int i = 0; i < 5; ++i) {
            for (int j = i; j < 5; ++j) {
                hessian(i, j) = hessian(j, i) = upper[k++];
            }
        }
    }

    /// The step against the gradient; shorter, the more damping.
    Vec5d step(double damping) const {
        Matx55d damped = hessian;
        for (int k = 0; k < 5; ++k) {
            damped(k, k) += damping * (hessian(k, k) + kSmallestCurvature);
        }
        return damped.solve(-gradient, cv::DECOMP_LU);
    }
};

/// The pose of the least cost that so many steps find, or fewer: one that gains less than a share `converged` is the last.
template <typename LossOf>
Pose minimise(const Correspondences& matches, Pose pose, const LossOf& loss, int rounds, double converged) {
    double cost = cost_of(matches, pose, loss);
    double damping = kInitialDamping;
    for (int round = 0; round < rounds; ++round) {
        const NormalEquations equations(matches, pose, loss);
        if (equations.count < kMinRefinedInliers) {
            break;
        }
        const double previous = cost;
        for (; damping < kMaxDamping; damping *= 10.0) {
            const Vec5d step = equations.step(damping);
            if (!promises<5>(equations.hessian, equations.gradient, step, converged * cost)) {
                return pose;
            }
            const Pose candidate = apply_step(pose, step);
            const double candidate_cost = cost_of(matches, candidate, loss);
            if (candidate_cost < cost) {
                pose = candidate;
                cost = candidate_cost;
                damping *= 0.1;
                break;
            }
        }
        if (cost > (1.0 - converged) * previous) {
            break;
        }
    }
    return pose;
}

/// Positions of the matches that are nearer to a pose than this.
std::vector<std::size_t> within(const Correspondences& matches, const Pose& pose, double reach) {
    std::vector<std::size_t> reached;
    for (std::size_t i = 0; i < matches.size(); ++i) {
        if (SampsonTerm(matches[i], pose).squared_distance() < reach * reach) {
            reached.push_back(i);
        }
    }
    return reached;
}

/// Summed squared Sampson distances of matches to a pose with another direction of translation, the rotation moved from
/// the pose's as that likes best, to first order.
double cost_of_direction(const Correspondences& matches, const Pose& pose) {
    cv::Matx33d hessian = kSmallestCurvature * cv::Matx33d::eye();
    cv::Vec3d gradient;
    double cost = 0.0;
    for (const Correspondence& match : matches) {
        const SampsonTerm term(match, pose);
        const double scale = 1.0 / std::sqrt(term.squared_norm), residual = term.error * scale;
        const cv::Vec3d row =
            scale * cv::Vec3d(term.r0, term.r1, term.r2).cross(cv::Vec3d(term.n0, term.n1, term.n2));
        hessian += row * row.t();
        gradient += residual * row;
        cost += residual * residual;
    }
    return cost - gradient.dot(hessian.solve(gradient, cv::DECOMP_LU));
}

/// Standard deviation of the direction of translation from the likelihoods of directions on rings around t, from a
/// fraction of `scale_deg` to 90 degrees.
double direction_spread_deg(const Correspondences& inliers, const Pose& pose, double noise, double scale_deg) {
    const std::size_t step = std::max<std::size_t>(1, (inliers.size() + kSpreadRows - 1) / kSpreadRows);
    Correspondences rows;
    for (std::size_t i = 0; i < inliers.size(); i += step) {
        rows.push_back(inliers[i]);
    }
    const auto basis = tangent_basis(pose.t);
    const double best = cost_of_direction(rows, pose), smallest = std::min(0.2 * scale_deg, 1.0) * CV_PI / 180.0;
    std::vector<double> log_weights;
    std::vector<cv::Vec2d> moves;
    double inner = 0.0;
    for (std::size_t ring = 0; ring < kRings; ++ring) {
        const double part = static_cast<double>(ring) / (kRings - 1);
        const double outer = smallest * std::pow(0.5 * CV_PI / smallest, part), angle = 0.5 * (outer + inner);
        for (std::size_t spoke = 0; spoke < kSpokes; ++spoke) {
            const double turn = 2.0 * CV_PI * static_cast<double>(spoke) / kSpokes;
            const cv::Vec2d across(std::cos(turn), std::sin(turn));
            const cv::Vec3d t =
                std::cos(angle) * pose.t + std::sin(angle) * (across[0] * basis[0] + across[1] * basis[1]);
            const double cost = static_cast<double>(step) * (cost_of_direction(rows, {pose.R, t}) - best);
            log_weights.push_back(-0.5 * cost / (noise * noise) + std::log(std::sin(angle) * (outer - inner)));
            moves.push_back(angle * across);
        }
        inner = outer;
    }
    const double largest = *std::max_element(log_weights.begin(), log_weights.end());
    cv::Matx22d moments;
    double sum = 0.0;
    for (std::size_t i = 0; i < moves.size(); ++i) {
        const double weight = std::exp(log_weights[i] - largest);
        moments += weight * (moves[i] * moves[i].t());
        sum += weight;
    }
    cv::Matx21d eigenvalues;  // in descending order
    cv::eigen(moments * (1.0 / sum), eigenvalues);
    return std::min(std::sqrt(eigenvalues(0)) * 180.0 / CV_PI, 90.0);
}

}  // namespace

double truncated_cost(const Correspondences& matches, const Pose& pose, double threshold) {
    return cost_of(matches, pose, truncated_at(threshold));
}

Matx55d pose_information(const Correspondences& matches, const Pose& pose, const std::vector<double>& weights) {
    const auto weighted = [&](std::size_t i, double) { return Loss{0.0, weights[i]}; };
    return NormalEquations(matches, pose, weighted).hessian;
}

Pose apply_step(const Pose& pose, const Vec5d& step) {
    const auto basis = tangent_basis(pose.t);
    return {rotation_from_vector({step[0], step[1], step[2]}) * pose.R,
            cv::normalize(pose.t + step[3] * basis[0] + step[4] * basis[1])};
}

cv::Matx33d rotation_from_vector(const cv::Vec3d& vector) {
    const double angle = cv::norm(vector);
    if (angle < 1e-12) {
        return cv::Matx33d::eye() + cross_matrix(vector);
    }
    const cv::Matx33d k = cross_matrix(vector * (1.0 / angle));
    return cv::Matx33d::eye() + std::sin(angle) * k + (1.0 - std::cos(angle)) * (k * k);
}

Pose refine_pose(const Correspondences& matches, const Pose& start, double threshold, int rounds) {
    const Correspondences reached = take(matches, within(matches, start, kReach * threshold));
    if (static_cast<int>(reached.size()) < kMinRefinedInliers) {
        return start;
    }
    return minimise(reached, start, truncated_at(threshold), rounds, kConvergedDecrease);
}

Pose refine_pose_by_weights(const Correspondences& matches, const Pose& start, const std::vector<double>& scale,
                            const std::vector<double>& weights, double reach, int rounds) {
    const std::vector<std::size_t> reached = within(matches, start, reach);
    if (static_cast<int>(reached.size()) < kMinRefinedInliers) {
        return start;
    }
    std::vector<double> of_squares;
    for (const std::size_t row : reached) {
        of_squares.push_back(weights[row] / (scale[row] * scale[row]));
    }
    const double largest = *std::max_element(of_squares.begin(), of_squares.end());
    const auto cauchy = [&](std::size_t i, double squared) {
        const double relative = squared / (scale[reached[i]] * scale[reached[i]]);
        return Loss{weights[reached[i]] / largest * std::log1p(relative), of_squares[i] / (largest * (1.0 + relative))};
    };
    return minimise(take(matches, reached), start, cauchy, rounds, kFinelyConvergedDecrease);
}

double direction_uncertainty_deg(const Correspondences& inliers, const Pose& pose, double noise) {
    if (static_cast<int>(inliers.size()) < kMinRefinedInliers) {
        return 90.0;
    }
    const NormalEquations equations(inliers, pose, kSquares);
    const cv::Matx33d rotation = equations.hessian.get_minor<3, 3>(0, 0) + kSmallestCurvature * cv::Matx33d::eye();
    const cv::Matx<double, 3, 2> cross = equations.hessian.get_minor<3, 2>(0, 3);
    const cv::Matx22d marginal =
        equations.hessian.get_minor<2, 2>(3, 3) - cross.t() * rotation.solve(cross, cv::DECOMP_LU);
    cv::Matx21d eigenvalues;
    cv::eigen(marginal, eigenvalues);
    const double linear_deg = std::min(noise / std::sqrt(std::max(eigenvalues(1), 1e-18)) * 180.0 / CV_PI, 90.0);
    return linear_deg < kLinearDeg ? linear_deg : direction_spread_deg(inliers, pose, noise, linear_deg);
}

double pose_uncertainty_deg(const Correspondences& inliers, const Pose& pose, double noise) {
    if (static_cast<int>(inliers.size()) < kMinRefinedInliers) {
        return 90.0;
    }
    const NormalEquations equations(inliers, pose, kSquares);
    cv::Mat eigenvalues;  // in descending order
    cv::eigen(cv::Mat(equations.hessian), eigenvalues);
    const double curvature = eigenvalues.at<double>(4);
    const double radians = noise / std::sqrt(std::max(curvature, 1e-18));
    return std::clamp(radians * 180.0 / CV_PI, 1e-3, 90.0);
}

}  // namespace mgca::detail
