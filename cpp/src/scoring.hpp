// Scores of all matches of a pair: who enters the network, and what the others get; mgca_filter/inference/scoring.py.

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

/// Rows of the candidates among the valid matches, ascending, at most 8000: the best by ratio, and a seeded sample of
/// equals.
Rows select_network_input(const PairInput& pair, const ModelMetadata& metadata, int seed);

/// One forward pass; nothing where no match enters.
std::optional<NetworkOutput> run_network(const Network& network, const PairInput& pair, const Rows& sent);

/// Logits of all matches: the network's, the prior's below the decision threshold, or invalid.
std::vector<float> assemble_logits(const PairInput& pair, const Rows& sent, const std::optional<NetworkOutput>& output,
                                   const ModelMetadata& metadata);

}  // namespace mgca::detail
