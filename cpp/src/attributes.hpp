// What a matcher knows of each match, as the network reads it; mgca_filter/inputs/attributes.py.

#pragma once

#include "epipolar.hpp"

#include <mgca/filter.hpp>

#include <array>
#include <cstddef>
#include <optional>
#include <vector>

namespace mgca::detail {

constexpr std::size_t kAttributeCount = 8;

/// Columns of the encoded attributes, the network's second input.
enum Column : std::size_t {
    kRatio,
    kBest,
    kLog2Size,
    kCosTurn,
    kSinTurn,
    kRatioKnown,
    kBestKnown,
    kShapeKnown,
};

/// Attributes of one match, raw physical values, then flags (0/1); unknown is zero.
using EncodedAttributes = std::array<float, kAttributeCount>;

/// Network input of `count` matches.
std::vector<EncodedAttributes> encode_attributes(const Attributes& known, std::size_t count);

/// How noisy the position of each match is, the usual match of the list being 1; 1 where it is not known. A detector locates
/// small keypoints better than large ones.
///
/// @param valid the matches that tell what is usual.
std::vector<double> relative_noise(const Attributes& known, const Mask& valid);

/// Matches worth the network's time: best of the list and of a ratio below the largest, as far as that is known; all, when
/// fewer than the least number would remain.
Mask candidate_mask(const std::vector<EncodedAttributes>& attributes, double max_ratio, int min_count);

/// Ratio of nearest to second nearest descriptor distance, 0 ... 1; NaN where one is unknown. Two candidates at distance
/// zero cannot be told apart: their ratio is 1.
float distance_ratio(double nearest, double second);

/// 1 where no other match reaches the same keypoint of image 2 at a smaller distance; nothing where the distances say
/// nothing: some are missing, or several matches all have the same.
std::optional<std::vector<unsigned char>> best_of_list(const std::vector<int>& index2,
                                                       const std::vector<double>& distances);

}  // namespace mgca::detail
