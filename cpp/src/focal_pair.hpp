// Two focal lengths, one an image, where the matches say that they differ: a zoom, or photographs of two cameras;
// mgca_filter/fit/focal_pair.py.
//
// A fundamental matrix determines both, unless the viewing axes meet (Hartley & Zisserman, 2nd ed., sec. 19.3; Sturm,
// 2001). Pose and focal lengths are refined together, with a little belief in usual lenses, from what a shared focal
// length gives; two are believed where they leave markedly less of the matches than one does.

#pragma once

#include "epipolar.hpp"

#include <optional>
#include <utility>
#include <vector>

namespace mgca::detail {

/// Where cameras lie from the guessed focal length, in its logarithm: mean and standard deviation.
struct FocalBelief {
    double mean = 0.0, spread = 1.0;
};

/// Pose, and logarithms of the factors on the guessed focal lengths of both images with their standard deviations.
struct TwoFocals {
    Pose pose;
    cv::Vec2d logs, sigmas;
    double ratio_sigma = 0.0;  // of the logarithm of their ratio, which is often known much better
    double cost = 0.0;         // tempered sum of squares, with the belief's share
};

/// Least squares on a pose and two focal lengths.
class FocalPairFit {
public:
    /// @param rows matches on the image planes normalised by the guessed focal lengths. threshold: Sampson distance
    /// where the error is cut off, in that unit. noise: standard deviation of the distances, likewise.
    FocalPairFit(Correspondences rows, double threshold, double noise, const FocalBelief& belief);

    /// The best with two focal lengths, or nothing where one does about as well; and how surely one does: the standard
    /// deviation of the logarithm of the ratio about it.
    ///
    /// @param pose, log_factor the pose and the logarithm of the factor on both guesses that suit the matches best.
    std::pair<std::optional<TwoFocals>, double> differing(const Pose& pose, double log_factor) const;

    /// How the best pose moves with the logarithms of both focal lengths: turns and moves of t, radians.
    ///
    /// @param pose the one that suits the matches best under the guessed focal lengths.
    cv::Matx<double, 5, 2> pose_derivative(const Pose& pose) const;

private:
    struct State {
        Pose pose;
        cv::Vec2d logs;
    };
    using Step = cv::Vec<double, 7>;  // turns, moves of t, logarithms
    struct NormalEquations {
        cv::Matx<double, 7, 7> hessian;
        Step gradient;
    };

    static State moved(const State& state, const Step& step);
    TwoFocals refined(State state) const;
    std::vector<double> distances(const State& state) const;  // signed
    std::vector<Step> jacobian(const State& state, const std::vector<double>& distances) const;  // of those within
    double cost(const std::vector<double>& distances, const cv::Vec2d& logs) const;
    NormalEquations normal_equations(const State& state, const std::vector<double>& distances) const;

    Correspondences rows_;
    double threshold_, scale_;
    FocalBelief belief_;
};

}  // namespace mgca::detail
