// A focal length that both images share, from their matches alone; mgca_filter/fit/focal_estimate.py.

#pragma once

#include "evidence.hpp"
#include "robust_fit.hpp"

#include <optional>

namespace mgca::detail {

struct FocalEstimate {
    double factor;  // on the guessed one
    double sigma;   // standard deviation of its logarithm
};

/// The focal length under which the matches agree best with a pose; nothing where they are few.
///
/// @param evidence scored matches on the image planes normalised by the guessed focal length. F: in the same coordinates.
std::optional<FocalEstimate> estimate_focal(const Evidence& evidence, const cv::Matx33d& F);

/// True where nearly as many matches agree with an essential matrix as with the F that knows no intrinsics.
bool agrees_as_well(const Evidence& evidence, const TwoViewModel& model, const Evidence& free,
                    const TwoViewModel& free_model);

}  // namespace mgca::detail
