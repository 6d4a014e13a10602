// From logits to probabilities, and the prior that scores what never entered the network;
// mgca_filter/inference/calibration.py.

#pragma once

#include "attributes.hpp"

#include <array>
#include <vector>

namespace mgca::detail {

/// 1 / (1 + exp(-x)) without overflow.
float sigmoid(float x);

/// Platt scaling: probability = sigmoid(scale * logit + offset).
struct Calibration {
    double scale = 1.0, offset = 0.0;

    /// Logarithm of the odds that a match is an inlier.
    float log_odds(float logit) const;

    float probability(float logit) const { return sigmoid(log_odds(logit)); }

    /// The logit that a probability comes from; 0 and 1 give those of 1e-9 below and above.
    float logit(float probability) const;
};

/// Logit of a match from its attributes alone: weight2 . gelu(weight1 a + bias1) + bias2, hidden units in the rows.
struct AttributePrior {
    std::vector<std::array<double, kAttributeCount>> weight1;
    std::vector<double> bias1, weight2;
    double bias2 = 0.0;

    float logit(const EncodedAttributes& attributes) const;
};

/// The most matches, best scores first, whose mean score is at least the precision; equal scores stay together. What is
/// not valid is never kept.
std::vector<unsigned char> largest_set_of_precision(const std::vector<float>& scores,
                                                    const std::vector<unsigned char>& valid, double precision);

}  // namespace mgca::detail
