// Does the model deserve trust? Chance, lines and rotations, told apart by simple rules; mgca_filter/fit/degeneracy.py.

#pragma once

#include "epipolar.hpp"

#include <vector>

namespace mgca::detail {

constexpr int kMinSupport = 13;
// Number of false alarms, log10: above the first the support is chance, above the second it is weak.
constexpr double kUnrelatedLog10Nfa = 0.5, kLowSupportLog10Nfa = -1.0;
constexpr double kIntrinsicsSupportFactor = 1.5;
// A degenerate model explains what lies within this many thresholds of it.
constexpr double kExplainedThresholdFactor = 2.0;
// Keypoints are not better than this, and the median of absolute normal deviates times the second is their sigma.
constexpr double kLeastNoisePx = 0.1;
constexpr double kToSigma = 1.4826;
// A translation may point anywhere: so many wrong matches agree with a rotation and the best of its directions.
constexpr int kDirectionFreedom = 2;

/// How well the fitted matches stand behind the model.
struct Support {
    int count = 0;              // distinct matches within the threshold
    double log10_nfa = 0.0;     // log10 of how many models chance would support as well
    double chance_count = 0.0;  // about how many of `count` are wrong matches that agree by accident
};

/// Support of a model among the matches that it was fitted to, all normalised.
Support measure_support(const Correspondences& matches, const cv::Matx33d& M, double threshold);

/// Share of the wrong pairings of the same points that agree with the model.
double chance_rate(const Correspondences& matches, const cv::Matx33d& M, double threshold);

/// log10 of the number of models that chance would support by `inliers` of `count` matches.
double log10_false_alarms(int count, int inliers, double rate);

/// Distance of points to the line that fits most of them, points beyond the threshold set aside.
std::vector<double> line_distances(const std::vector<cv::Point2d>& points, double threshold);

/// Rotation that best aligns the viewing rays of normalised matches (Kabsch), outliers set aside.
cv::Matx33d fit_rotation(const Correspondences& matches, double threshold);

/// True where a rotation alone is the better model of the inliers than an essential matrix, noise considered: Torr's
/// criterion GRIC (IJCV 2002).
///
/// @param rotation_px Sampson distances of what bears witness to the rotation's homography. epipolar_px: the same to E.
bool prefers_rotation(const std::vector<double>& rotation_px, const std::vector<double>& epipolar_px);

/// True where a degenerate model explains nearly all inliers, but for those that are there by accident.
///
/// @param distances of the inliers to the degenerate model, or of more matches.
/// @param freedom how many wrong matches the general model can be made to fit beside the right ones.
bool explains(const std::vector<double>& distances, double threshold, const Support& support, int freedom = 0);

}  // namespace mgca::detail
