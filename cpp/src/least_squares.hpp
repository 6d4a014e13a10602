// When another step of a Levenberg-Marquardt search no longer pays; mgca_filter/geometry/least_squares.py.

#pragma once

#include <opencv2/core.hpp>

namespace mgca::detail {

// Of the decrease that ends a search.
constexpr double kWorthTrying = 0.1;

/// False where a step would take so little off the cost that it need not be tried.
///
/// @param hessian and gradient of half the sum of squares that stands for the cost near by.
/// @param least a decrease of the cost below this ends the search.
template <int P>
bool promises(const cv::Matx<double, P, P>& hessian, const cv::Matx<double, P, 1>& gradient,
              const cv::Matx<double, P, 1>& step, double least) {
    return -step.dot(2.0 * gradient + hessian * step) >= kWorthTrying * least;
}

}  // namespace mgca::detail
