#include "calibration.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>

namespace mgca::detail {
namespace {

/// Gaussian error linear unit, x Phi(x), with Abramowitz & Stegun 7.1.26: absolute error below 1.5e-7, the resolution of
/// float logits, and Python's very numbers.
double gelu(double x) {
    constexpr std::array<double, 5> kCoefficients{1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592};
    const double z = std::abs(x) / std::sqrt(2.0), k = 1.0 / (1.0 + 0.3275911 * z);
    double polynomial = 0.0;
    for (const double coefficient : kCoefficients) {
        polynomial = (polynomial + coefficient) * k;
    }
    const double erf = (x < 0.0 ? -1.0 : 1.0) * (1.0 - polynomial * std::exp(-z * z));
    return x == 0.0 ? 0.0 : 0.5 * x * (1.0 + erf);
}

}  // namespace

float sigmoid(float x) {
    const double e = std::exp(-std::abs(static_cast<double>(x)));
    return static_cast<float>((x >= 0.0F ? 1.0 : e) / (1.0 + e));
}

float Calibration::log_odds(float logit) const {
    return static_cast<float>(scale * static_cast<double>(logit) + offset);
}

float Calibration::logit(float probability) const {
    const double p = std::clamp(static_cast<double>(probability), 1e-9, 1.0 - 1e-9);
    return static_cast<float>((std::log(p) - std::log1p(-p) - offset) / scale);
}

float AttributePrior::logit(const EncodedAttributes& attributes) const {
    double sum = bias2;
    for (std::size_t unit = 0; unit < weight1.size(); ++unit) {
        double x = bias1[unit];
        for (std::size_t i = 0; i < kAttributeCount; ++i) {
            x += weight1[unit][i] * static_cast<double>(attributes[i]);
        }
        sum += weight2[unit] * gelu(x);
    }
    return static_cast<float>(sum);
}

std::vector<unsigned char> largest_set_of_precision(const std::vector<float>& scores,
                                                    const std::vector<unsigned char>& valid, double precision) {
    std::vector<float> descending;
    for (std::size_t i = 0; i < scores.size(); ++i) {
        if (valid[i] != 0) {
            descending.push_back(scores[i]);
        }
    }
    std::sort(descending.begin(), descending.end(), std::greater<>());
    float least = std::numeric_limits<float>::infinity();
    double sum = 0.0;
    for (std::size_t k = 0; k < descending.size(); ++k) {
        sum += static_cast<double>(descending[k]);
        const bool last_of_equals = k + 1 == descending.size() || descending[k + 1] < descending[k];
        if (last_of_equals && sum / static_cast<double>(k + 1) >= precision) {
            least = descending[k];
        }
    }
    std::vector<unsigned char> kept(scores.size());
    for (std::size_t i = 0; i < scores.size(); ++i) {
        kept[i] = valid[i] != 0 && scores[i] >= least ? 1 : 0;
    }
    return kept;
}

}  // namespace mgca::detail
