// Robust fit of a homography to scored matches, and how surprising its support would be by chance;
// mgca_filter/fit/homography_fit.py and planarity.py.

#pragma once

#include "epipolar.hpp"

#include <optional>
#include <vector>

namespace mgca::detail {

// log10 of the number of false alarms below which a homography is more than chance.
constexpr double kMeaningfulLog10Nfa = -2.0;

struct HomographyOptions {
    double threshold = 2.0;  // Sampson distance of an inlier, in the unit of the points
    double confidence = 0.9999;
    int max_iterations = 5000;
    int seed = 0;
    bool reflection = false;  // maps that mirror are possible, too
};

/// Homography with p2 ~ H p1 and H(2, 2) = 1 that most of the weight of the matches supports, polished by least squares.
///
/// @param matches distinct, finite, in pixels. weights: probabilities that they are right, or none = all alike.
std::optional<cv::Matx33d> estimate_homography(const Correspondences& matches, const HomographyOptions& options,
                                               const std::vector<double>& weights);

/// Least squares on all matches that agree with a homography, from a good one; it comes back where they are too few.
///
/// @param matches finite, in the unit of H.
cv::Matx33d polish_homography(const Correspondences& matches, const cv::Matx33d& H, const HomographyOptions& options);

/// log10 of the number of false alarms of the matches off the plane that agree with the epipolar model: above
/// kParallaxLog10Nfa they are no more than chance gathers, and the homography explains the pair as well as that does.
///
/// @param matches in pixels, as F; the best first. threshold: Sampson distance of an inlier.
double parallax_false_alarms(const Correspondences& matches, const cv::Matx33d& H, const cv::Matx33d& F,
                             double threshold);
constexpr double kParallaxLog10Nfa = -5.0;

/// log10 of the number of homographies that chance would support as well, on matches in pixels, the best first.
double homography_false_alarms(const Correspondences& matches, const cv::Matx33d& H, double threshold);

/// The same, and the number of independent inliers at the threshold.
struct PlaneSupport {
    int count = 0;
    double log10_nfa = 0.0;
};
PlaneSupport plane_support(const Correspondences& matches, const cv::Matx33d& H, double threshold);

/// First-order distances of matches to the nearest pair that H maps exactly (Hartley & Zisserman, 2nd ed., sec. 4.2.6);
/// infinite on the other side of the horizon than most of those that agree.
std::vector<double> sampson_distances_to_homography(const Correspondences& matches, const cv::Matx33d& H);

}  // namespace mgca::detail
