#include "scoring.hpp"

#include <algorithm>
#include <cmath>
#include <random>

namespace mgca::detail {
namespace {

constexpr std::size_t kMaxNetworkMatches = 8000;
// Rejected matches stay this far below the decision threshold, whatever the prior says; over the last part of the way
// their logits are compressed, so that no two that the prior tells apart come out alike.
constexpr double kRejectedMargin = 1e-3;
constexpr double kCompressed = 0.25;

/// A logit below a ceiling: as it is far below it, in the same order near it and above.
float below(double logit, double ceiling) {
    const double above = logit - (ceiling - kCompressed);
    if (above <= 0.0) {
        return static_cast<float>(logit);
    }
    return static_cast<float>(ceiling - kCompressed * kCompressed / (kCompressed + above));
}

}  // namespace

Opinion Opinion::of(const std::vector<float>& logits, const ModelMetadata& metadata) {
    Opinion opinion;
    for (const float logit : logits) {
        opinion.margins.push_back(logit - static_cast<float>(metadata.decision_threshold));
        opinion.log_odds.push_back(metadata.calibration.log_odds(logit));
    }
    return opinion;
}

Opinion Opinion::mean(const std::vector<Opinion>& opinions) {
    Opinion all = opinions.front();
    all.networks = 0;
    const auto count = static_cast<float>(opinions.size());
    for (std::size_t i = 0; i < all.margins.size(); ++i) {
        for (std::size_t k = 1; k < opinions.size(); ++k) {
            all.margins[i] += opinions[k].margins[i];
            all.log_odds[i] += opinions[k].log_odds[i];
        }
        all.margins[i] /= count;
        all.log_odds[i] /= count;
    }
    return all;
}

Opinion Opinion::joined(const Opinion& other, const Rows& rows) const {
    Opinion all = *this;
    all.networks += other.networks;
    const auto share = static_cast<float>(static_cast<double>(other.networks) / all.networks);
    for (std::size_t k = 0; k < rows.size(); ++k) {
        const std::size_t i = rows[k];
        all.margins[i] = (1.0F - share) * all.margins[i] + share * other.margins[k];
        all.log_odds[i] = (1.0F - share) * all.log_odds[i] + share * other.log_odds[k];
    }
    return all;
}

Rows Opinion::undecided(const Rows& rows) const {
    const auto hopeless = static_cast<float>(std::log(kHopelessScore / (1.0 - kHopelessScore)));
    Rows best = rows;
    std::stable_sort(best.begin(), best.end(), [&](std::size_t a, std::size_t b) { return log_odds[a] > log_odds[b]; });
    std::size_t count = std::min(kFewestUndecided, best.size());
    while (count < best.size() && log_odds[best[count]] > hopeless) {
        ++count;
    }
    best.resize(count);
    std::sort(best.begin(), best.end());
    return best;
}

Rows select_network_input(const PairInput& pair, const ModelMetadata& metadata, int seed) {
    Rows valid, rows;
    std::vector<EncodedAttributes> attributes;
    for (std::size_t i = 0; i < pair.valid.size(); ++i) {
        if (pair.valid[i] != 0) {
            valid.push_back(i);
            attributes.push_back(pair.attributes[i]);
        }
    }
    const Mask candidates = candidate_mask(attributes, metadata.candidate_max_ratio, metadata.candidate_min_count);
    for (std::size_t k = 0; k < valid.size(); ++k) {
        if (candidates[k] != 0) {
            rows.push_back(valid[k]);
        }
    }
    if (rows.size() > kMaxNetworkMatches) {
        std::shuffle(rows.begin(), rows.end(), std::mt19937_64(static_cast<std::uint64_t>(seed)));
        const auto ratio = [&](std::size_t i) {
            return pair.attributes[i][kRatioKnown] > 0 ? pair.attributes[i][kRatio] : 1.0F;
        };
        std::stable_sort(rows.begin(), rows.end(), [&](std::size_t a, std::size_t b) { return ratio(a) < ratio(b); });
        rows.resize(kMaxNetworkMatches);
        std::sort(rows.begin(), rows.end());
    }
    return rows;
}

std::optional<NetworkOutput> run_network(const Network& network, const PairInput& pair, const Rows& sent) {
    if (sent.empty()) {
        return std::nullopt;
    }
    std::vector<float> correspondences, attributes;
    for (const std::size_t i : sent) {
        for (const double coordinate : pair.correspondences[i].val) {
            correspondences.push_back(static_cast<float>(coordinate));
        }
        attributes.insert(attributes.end(), pair.attributes[i].begin(), pair.attributes[i].end());
    }
    return network.infer(correspondences, attributes);
}

std::vector<float> prior_logits(const PairInput& pair, const Rows& sent, const ModelMetadata& metadata) {
    std::vector<float> logits(pair.valid.size(), kInvalidLogit);
    Mask unseen(pair.valid.begin(), pair.valid.end());
    for (const std::size_t i : sent) {
        unseen[i] = 0;
    }
    const double ceiling = metadata.decision_threshold - kRejectedMargin;
    for (std::size_t i = 0; i < logits.size(); ++i) {
        if (unseen[i] != 0) {
            logits[i] = below(metadata.prior.logit(pair.attributes[i]), ceiling);
        }
    }
    return logits;
}

std::vector<float> finite_logits(const NetworkOutput& output) {
    std::vector<float> logits = output.logits;
    std::replace_if(logits.begin(), logits.end(), [](float logit) { return !std::isfinite(logit); }, kInvalidLogit);
    return logits;
}

}  // namespace mgca::detail
