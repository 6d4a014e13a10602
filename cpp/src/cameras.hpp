// Intrinsics: checked where the caller gave them, guessed where not; pixels to the normalised plane;
// mgca_filter/geometry/cameras.py.

#pragma once

#include <mgca/filter.hpp>

#include <opencv2/core.hpp>

#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace mgca::detail {

/// Camera of one image.
struct Intrinsics {
    cv::Matx33d K;
    std::vector<double> distortion;  // empty = none
    std::optional<Fisheye> fisheye;  // in its place
    bool guessed = false;
    std::string assumption;  // one sentence, or empty

    /// Pixels to the normalised image plane, distortion removed; NaN where that fails.
    std::vector<cv::Point2d> normalize(const std::vector<cv::Point2d>& points) const;

    /// Derivatives of the undistorted pixels by the pixels, one for each point; none without distortion. NaN where a point
    /// has no place on the image plane.
    std::vector<cv::Matx22d> stretch(const std::vector<cv::Point2d>& points) const;

    bool distorts() const { return fisheye.has_value() || !distortion.empty(); }

    /// A normalised point to pixels free of distortion.
    cv::Point2d project(double x, double y) const;
};

/// Intrinsics of both images. A second camera without K has that of the first.
///
/// @param points1, points2 all keypoints, pixels; their extent stands in for a missing size.
///
/// Throws ArgumentError for a matrix that is no K, wrong numbers of coefficients, or one that needs another.
std::pair<Intrinsics, Intrinsics> resolve_intrinsics(const std::vector<cv::Point2d>& points1,
                                                     const std::vector<cv::Point2d>& points2, const Camera& camera1,
                                                     const Camera& camera2);

/// One sentence where the lens of a camera can hardly be meant so, or an empty one: it shows nothing at many of the
/// keypoints of its image, or four coefficients, legal for OpenCV's pinhole and fisheye model alike, are read as a
/// pinhole's that sees further to the side than such lenses do.
std::string lens_doubt(const Intrinsics& camera, const std::vector<cv::Point2d>& points, int image);

/// Mean of the four focal lengths, pixels: what converts pixel thresholds to the normalised plane.
double mean_focal_length(const cv::Matx33d& K1, const cv::Matx33d& K2);

}  // namespace mgca::detail
