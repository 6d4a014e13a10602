// OpenCV's robust estimators of two-view models: one call, one model or nothing; mgca_filter/fit/estimators.py.
//
// Points lie on the normalised image planes; thresholds come in pixels with the mean focal length that converts them.

#pragma once

#include "epipolar.hpp"

#include <optional>

namespace mgca::detail {

// A homography constrains both coordinates and planes are seldom perfect: it gets twice the threshold of E.
constexpr double kHomographyThresholdFactor = 2.0;

enum class Estimator { prosac, magsac, ransac };

/// Options of one run.
struct EstimatorOptions {
    Estimator method = Estimator::prosac;  // PROSAC uses the order
    double threshold_px = 0.5;             // Sampson distance of an inlier
    double confidence = 0.9999;
    int max_iterations = 5000;
    int seed = 0;
    bool rough = false;  // MAGSAC's model is refined afterwards, and need not be good
};

/// Essential (calibrated) or fundamental matrix of unit Frobenius norm, in normalised coordinates.
///
/// @param rows distinct matches, the most promising first.
std::optional<cv::Matx33d> fit_epipolar(const Correspondences& rows, double focal_px, const EstimatorOptions& options,
                                        bool calibrated);

/// Homography with p2 ~ H p1, scaled to H(2, 2) = 1.
///
/// @param threshold transfer error of an inlier, in the unit of the points.
/// @param ordered the most promising points come first, and are drawn first.
std::optional<cv::Matx33d> fit_homography(const Correspondences& rows, double threshold, int seed,
                                          bool ordered = false);

}  // namespace mgca::detail
