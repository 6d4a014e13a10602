#include "cameras.hpp"

#include "opencv_geometry.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <sstream>
#include <tuple>

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
// Points of a camera whose lens shows nothing at so many of them: the coefficients are those of another model.
constexpr double kNowhereShare = 0.2;
// No rectilinear lens is wider than this from its axis into the corner of the image, save for a few.
constexpr double kWidestPinholeDeg = 55.0, kFarthestPercentile = 98.0;
// Half the width of the difference that stands for a derivative.
constexpr double kStretchStepPx = 0.25;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

/// Percentile of at least one value, between neighbours by their distances, as numpy's.
double percentile(std::vector<double> values, double percent) {
    std::sort(values.begin(), values.end());
    const double position = percent / 100.0 * static_cast<double>(values.size() - 1);
    const auto lower = static_cast<std::size_t>(position);
    const std::size_t upper = std::min(lower + 1, values.size() - 1);
    return values[lower] + (position - static_cast<double>(lower)) * (values[upper] - values[lower]);
}

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

/// As undistort, by the fisheye model: the angle off the axis is found by Newton's method.
std::vector<cv::Point2d> undistort(const std::vector<cv::Point2d>& points, const cv::Matx33d& K, const Fisheye& lens) {
    std::vector<cv::Point2d> normalized;
    for (const cv::Point2d& point : points) {
        const cv::Point2d seen = normalize_point(point, K);
        const double radius = cv::norm(seen);
        double theta = std::min(radius, 0.5 * CV_PI), error = 0.0;
        for (int step = 0; step < kUndistortSteps; ++step) {
            const double square = theta * theta;
            const double series =
                1.0 + square * (lens.k1 + square * (lens.k2 + square * (lens.k3 + square * lens.k4)));
            const double slope = 1.0 + square * (3.0 * lens.k1 + square * (5.0 * lens.k2 +
                                                 square * (7.0 * lens.k3 + square * 9.0 * lens.k4)));
            error = theta * series - radius;
            if (std::abs(error) < kUndistortStep) {
                break;
            }
            theta -= error / slope;
        }
        const bool reached = std::abs(error) < kUndistortedWithin && theta >= 0.0 && theta < 0.5 * CV_PI;
        const double scale = radius > 1e-8 ? std::tan(theta) / radius : 1.0;
        normalized.push_back(reached ? seen * scale : cv::Point2d(kNaN, kNaN));
    }
    return normalized;
}

/// Corner and size of the image that keypoints seem to come from.
std::pair<cv::Point2d, cv::Size2d> box(const std::vector<cv::Point2d>& points) {
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
    const cv::Point2d corner(low.x < -kOutsideShare * (high.x - low.x) ? low.x : 0.0,
                             low.y < -kOutsideShare * (high.y - low.y) ? low.y : 0.0);
    return {corner, {std::max(high.x - corner.x + 1.0, 1.0), std::max(high.y - corner.y + 1.0, 1.0)}};
}

double longer(const cv::Size2d& size) { return std::max(size.width, size.height); }

