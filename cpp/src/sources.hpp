// Sources of hypotheses: one function each, all of one shape, unlike in what they see and how they draw;
// mgca_filter/fit/sources.py.

#pragma once

#include "estimators.hpp"
#include "evidence.hpp"

#include <vector>

namespace mgca::detail {

/// What a source sees; that two of different families find the same pose is worth something.
enum class Family { network, list_uniform, list_ordered, accepted, score_order, plane };

/// What a source is given; the margin counts where the source is `above`.
enum class Source { network, listed, accepted, above };

/// A source as the fit calls it.
struct Proposal {
    const char* name;
    Family family;
    Source source;
    Estimator method = Estimator::magsac;
    double threshold_px = 0.5;
    int iterations = 0;
    int number = 0;       // added to the seed, so that no two draw the same samples
    double margin = 0.0;  // logit above the decision threshold
    bool rough = false;   // with intrinsics, where what it proposes is refined
};

/// What a source proposes, at most a few, unrefined: essential matrices, or fundamental matrices in normalised coordinates
/// where the intrinsics are guessed.
std::vector<cv::Matx33d> propose(const Proposal& proposal, const Evidence& evidence, const EstimatorOptions& options);

/// Essential matrices that the dominant plane among the inliers of a pose allows: its own and its twin.
std::vector<cv::Matx33d> propose_plane(const Evidence& evidence, const Pose& pose, int seed);

}  // namespace mgca::detail
