// What is known of a pair before a model is fitted: distinct matches, their order, what the network says of them;
// mgca_filter/fit/evidence.py.

#pragma once

#include "epipolar.hpp"
#include "pair.hpp"

#include <cstddef>
#include <optional>
#include <vector>

namespace mgca::detail {

using Rows = std::vector<std::size_t>;

// A pose has five degrees of freedom: the sixth match is the first that bears it out. With so many as the second number
// a fundamental matrix can be told as well, and inliers are enough however long the list is.
constexpr std::size_t kMinMatches = 6, kFirmMatches = 8;
// Matches that the network gives this probability are accepted; with fewer than so many the best-scored stand in.
constexpr double kAcceptedScore = 0.3;
constexpr std::size_t kMinAccepted = 32;

/// What the network said of the matches that it saw.
struct NetworkEvidence {
    std::vector<double> scores;   // probabilities
    std::vector<double> margins;  // logits above the decision threshold, which tell saturated scores apart
    cv::Matx33d essential;        // of any scale, perhaps not finite
};

/// N distinct matches, the most promising first.
struct Evidence {
    Rows rows;                         // where each stands in the list that it comes from
    Correspondences correspondences;   // normalised, finite; sources sample from all of them
    Mask once;                         // those whose keypoints stand in no better one: refinement and choice count these
    Mask listed;                       // what a classical pipeline would fit to
    std::vector<double> order;         // ascending = promising without a network; NaN = unknown
    std::vector<double> noise;         // of the positions, by the sizes of the keypoints; 1 = usual in the list
    double focal_px = 1.0;             // mean focal length
    bool calibrated = true;            // the intrinsics can be trusted
    std::optional<NetworkEvidence> network;  // nothing before it has run

    std::size_t size() const { return rows.size(); }

    /// Listed matches in the order that is known without a network.
    Correspondences by_list_order() const;

    /// Positions that the network accepts, best first; the listed ones before it has run.
    Rows accepted() const;

    /// Positions whose logit lies above the decision threshold by more, best first; else the 32 best-scored.
    Rows above(double margin) const;

    /// The network E; nothing where there is none that could be used.
    std::optional<cv::Matx33d> network_essential() const;

    Correspondences take(const Rows& positions) const;
};

/// The listed matches of a pair, in the order that is known without a network.
Evidence gather_before(const PairInput& pair);

/// The matches that the network saw, best first.
///
/// @param candidates rows that entered the network. scores, margins: of all matches.
Evidence gather_scored(const PairInput& pair, const Rows& candidates, const std::vector<float>& scores,
                       const std::vector<float>& margins, const cv::Matx33d& network_essential);

/// Matches that a classical pipeline would fit to: all of a list in which no two reach for the same keypoint, of a raw one
/// the best of the list with a ratio below 0.9.
Mask listed_rows(const std::vector<EncodedAttributes>& attributes, const Mask& valid);

/// Positions of the distinct matches, ascending; of equal ones the first counts.
Rows distinct_rows(const Correspondences& matches);

/// Of distinct matches, best first, those whose points in either image stand in no better one.
Mask one_to_one(const Correspondences& matches);

}  // namespace mgca::detail