/// A usual lens on an image of a size, or of the keypoints' extent; `longer_side` where both images tell it, else 0.
Intrinsics guess(const std::vector<cv::Point2d>& points, const cv::Size2d& given, int image, double longer_side) {
    cv::Size2d size = given;
    cv::Point2d corner;
    std::string source = "the image size";
    if (given == cv::Size2d()) {
        std::tie(corner, size) = box(points);
        source = "the extent of the keypoints";
    }
    const double focal = kGuessedFocalFactor * (longer_side > 0.0 ? longer_side : longer(size));
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

/// Lens of a camera: coefficients and fisheye.
void read_lens(const Camera& camera, const char* name, Intrinsics& intrinsics) {
    intrinsics.distortion = check_distortion(camera.distortion, name);
    intrinsics.fisheye = camera.fisheye;
    if (!camera.fisheye) {
        return;
    }
    const Fisheye& lens = *camera.fisheye;
    if (!camera.distortion.empty()) {
        throw ArgumentError(std::string(name) + ".distortion: a fisheye has coefficients of its own");
    }
    if (!std::isfinite(lens.k1) || !std::isfinite(lens.k2) || !std::isfinite(lens.k3) || !std::isfinite(lens.k4)) {
        throw ArgumentError(std::string(name) + ".fisheye: expected finite coefficients");
    }
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
        if (!distorts()) {
            normalized[i] = normalize_point(points[i], K);
        } else {
            rows.push_back(i);
            finite.push_back(points[i]);
        }
    }
    if (!rows.empty()) {
        const std::vector<cv::Point2d> undistorted =
            fisheye ? undistort(finite, K, *fisheye) : undistort(finite, K, distortion);
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
        if ((!camera->distortion.empty() || camera->fisheye) && !camera1.K) {
            throw ArgumentError(std::string(name) + ".distortion: distortion coefficients need K");
        }
        check_size(camera->size, name);
    }
    if (!camera1.K) {
        // Where no size is known, one camera is likelier than two, and the larger extent says more of it.
        const bool unknown = camera1.size == cv::Size2d() && camera2.size == cv::Size2d();
        const double shared = unknown ? std::max(longer(box(points1).second), longer(box(points2).second)) : 0.0;
        return {guess(points1, camera1.size, 1, shared), guess(points2, camera2.size, 2, shared)};
    }
    Intrinsics first, second;
    first.K = check_K(*camera1.K, "camera1");
    read_lens(camera1, "camera1", first);
    if (!camera2.K) {
        second = first;
        if (!camera2.distortion.empty() || camera2.fisheye) {
            read_lens(camera2, "camera2", second);
        }
        second.assumption = "both images share K1";
        return {first, second};
    }
    second.K = check_K(*camera2.K, "camera2");
    read_lens(camera2, "camera2", second);
    return {first, second};
}

std::vector<cv::Matx22d> Intrinsics::stretch(const std::vector<cv::Point2d>& points) const {
    std::vector<cv::Matx22d> result;
    if (!distorts()) {
        return result;
    }
    result.resize(points.size());
    for (int k = 0; k < 2; ++k) {
        const cv::Point2d step(k == 0 ? kStretchStepPx : 0.0, k == 1 ? kStretchStepPx : 0.0);
        std::vector<cv::Point2d> after = points, before = points;
        for (std::size_t i = 0; i < points.size(); ++i) {
            after[i] += step;
            before[i] -= step;
        }
        after = normalize(after);
        before = normalize(before);
        for (std::size_t i = 0; i < points.size(); ++i) {
            result[i](0, k) = (after[i].x - before[i].x) * K(0, 0) / (2.0 * kStretchStepPx);
            result[i](1, k) = (after[i].y - before[i].y) * K(1, 1) / (2.0 * kStretchStepPx);
        }
    }
    return result;
}

std::string lens_doubt(const Intrinsics& camera, const std::vector<cv::Point2d>& points, int image) {
    std::vector<cv::Point2d> finite;
    std::copy_if(points.begin(), points.end(), std::back_inserter(finite),
                 [](const cv::Point2d& point) { return std::isfinite(point.x) && std::isfinite(point.y); });
    if (!camera.distorts() || finite.empty()) {
        return "";
    }
    std::vector<double> radii;
    for (const cv::Point2d& x : camera.normalize(finite)) {
        if (!std::isnan(x.x) && !std::isnan(x.y)) {
            radii.push_back(cv::norm(x));
        }
    }
    const std::string number = std::to_string(image);
    const std::string advice = "; if they are a fisheye's, pass Fisheye(k1, k2, k3, k4)";
    const bool plain = !camera.fisheye && camera.distortion.size() == 4;
    const double share = 1.0 - static_cast<double>(radii.size()) / static_cast<double>(finite.size());
    if (share > kNowhereShare) {
        return "dist" + number + " shows nothing at " + std::to_string(std::llround(100.0 * share)) +
               " % of the keypoints of image " + number + (plain ? advice : "");
    }
    const double angle_deg = std::atan(percentile(radii, kFarthestPercentile)) * 180.0 / CV_PI;
    if (plain && angle_deg > kWidestPinholeDeg) {
        return "the four coefficients of dist" + number + " are read as a pinhole's, and keypoints of image " + number +
               " lie up to " + std::to_string(std::llround(angle_deg)) + "° off its axis" + advice;
    }
    return "";
}

double mean_focal_length(const cv::Matx33d& K1, const cv::Matx33d& K2) {
    return (K1(0, 0) + K1(1, 1) + K2(0, 0) + K2(1, 1)) / 4.0;
}

}  // namespace mgca::detail
