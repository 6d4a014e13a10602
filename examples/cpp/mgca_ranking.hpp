// Matches in the order in which the robust fit draws them, with what each counts when poses are compared.

#pragma once

#include "mgca_epipolar.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <numeric>
#include <optional>
#include <set>
#include <vector>

namespace mgca {

/// What the robust fit has to know of a match.
struct ScoredMatch {
    Correspondence correspondence;  ///< On the normalised image planes, finite.
    double probability = 1.0;       ///< What it adds to the support of a pose that it agrees with.
    double margin = 0.0;            ///< Its logit above the decision threshold.
    std::optional<double> ratio;    ///< Distance to the nearest over that to the second nearest descriptor, if known.
};

/// Distinct matches, the most promising first.
class RankedMatches {
public:
    /// From matches in any order; one that is listed ten times is there once.
    explicit RankedMatches(const std::vector<ScoredMatch>& matches) {
        std::set<std::array<double, 4>> known;
        for (const std::size_t i : descending(matches, promise)) {
            const Correspondence& c = matches[i].correspondence;
            if (known.insert({c[0], c[1], c[2], c[3]}).second) {
                matches_.push_back(matches[i]);
            }
        }
    }

    std::size_t size() const { return matches_.size(); }

    /// The matches above a margin, in order; the best-scored 32 where those are fewer.
    std::vector<Correspondence> above(double margin) const {
        constexpr std::size_t kMinFitMatches = 32;
        std::vector<bool> chosen;
        for (const ScoredMatch& match : matches_) {
            chosen.push_back(match.margin > margin);
        }
        if (static_cast<std::size_t>(std::count(chosen.begin(), chosen.end(), true)) < kMinFitMatches) {
            std::vector<std::size_t> best =
                descending(matches_, [](const ScoredMatch& match) { return match.margin; });
            best.resize(std::min(best.size(), kMinFitMatches));
            for (const std::size_t i : best) {
                chosen[i] = true;
            }
        }
        std::vector<Correspondence> correspondences;
        for (std::size_t i = 0; i < matches_.size(); ++i) {
            if (chosen[i]) {
                correspondences.push_back(matches_[i].correspondence);
            }
        }
        return correspondences;
    }

    /// Summed probabilities of the matches that agree with a pose and lie in front of both cameras, less the further
    /// off they are (MSAC); the threshold is a Sampson distance, normalised.
    double support(const Pose& pose, double threshold) const {
        const cv::Matx33d E = essential_from_pose(pose);
        double sum = 0.0;
        for (const ScoredMatch& match : matches_) {
            const double distance = sampson_distance(match.correspondence, E) / threshold;
            if (distance < 1.0 && in_front(match.correspondence, pose)) {
                sum += match.probability * (1.0 - distance * distance);
            }
        }
        return sum;
    }

private:
    /// Logits, squashed, order badly where they saturate; the ratio tells such matches apart.
    static double promise(const ScoredMatch& match) {
        const double score = 1.0 / (1.0 + std::exp(-std::clamp(match.margin, -60.0, 60.0)));
        return score * (match.ratio ? 1.2 - *match.ratio : 1.0);
    }

    /// Indices of the matches, those of the largest value first; equals keep their order.
    template <typename Value>
    static std::vector<std::size_t> descending(const std::vector<ScoredMatch>& matches, Value value) {
        std::vector<double> values;
        for (const ScoredMatch& match : matches) {
            values.push_back(value(match));
        }
        std::vector<std::size_t> order(matches.size());
        std::iota(order.begin(), order.end(), std::size_t{0});
        std::stable_sort(order.begin(), order.end(),
                         [&](std::size_t i, std::size_t j) { return values[i] > values[j]; });
        return order;
    }

    std::vector<ScoredMatch> matches_;
};

}  // namespace mgca
