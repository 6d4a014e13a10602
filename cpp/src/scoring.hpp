// Scores of all matches of a pair: who enters a network, what the others get, and what several networks say together;
// mgca_filter/inference/scoring.py.

#pragma once

#include "evidence.hpp"
#include "model_file.hpp"
#include "network.hpp"
#include "pair.hpp"

#include <optional>
#include <vector>

namespace mgca::detail {

// Logit of a match without usable coordinates: low enough for a probability of zero under any calibration.
constexpr float kInvalidLogit = -100.0F;
// What scores less is no match for sure: a deeper network need not see it, unless there would be too few.
constexpr double kHopelessScore = 1e-3;
constexpr std::size_t kFewestUndecided = 64;

/// What the networks that were asked say of some matches, each as much as another.
struct Opinion {
    std::vector<float> margins;   // logits above the decision threshold
    std::vector<float> log_odds;  // calibrated
    int networks = 1;             // how many were asked

    /// What one network says, whose logits these are.
    static Opinion of(const std::vector<float>& logits, const ModelMetadata& metadata);

    /// What several say before any was asked: by their priors, say.
    static Opinion mean(const std::vector<Opinion>& opinions);

    /// With what one more network says of the matches that it saw, which stand in `rows` here.
    Opinion joined(const Opinion& other, const Rows& rows) const;

    /// Those of the matches `rows` that a deeper network should see; a few, the best, in any case.
    Rows undecided(const Rows& rows) const;
};

/// Rows of the candidates among the valid matches, ascending, at most 8000: the best by ratio, and a seeded sample of
/// equals.
Rows select_network_input(const PairInput& pair, const ModelMetadata& metadata, int seed);

/// One forward pass; nothing where no match enters.
std::optional<NetworkOutput> run_network(const Network& network, const PairInput& pair, const Rows& sent);

/// Logits of the matches that enter no network: the prior's, below the decision threshold; those of the others invalid.
std::vector<float> prior_logits(const PairInput& pair, const Rows& sent, const ModelMetadata& metadata);

/// Logits of the matches that a network saw; invalid where degenerate input, all points equal, say, left it without a
/// finite answer.
std::vector<float> finite_logits(const NetworkOutput& output);

}  // namespace mgca::detail
