#include "attributes.hpp"

#include "statistics.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace mgca::detail {
namespace {

// A keypoint's noise grows with this power of its size; what is known of that is believed within these limits.
constexpr double kNoisePower = 0.75;
constexpr double kLeastNoise = 0.4, kLargestNoise = 3.0;

}  // namespace

std::vector<EncodedAttributes> encode_attributes(const Attributes& known, std::size_t count) {
    std::vector<EncodedAttributes> encoded(count, EncodedAttributes{});
    const bool shapes =
        !known.size1.empty() && !known.size2.empty() && !known.angle1.empty() && !known.angle2.empty();
    for (std::size_t i = 0; i < count; ++i) {
        EncodedAttributes& row = encoded[i];
        if (!known.ratio.empty() && std::isfinite(known.ratio[i])) {
            row[kRatio] = std::clamp(known.ratio[i], 0.0F, 1.0F);
            row[kRatioKnown] = 1.0F;
        }
        if (!known.best.empty()) {
            row[kBest] = known.best[i] != 0 ? 1.0F : 0.0F;
            row[kBestKnown] = 1.0F;
        }
        if (!shapes) {
            continue;
        }
        const double size1 = known.size1[i], size2 = known.size2[i];
        const double angle1 = known.angle1[i], angle2 = known.angle2[i];
        if (size1 > 0 && size2 > 0 && angle1 >= 0 && angle2 >= 0 && std::isfinite(size1) && std::isfinite(size2) &&
            std::isfinite(angle1) && std::isfinite(angle2)) {
            const double turn = (angle2 - angle1) * (CV_PI / 180.0);
            row[kLog2Size] = static_cast<float>(std::log2(size2 / size1));
            row[kCosTurn] = static_cast<float>(std::cos(turn));
            row[kSinTurn] = static_cast<float>(std::sin(turn));
            row[kShapeKnown] = 1.0F;
        }
    }
    return encoded;
}

std::vector<double> relative_noise(const Attributes& known, const Mask& valid) {
    std::vector<double> noise(valid.size(), 1.0);
    if (known.size1.empty() || known.size2.empty()) {
        return noise;
    }
    std::vector<double> sizes(valid.size(), 0.0), usual;  // 0 = unknown
    for (std::size_t i = 0; i < valid.size(); ++i) {
        const double size1 = known.size1[i], size2 = known.size2[i];
        if (size1 > 0 && size2 > 0 && std::isfinite(size1) && std::isfinite(size2)) {
            sizes[i] = std::sqrt(0.5 * (size1 * size1 + size2 * size2));
            if (valid[i] != 0) {
                usual.push_back(sizes[i]);
            }
        }
    }
    if (usual.empty()) {
        return noise;
    }
    const double middle = median(std::move(usual));
    for (std::size_t i = 0; i < valid.size(); ++i) {
        if (sizes[i] > 0) {
            noise[i] = std::clamp(std::pow(sizes[i] / middle, kNoisePower), kLeastNoise, kLargestNoise);
        }
    }
    return noise;
}

Mask candidate_mask(const std::vector<EncodedAttributes>& attributes, double max_ratio, int min_count) {
    Mask candidates(attributes.size(), 1);
    int count = 0;
    for (std::size_t i = 0; i < attributes.size(); ++i) {
        const EncodedAttributes& a = attributes[i];
        const bool known = a[kRatioKnown] > 0 && a[kBestKnown] > 0;
        const bool hopeless = known && (a[kRatio] >= static_cast<float>(max_ratio) || !(a[kBest] > 0));
        candidates[i] = hopeless ? 0 : 1;
        count += hopeless ? 0 : 1;
    }
    if (count < min_count) {
        candidates.assign(attributes.size(), 1);
    }
    return candidates;
}

float distance_ratio(double nearest, double second) {
    if (!std::isfinite(nearest) || !std::isfinite(second)) {
        return std::numeric_limits<float>::quiet_NaN();
    }
    return second <= 0.0 ? 1.0F : static_cast<float>(std::clamp(nearest / second, 0.0, 1.0));
}

std::optional<std::vector<unsigned char>> best_of_list(const std::vector<int>& index2,
                                                       const std::vector<double>& distances) {
    std::vector<double> smallest, known;
    for (std::size_t i = 0; i < index2.size(); ++i) {
        if (index2[i] < 0) {
            continue;
        }
        if (!std::isfinite(distances[i])) {
            return std::nullopt;
        }
        const auto row = static_cast<std::size_t>(index2[i]);
        if (row >= smallest.size()) {
            smallest.resize(row + 1, std::numeric_limits<double>::infinity());
        }
        smallest[row] = std::min(smallest[row], distances[i]);
        known.push_back(distances[i]);
    }
    const auto [low, high] = std::minmax_element(known.begin(), known.end());
    if (known.empty() || (known.size() > 1 && *low == *high)) {
        return std::nullopt;
    }
    std::vector<unsigned char> best(index2.size(), 0);
    for (std::size_t i = 0; i < index2.size(); ++i) {
        best[i] = index2[i] >= 0 && distances[i] <= smallest[static_cast<std::size_t>(index2[i])] ? 1 : 0;
    }
    return best;
}

}  // namespace mgca::detail
