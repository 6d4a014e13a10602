// What several steps ask of a list of numbers.

#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

namespace mgca::detail {

/// The middle of the values, of which there is at least one; the mean of the two middle ones of an even number.
inline double median(std::vector<double> values) {
    const std::size_t half = values.size() / 2;
    std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(half), values.end());
    const double upper = values[half];
    if (values.size() % 2 == 1) {
        return upper;
    }
    return 0.5 * (upper + *std::max_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(half)));
}

}  // namespace mgca::detail
