#include "cameras.hpp"

#include "opencv_geometry.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

namespace mgca::detail {
namespace {

constexpr double kGuessedFocalFactor = 1.2;
// Removing distortion moves points a little out of the image; further out than this share of their extent, and the
// origin is no corner of it.
constexpr double kOutsideShare = 0.1;
// A coordinate beyond this comes from broken input and says nothing of the size of an image.
constexpr double kLargestPx = 1e6;
// The five steps that OpenCV takes unasked leave errors of a pixel in the corners of a wide lens.
constexpr int kUndistortSteps = 50;
constexpr double kUndistortStep = 1e-9;
constexpr double kUndistortedWithin = 1e-4;  // of the focal length

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

cv::Point2d normalize_point(const cv::Point2d& point, const cv::Matx33d& K) {
    const double y = (point.y - K(1, 2)) / K(1, 1);
    return {(point.x - K(0, 2) - K(0, 1) * y) / K(0, 0), y};
}

/// Pixels to the normalised plane; NaN where no point of the plane is distorted to the pixel.
std::vector<cv::Point2d> undistort(const std::vector<cv::Point2d>& points, const cv::Matx33d& K,
                                   const std::vector<double>& coefficients) {
    std::vector<cv::Point2d> normalized, distorted;
    const cv::TermCriteria criteria(cv::TermCriteria::COUNT | cv::TermCriteria::EPS, kUndistortSteps, kUndistortStep);
    try {
        cv::undistortPoints(points, normalized, K, coefficients, cv::noArray(), cv::noArray(), criteria);
        std::vector<cv::Point3d> rays;
        for (const cv::Point2d& point : normalized) {
            rays.emplace_back(point.x, point.y, 1.0);
        }
        const cv::Vec3d nowhere;
        cv::projectPoints(rays, nowhere, nowhere, K, coefficients, distorted);
    } catch (const cv::Exception&) {
        return std::vector<cv::Point2d>(points.size(), {kNaN, kNaN});
    }
    for (std::size_t i = 0; i < points.size(); ++i) {
        if (!(cv::norm(distorted[i] - points[i]) < kUndistortedWithin * K(0, 0))) {
            normalized[i] = {kNaN, kNaN};
        }
    }
    return normalized;
}

Intrinsics guess(const std::vector<cv::Point2d>& points, const cv::Size2d& given, int image) {
    cv::Size2d size = given;
    cv::Point2d corner;
    std::string source = "the image size";
    if (given == cv::Size2d()) {
        constexpr double kInfinity = std::numeric_limits<double>::infinity();
        cv::Point2d low(kInfinity, kInfinity), high(-kInfinity, -kInfinity);
        for (const cv::Point2d& point : points) {
            if (std::abs(point.x) < kLargestPx && std::abs(point.y) < kLargestPx) {
                low = {std::min(low.x, point.x), std::min(low.y, point.y)};
                high = {std::max(high.x, point.x), std::max(high.y, point.y)};
            }
        }
        if (low.x > high.x) {
            low = high = {0.0, 0.0};
        }
        // Points left of or above the image say that its corner is not the origin: the middle is that of the points.
        corner.x = low.x < -kOutsideShare * (high.x - low.x) ? low.x : 0.0;
        corner.y = low.y < -kOutsideShare * (high.y - low.y) ? low.y : 0.0;
        size = {std::max(high.x - corner.x + 1.0, 1.0), std::max(high.y - corner.y + 1.0, 1.0)};
        source = "the extent of the keypoints";
    }
    const double focal = kGuessedFocalFactor * std::max(size.width, size.height);
    Intrinsics intrinsics;
    intrinsics.K = {focal, 0.0,   corner.x + (size.width - 1.0) / 2.0,
                    0.0,   focal, corner.y + (size.height - 1.0) / 2.0,
                    0.0,   0.0,   1.0};
    intrinsics.guessed = true;
    std::ostringstream sentence;
    sentence << "focal length " << std::llround(focal) << " px of image " << image << " guessed from " << source;
    intrinsics.assumption = sentence.str();
    return intrinsics;
}

cv::Matx33d check_K(const cv::Matx33d& K, const char* name) {
    const bool finite = std::all_of(K.val, K.val + 9, [](double value) { return std::isfinite(value); });
    const auto close = [](double value, double wanted) { return std::abs(value - wanted) <= 1e-8 + 1e-5 * wanted; };
    if (!finite || !close(K(2, 0), 0.0) || !close(K(2, 1), 0.0) || !close(K(2, 2), 1.0) || K(1, 0) != 0.0 ||
        K(0, 0) <= 0.0 || K(1, 1) <= 0.0) {
        throw ArgumentError(std::string(name) + ".K: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0");
    }
    return K;
}

std::vector<double> check_distortion(const std::vector<double>& coefficients, const char* name) {
    const std::size_t count = coefficients.size();
    if (count == 0) {
        return {};
    }
    if (count != 4 && count != 5 && count != 8 && count != 12 && count != 14) {
        throw ArgumentError(std::string(name) + ".distortion: expected 4, 5, 8, 12 or 14 coefficients, got " +
                            std::to_string(count));
    }
    if (!std::all_of(coefficients.begin(), coefficients.end(), [](double value) { return std::isfinite(value); })) {
        throw ArgumentError(std::string(name) + ".distortion: expected finite coefficients");
    }
    const bool all_zero =
        std::all_of(coefficients.begin(), coefficients.end(), [](double value) { return value == 0.0; });
    return all_zero ? std::vector<double>{} : coefficients;
}

void check_size(const cv::Size2d& size, const char* name) {
    if (size != cv::Size2d() && (!(size.width >= 1.0) || !(size.height >= 1.0) || !std::isfinite(size.width) ||
                                 !std::isfinite(size.height))) {
        throw ArgumentError(std::string(name) + ".size: expected width and height of at least one pixel each");
    }
}

}  // namespace

std::vector<cv::Point2d> Intrinsics::normalize(const std::vector<cv::Point2d>& points) const {
    std::vector<cv::Point2d> normalized(points.size(), {kNaN, kNaN}), finite;
    std::vector<std::size_t> rows;
    for (std::size_t i = 0; i < points.size(); ++i) {
        if (!std::isfinite(points[i].x) || !std::isfinite(points[i].y)) {
            continue;
        }
        if (distortion.empty()) {
            normalized[i] = normalize_point(points[i], K);
        } else {
            rows.push_back(i);
            finite.push_back(points[i]);
        }
    }
    if (!rows.empty()) {
        const std::vector<cv::Point2d> undistorted = undistort(finite, K, distortion);
        for (std::size_t k = 0; k < rows.size(); ++k) {
            normalized[rows[k]] = undistorted[k];
        }
    }
    return normalized;
}

cv::Point2d Intrinsics::project(double x, double y) const {
    return {K(0, 0) * x + K(0, 1) * y + K(0, 2), K(1, 1) * y + K(1, 2)};
}

std::pair<Intrinsics, Intrinsics> resolve_intrinsics(const std::vector<cv::Point2d>& points1,
                                                     const std::vector<cv::Point2d>& points2, const Camera& camera1,
                                                     const Camera& camera2) {
    if (!camera1.K && camera2.K) {
        throw ArgumentError("camera1.K: expected a matrix, because camera2 has one");
    }
    for (const auto& [name, camera] : {std::pair{"camera1", &camera1}, std::pair{"camera2", &camera2}}) {
        if (!camera->distortion.empty() && !camera1.K) {
            throw ArgumentError(std::string(name) + ".distortion: distortion coefficients need K");
        }
        check_size(camera->size, name);
    }
    if (!camera1.K) {
        return {guess(points1, camera1.size, 1), guess(points2, camera2.size, 2)};
    }
    Intrinsics first{check_K(*camera1.K, "camera1"), check_distortion(camera1.distortion, "camera1"), false, ""};
    if (!camera2.K) {
        Intrinsics second = first;
        if (!camera2.distortion.empty()) {
            second.distortion = check_distortion(camera2.distortion, "camera2");
        }
        second.assumption = "both images share K1";
        return {first, second};
    }
    return {first, {check_K(*camera2.K, "camera2"), check_distortion(camera2.distortion, "camera2"), false, ""}};
}

double mean_focal_length(const cv::Matx33d& K1, const cv::Matx33d& K2) {
    return (K1(0, 0) + K1(1, 1) + K2(0, 0) + K2(1, 1)) / 4.0;
}

}  // namespace mgca::detail
