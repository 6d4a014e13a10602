#include "focal_pair.hpp"

#include "least_squares.hpp"
#include "pose_refinement.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

namespace mgca::detail {
namespace {

// Real matches are far from independent, and cameras no perfect pinholes: a squared error weighs this much less.
constexpr double kTemper = 9.0;
// Two focal lengths are believed where they lower the tempered sum of squares, with what they cost in belief, by this.
constexpr double kMinGain = 6.0;
// Nearer to each other than this they are those of one camera, whose lens bends lines a little.
constexpr double kMinLogRatio = 0.15;
// And so many standard deviations apart: on a plane, say, a zoom cannot be told from a move.
constexpr double kMinRatioSigmas = 2.0;
// Zooms between the images that refinement starts from, beside that of the shared focal length.
constexpr std::array<double, 4> kZooms{0.4, 0.63, 1.6, 2.5};
constexpr int kMaxRounds = 25;
constexpr double kLeastDamping = 1e-9;  // without any few matches leave a matrix that has no inverse
constexpr double kLargestDamping = 1e4, kConvergedAt = 1e-5;
constexpr double kDerivativeStep = 1e-6;
constexpr double kLargestStep = 0.3;
constexpr double kLargestLog = 2.3;
// What makes of the curvature standard deviations that two thirds of the training pairs keep.
constexpr double kCurvatureToSigma = 1.4;

/// Two unit vectors orthogonal to t: those of a Householder reflection, which numpy's SVD takes.
std::array<cv::Vec3d, 2> householder_basis(const cv::Vec3d& t) {
    const double beta = -std::copysign(cv::norm(t), t[0]);
    const cv::Vec3d v(1.0, t[1] / (t[0] - beta), t[2] / (t[0] - beta));
    const double tau = (beta - t[0]) / beta;
    return {cv::Vec3d(0.0, 1.0, 0.0) - tau * v[1] * v, cv::Vec3d(0.0, 0.0, 1.0) - tau * v[2] * v};
}

}  // namespace

FocalPairFit::FocalPairFit(Correspondences rows, double threshold, double noise, const FocalBelief& belief)
    : rows_(std::move(rows)), threshold_(threshold), scale_(1.0 / (kTemper * noise * noise)), belief_(belief) {}

std::pair<std::optional<TwoFocals>, double> FocalPairFit::differing(const Pose& pose, double log_factor) const {
    const State shared{pose, {log_factor, log_factor}};
    const double before = cost(distances(shared), shared.logs);
    TwoFocals found = refined(shared);
    const double sigma_beside = found.ratio_sigma;
    for (const double zoom : kZooms) {
        const double half = 0.5 * std::log(zoom);
        const TwoFocals other = refined({pose, {log_factor - half, log_factor + half}});
        if (other.cost < found.cost) {
            found = other;
        }
    }
    if (before - found.cost < kMinGain) {
        return {std::nullopt, sigma_beside};
    }
    const double apart = std::abs(found.logs[1] - found.logs[0]);
    const bool believed = apart > std::max(kMinLogRatio, kMinRatioSigmas * found.ratio_sigma);
    return {believed ? std::optional(found) : std::nullopt, sigma_beside};
}

cv::Matx<double, 5, 2> FocalPairFit::pose_derivative(const Pose& pose) const {
    const State state{pose, {0.0, 0.0}};
    cv::Matx<double, 5, 5> hessian;
    cv::Matx<double, 5, 2> mixed;
    for (const Step& row : jacobian(state, distances(state))) {
        const cv::Vec<double, 5> of_pose(row[0], row[1], row[2], row[3], row[4]);
        hessian += of_pose * of_pose.t();
        mixed += of_pose * cv::Matx<double, 1, 2>(row[5], row[6]);
    }
    hessian += (1e-9 * cv::trace(hessian) + 1e-12) * cv::Matx<double, 5, 5>::eye();
    return -1.0 * hessian.solve(mixed, cv::DECOMP_LU);
}

FocalPairFit::State FocalPairFit::moved(const State& state, const Step& step) {
    const auto basis = householder_basis(state.pose.t);
    return {{rotation_from_vector({step[0], step[1], step[2]}) * state.pose.R,
             cv::normalize(state.pose.t + step[3] * basis[0] + step[4] * basis[1])},
            state.logs + cv::Vec2d(step[5], step[6])};
}

TwoFocals FocalPairFit::refined(State state) const {
    std::vector<double> distance = distances(state);
    double now = cost(distance, state.logs), damping = 1e-3;
    for (int round = 0; round < kMaxRounds; ++round) {
        const NormalEquations equations = normal_equations(state, distance);
        const double previous = now, enough = kConvergedAt * std::max(previous, 1.0);
        for (; damping < kLargestDamping; damping *= 10.0) {
            cv::Matx<double, 7, 7> damped = equations.hessian;
            for (int k = 0; k < 7; ++k) {
                damped(k, k) += damping * (equations.hessian(k, k) + 1e-9);
            }
            Step step = damped.solve(-equations.gradient, cv::DECOMP_LU);
            step *= std::min(1.0, kLargestStep / std::max(cv::norm(step, cv::NORM_INF), 1e-12));
            if (!promises<7>(equations.hessian, equations.gradient, step, enough)) {
                break;
            }
            const State candidate = moved(state, step);
            const std::vector<double> candidate_distance = distances(candidate);
            const double candidate_cost = cost(candidate_distance, candidate.logs);
            if (candidate_cost < now) {
                state = candidate;
                distance = candidate_distance;
                now = candidate_cost;
                damping = std::max(0.1 * damping, kLeastDamping);
                break;
            }
        }
        if (now > previous - enough) {
            break;
        }
    }
    cv::Matx<double, 7, 7> hessian = normal_equations(state, distance).hessian;
    hessian += (1e-9 + 1e-12 * cv::trace(hessian)) * cv::Matx<double, 7, 7>::eye();
    const cv::Matx<double, 7, 7> covariance = hessian.inv(cv::DECOMP_LU);
    const auto sigma = [](double variance) { return kCurvatureToSigma * std::sqrt(std::max(variance, 0.0)); };
    const double first = covariance(5, 5), second = covariance(6, 6);
    return {state.pose,
            state.logs,
            {sigma(first), sigma(second)},
            sigma(first + second - covariance(5, 6) - covariance(6, 5)),
            now};
}

std::vector<double> FocalPairFit::distances(const State& state) const {
    // In the unit of the guessed focal lengths, whatever the factors. Next to zero a distance without sign has no
    // derivative.
    const double shrink1 = std::exp(-state.logs[0]), shrink2 = std::exp(-state.logs[1]);
    const cv::Matx33d M = cv::Matx33d::diag({shrink2, shrink2, 1.0}) * cross_matrix(state.pose.t) * state.pose.R *
                          cv::Matx33d::diag({shrink1, shrink1, 1.0});
    std::vector<double> signed_distances;
    signed_distances.reserve(rows_.size());
    for (const Correspondence& row : rows_) {
        const cv::Vec3d x1(row[0], row[1], 1.0), x2(row[2], row[3], 1.0);
        const cv::Vec3d line2 = M * x1, line1 = M.t() * x2;
        const double squared_norm =
            line2[0] * line2[0] + line2[1] * line2[1] + line1[0] * line1[0] + line1[1] * line1[1];
        signed_distances.push_back(x2.dot(line2) /
                                   std::sqrt(std::max(squared_norm, std::numeric_limits<double>::min())));
    }
    return signed_distances;
}

double FocalPairFit::cost(const std::vector<double>& distances, const cv::Vec2d& logs) const {
    double errors = 0.0, belief = 0.0;
    for (const double distance : distances) {
        const double cut = std::min(std::abs(distance), threshold_);
        errors += std::isfinite(distance) ? cut * cut : std::numeric_limits<double>::infinity();
    }
    for (const double log : logs.val) {
        if (std::abs(log) > kLargestLog) {
            return std::numeric_limits<double>::infinity();
        }
        const double unusual = (log - belief_.mean) / belief_.spread;
        belief += unusual * unusual;
    }
    return scale_ * errors + belief;
}

std::vector<FocalPairFit::Step> FocalPairFit::jacobian(const State& state, const std::vector<double>& distance) const {
    std::array<std::vector<double>, 7> beside;
    for (int k = 0; k < 7; ++k) {
        Step step;
        step[k] = kDerivativeStep;
        beside[static_cast<std::size_t>(k)] = distances(moved(state, step));
    }
    std::vector<Step> rows;
    for (std::size_t i = 0; i < distance.size(); ++i) {
        if (std::abs(distance[i]) < threshold_) {
            Step row;
            for (int k = 0; k < 7; ++k) {
                row[k] = (beside[static_cast<std::size_t>(k)][i] - distance[i]) / kDerivativeStep;
            }
            rows.push_back(row);
        }
    }
    return rows;
}

FocalPairFit::NormalEquations FocalPairFit::normal_equations(const State& state,
                                                             const std::vector<double>& distance) const {
    NormalEquations equations;
    const std::vector<Step> rows = jacobian(state, distance);
    auto row = rows.begin();
    for (const double value : distance) {
        if (std::abs(value) < threshold_) {
            equations.hessian += scale_ * (*row * row->t());
            equations.gradient += scale_ * value * *row;
            ++row;
        }
    }
    const double sharpness = 1.0 / (belief_.spread * belief_.spread);
    for (const int k : {5, 6}) {
        equations.hessian(k, k) += sharpness;
        equations.gradient[k] += (state.logs[k - 5] - belief_.mean) * sharpness;
    }
    return equations;
}

}  // namespace mgca::detail
