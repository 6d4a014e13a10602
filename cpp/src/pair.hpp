// One pair of images as the filter sees it: read, checked and normalised; mgca_filter/inputs/pair.py.

#pragma once

#include "attributes.hpp"
#include "cameras.hpp"
#include "epipolar.hpp"

#include <mgca/filter.hpp>

#include <limits>
#include <string>
#include <vector>

namespace mgca::detail {

/// M matches in the order of the input.
struct PairInput {
    Correspondences correspondences;  // normalised, NaN where a row has no usable coordinates
    Mask valid;                       // 1 where the coordinates are usable
    std::vector<EncodedAttributes> attributes;
    std::vector<double> order;  // ascending = promising: the ratio where it is known, else the distance; NaN = neither
    std::vector<double> noise;  // of the position of each match, by the sizes of its keypoints; 1 = usual in this list
    Intrinsics intrinsics1, intrinsics2;
    double unit_px = 1.0;  // pixels to a unit of the caller's coordinates
    double largest_threshold = 0.0;  // one above this is in pixels of the image in which the keypoints were found
    std::vector<std::string> assumptions;
    // Derivatives of the undistorted pixels by those that were found, one for each match; none without distortion.
    std::vector<cv::Matx22d> stretch1, stretch2;

    bool calibrated() const { return !intrinsics1.guessed; }
    double focal_px() const { return mean_focal_length(intrinsics1.K, intrinsics2.K); }

    /// The pair under the guessed focal lengths times factors, one an image, taken for the truth from now on.
    PairInput with_focals(const cv::Vec2d& factors) const;

    /// Sampson distance of a match to E in pixels as they were found: through a lens its derivative counts.
    double epipolar_distance_px(std::size_t row, const cv::Matx33d& E) const;

    /// The caller's threshold in pixels.
    double threshold_px(double threshold) const {
        return threshold > largest_threshold ? threshold : threshold * unit_px;
    }

    /// Matrices for pixels as ones for the caller's coordinates.
    cv::Matx33d fundamental_in_units(const cv::Matx33d& F) const;
    cv::Matx33d homography_in_units(const cv::Matx33d& H) const;

    /// Undistorted pixels of a normalised match.
    Correspondence pixels(const Correspondence& match) const;
};

/// Read everything that the caller knows of a pair; throws ArgumentError.
PairInput prepare_pair(const MatchPair& pair);

}  // namespace mgca::detail
