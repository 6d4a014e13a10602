#include "evidence.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace mgca::detail {
namespace {

// Of a raw list, where several matches reach for one keypoint, classical pipelines keep the best with a ratio below.
constexpr float kRawMaxRatio = 0.9F;

Rows all_rows(std::size_t count) {
    Rows rows(count);
    std::iota(rows.begin(), rows.end(), std::size_t{0});
    return rows;
}

Rows set_rows(const Mask& mask) {
    Rows rows;
    for (std::size_t i = 0; i < mask.size(); ++i) {
        if (mask[i] != 0) {
            rows.push_back(i);
        }
    }
    return rows;
}

/// Sort positions by a value of each, ascending; equal ones keep their order.
template <typename Value>
void sort_by(Rows& positions, const Value& value) {
    std::stable_sort(positions.begin(), positions.end(),
                     [&](std::size_t a, std::size_t b) { return value(a) < value(b); });
}

double known_or_last(double order) { return std::isnan(order) ? std::numeric_limits<double>::infinity() : order; }

/// Of `candidates` those whose values (first to last coordinate) stand in no earlier one, in their order.
Rows first_of_equals(const Correspondences& matches, const Rows& candidates, int first, int last) {
    const auto compare = [&](std::size_t a, std::size_t b) {
        for (int i = first; i < last; ++i) {
            const double x = matches[candidates[a]][i], y = matches[candidates[b]][i];
            if (x != y) {
                return x < y ? -1 : 1;
            }
        }
        return 0;
    };
    Rows ascending = all_rows(candidates.size());
    std::sort(ascending.begin(), ascending.end(), [&](std::size_t a, std::size_t b) {
        const int order = compare(a, b);
        return order != 0 ? order < 0 : a < b;
    });
    Rows kept;
    for (std::size_t k = 0; k < ascending.size(); ++k) {
        if (k == 0 || compare(ascending[k], ascending[k - 1]) != 0) {
            kept.push_back(ascending[k]);
        }
    }
    std::sort(kept.begin(), kept.end());
    for (std::size_t& row : kept) {
        row = candidates[row];
    }
    return kept;
}

Evidence gather(const PairInput& pair, const Rows& ordered) {
    Evidence evidence;
    evidence.focal_px = pair.focal_px();
    evidence.calibrated = pair.calibrated();
    evidence.rows = first_of_equals(pair.correspondences, ordered, 0, 4);
    for (const std::size_t row : evidence.rows) {
        evidence.correspondences.push_back(pair.correspondences[row]);
        evidence.order.push_back(pair.order[row]);
        evidence.noise.push_back(pair.noise[row]);
    }
    evidence.once = one_to_one(evidence.correspondences);
    return evidence;
}

}  // namespace

Correspondences Evidence::take(const Rows& positions) const {
    return detail::take(correspondences, positions);
}

Correspondences Evidence::by_list_order() const {
    Rows positions = set_rows(listed);
    sort_by(positions, [&](std::size_t i) { return known_or_last(order[i]); });
    return take(positions);
}

Rows Evidence::accepted() const {
    if (!network) {
        return set_rows(listed);
    }
    Rows chosen;
    for (std::size_t i = 0; i < size(); ++i) {
        if (network->scores[i] > kAcceptedScore) {
            chosen.push_back(i);
        }
    }
    return chosen.size() >= kMinAccepted ? chosen : above(std::numeric_limits<double>::infinity());
}

Rows Evidence::above(double margin) const {
    if (!network) {
        return set_rows(listed);
    }
    Rows chosen;
    for (std::size_t i = 0; i < size(); ++i) {
        if (network->margins[i] > margin) {
            chosen.push_back(i);
        }
    }
    if (chosen.size() >= kMinAccepted) {
        return chosen;
    }
    chosen = all_rows(size());
    sort_by(chosen, [&](std::size_t i) { return -network->margins[i]; });
    chosen.resize(std::min(chosen.size(), kMinAccepted));
    std::sort(chosen.begin(), chosen.end());
    return chosen;
}

std::optional<cv::Matx33d> Evidence::network_essential() const {
    return network && usable(network->essential) ? std::optional(network->essential) : std::nullopt;
}

Evidence gather_before(const PairInput& pair) {
    Rows rows = set_rows(listed_rows(pair.attributes, pair.valid));
    sort_by(rows, [&](std::size_t i) { return known_or_last(pair.order[i]); });
    Evidence evidence = gather(pair, rows);
    evidence.listed.assign(evidence.size(), 1);
    return evidence;
}

Evidence gather_scored(const PairInput& pair, const Rows& candidates, const std::vector<float>& scores,
                       const std::vector<float>& margins, const cv::Matx33d& network_essential) {
    // Logits above the decision threshold, squashed, order badly where they saturate; the descriptor ratio, where it is
    // known, tells such matches apart.
    std::vector<double> quality(pair.valid.size(), 0.0);
    for (const std::size_t i : candidates) {
        const EncodedAttributes& a = pair.attributes[i];
        const double score = 1.0 / (1.0 + std::exp(-std::clamp(static_cast<double>(margins[i]), -60.0, 60.0)));
        quality[i] = score * (a[kRatioKnown] > 0 ? 1.2 - static_cast<double>(a[kRatio]) : 1.0);
    }
    Rows rows = candidates;
    sort_by(rows, [&](std::size_t i) { return -quality[i]; });
    Evidence evidence = gather(pair, rows);
    const Mask listed = listed_rows(pair.attributes, pair.valid);
    NetworkEvidence network;
    network.essential = network_essential;
    for (const std::size_t row : evidence.rows) {
        evidence.listed.push_back(listed[row]);
        network.scores.push_back(scores[row]);
        network.margins.push_back(margins[row]);
    }
    evidence.network = std::move(network);
    return evidence;
}

Mask listed_rows(const std::vector<EncodedAttributes>& attributes, const Mask& valid) {
    bool raw = false;
    Mask kept = valid;
    std::size_t count = 0;
    for (std::size_t i = 0; i < valid.size(); ++i) {
        const EncodedAttributes& a = attributes[i];
        const bool lost = a[kBestKnown] > 0 && !(a[kBest] > 0);
        const bool ambiguous = a[kRatioKnown] > 0 && a[kRatio] >= kRawMaxRatio;
        raw = raw || (lost && valid[i] != 0);
        kept[i] = valid[i] != 0 && !lost && !ambiguous;
        count += kept[i];
    }
    return raw && count >= kFirmMatches ? kept : valid;
}

Rows distinct_rows(const Correspondences& matches) {
    return first_of_equals(matches, all_rows(matches.size()), 0, 4);
}

Mask one_to_one(const Correspondences& matches) {
    Rows rows = first_of_equals(matches, all_rows(matches.size()), 0, 2);
    rows = first_of_equals(matches, rows, 2, 4);
    Mask chosen(matches.size(), 0);
    for (const std::size_t row : rows) {
        chosen[row] = 1;
    }
    return chosen;
}

}  // namespace mgca::detail
