#include "pair.hpp"

#include <algorithm>
#include <cmath>
#include <optional>
#include <sstream>
#include <tuple>
#include <utility>

namespace mgca::detail {
namespace {

// Coordinates are taken for pixels unless both the focal length and the extent of the keypoints are smaller than any
// camera's, as where the caller normalised the points or measures in millimetres on the sensor. Without a focal length
// the extent alone must be that of normalised points.
constexpr double kLeastFocalPx = 100.0, kLeastExtentPx = 50.0, kLeastExtentAlonePx = 10.0;
// Then a pixel is this part of the focal length, or of the extent.
constexpr double kUsualPixels = 1000.0;
// A threshold above this part of the focal length or extent is meant in pixels all the same.
constexpr double kLargestThresholdShare = 0.01;
// Images of one camera differ no more than this in size, unless one of them was resized, cropped or turned.
constexpr double kSameSizeShare = 0.01;
// Normalised coordinates beyond this (89.9 degrees off the axis) come from broken input, not from a lens.
constexpr double kMaxNormalized = 1e3;
// OpenCV's default of DMatch.distance is the largest float: "no distance was set".
constexpr double kNoDistance = 1e38;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr float kNaNf = std::numeric_limits<float>::quiet_NaN();

void check_length(std::size_t length, std::size_t count, const char* name) {
    if (length != 0 && length != count) {
        throw ArgumentError(std::string(name) + ": expected " + std::to_string(count) + " values or none, got " +
                            std::to_string(length));
    }
}

void check_keypoints(const Keypoints& keypoints, const std::string& name) {
    check_length(keypoints.sizes.size(), keypoints.points.size(), (name + ".sizes").c_str());
    check_length(keypoints.angles.size(), keypoints.points.size(), (name + ".angles").c_str());
}

void check_matches(const Matches& matches, std::size_t count1, std::size_t count2) {
    const std::size_t count = matches.index1.size();
    if (matches.index2.size() != count) {
        throw ArgumentError("matches: index1 and index2 differ in length");
    }
    check_length(matches.distances.size(), count, "matches.distances");
    check_length(matches.second_distances.size(), count, "matches.second_distances");
    const auto outside = [](int index, std::size_t limit) {
        return index < 0 || static_cast<std::size_t>(index) >= limit;
    };
    for (std::size_t i = 0; i < count; ++i) {
        const bool absent = matches.index1[i] == -1 && matches.index2[i] == -1;
        if (!absent && (outside(matches.index1[i], count1) || outside(matches.index2[i], count2))) {
            throw ArgumentError("matches[" + std::to_string(i) + "]: index out of range for " + std::to_string(count1) +
                                " and " + std::to_string(count2) + " keypoints");
        }
    }
}

void check_shared_camera(const MatchPair& pair) {
    const cv::Size2d a = pair.camera1.size, b = pair.camera2.size;
    if (!pair.camera1.K || pair.camera2.K || a == cv::Size2d() || b == cv::Size2d()) {
        return;
    }
    if (std::abs(a.width - b.width) > kSameSizeShare * std::max(a.width, b.width) ||
        std::abs(a.height - b.height) > kSameSizeShare * std::max(a.height, b.height)) {
        throw ArgumentError("camera2.K: one K cannot be right for images of different size; give both cameras theirs");
    }
}

/// The longer side of the box around the finite points.
double extent(const std::vector<cv::Point2d>& points) {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    cv::Point2d low(kInfinity, kInfinity), high(-kInfinity, -kInfinity);
    for (const cv::Point2d& point : points) {
        if (std::isfinite(point.x) && std::isfinite(point.y)) {
            low = {std::min(low.x, point.x), std::min(low.y, point.y)};
            high = {std::max(high.x, point.x), std::max(high.y, point.y)};
        }
    }
    return low.x > high.x ? 0.0 : std::max(high.x - low.x, high.y - low.y);
}

/// How many pixels a unit of the coordinates is, and the length, in units, that is taken for 1000 pixels.
std::pair<double, double> pixels_per_unit(const Intrinsics& first, const Intrinsics& second, double extent) {
    if (first.guessed) {
        return 0.0 < extent && extent < kLeastExtentAlonePx ? std::pair{kUsualPixels / extent, extent}
                                                            : std::pair{1.0, kUsualPixels};
    }
    const double focal = mean_focal_length(first.K, second.K);
    return focal < kLeastFocalPx && extent < kLeastExtentPx ? std::pair{kUsualPixels / focal, focal}
                                                            : std::pair{1.0, kUsualPixels};
}

std::vector<cv::Point2d> scaled(std::vector<cv::Point2d> points, double factor) {
    for (cv::Point2d& point : points) {
        point *= factor;
    }
    return points;
}

/// A value of each match's keypoint; NaN where a row holds no match.
std::vector<float> gather(const std::vector<float>& values, const std::vector<int>& index) {
    std::vector<float> gathered;
    gathered.reserve(index.size());
    for (const int row : index) {
        gathered.push_back(row < 0 ? kNaNf : values[static_cast<std::size_t>(row)]);
    }
    return gathered;
}

/// What matches and keypoints know, overridden by what the caller gave field by field.
Attributes merge_attributes(const MatchPair& pair, const std::vector<double>& distances) {
    const Matches& matches = pair.matches;
    const std::size_t count = matches.index1.size();
    Attributes known;
    if (!distances.empty() && !matches.second_distances.empty()) {
        for (std::size_t i = 0; i < count; ++i) {
            const double second = matches.second_distances[i];
            known.ratio.push_back(distance_ratio(distances[i], std::abs(second) < kNoDistance ? second : kNaN));
        }
        if (std::all_of(known.ratio.begin(), known.ratio.end(), [](float ratio) { return std::isnan(ratio); })) {
            known.ratio.clear();
        }
    }
    if (!distances.empty()) {
        known.best = best_of_list(matches.index2, distances).value_or(std::vector<unsigned char>{});
    }
    const auto shaped = [](const Keypoints& keypoints) { return !keypoints.sizes.empty() && !keypoints.angles.empty(); };
    if (shaped(pair.keypoints1)) {
        known.size1 = gather(pair.keypoints1.sizes, matches.index1);
        known.angle1 = gather(pair.keypoints1.angles, matches.index1);
    }
    if (shaped(pair.keypoints2)) {
        known.size2 = gather(pair.keypoints2.sizes, matches.index2);
        known.angle2 = gather(pair.keypoints2.angles, matches.index2);
    }
    const auto override_by = [&](auto Attributes::*field, const char* name) {
        const auto& given = pair.attributes.*field;
        check_length(given.size(), count, name);
        if (!given.empty()) {
            known.*field = given;
        }
    };
    override_by(&Attributes::ratio, "attributes.ratio");
    override_by(&Attributes::best, "attributes.best");
    override_by(&Attributes::size1, "attributes.size1");
    override_by(&Attributes::size2, "attributes.size2");
    override_by(&Attributes::angle1, "attributes.angle1");
    override_by(&Attributes::angle2, "attributes.angle2");
    return known;
}

/// What tells promising matches from others without a network, ascending; NaN where nothing does.
std::vector<double> order_of(const Attributes& known, const std::vector<double>& distances, std::size_t count) {
    if (std::any_of(known.ratio.begin(), known.ratio.end(), [](float ratio) { return std::isfinite(ratio); })) {
        return {known.ratio.begin(), known.ratio.end()};
    }
    return distances.empty() ? std::vector<double>(count, kNaN) : distances;
}

/// Where the derivative is not known, that of no distortion stands.
std::vector<cv::Matx22d> stretch_of_matches(const Intrinsics& camera, const std::vector<cv::Point2d>& points,
                                            const std::vector<int>& index) {
    std::vector<cv::Matx22d> of_matches;
    if (!camera.distorts()) {
        return of_matches;
    }
    const std::vector<cv::Matx22d> stretch = camera.stretch(points);
    for (const int row : index) {
        cv::Matx22d value = row < 0 ? cv::Matx22d::eye() : stretch[static_cast<std::size_t>(row)];
        if (!std::all_of(value.val, value.val + 4, [](double x) { return std::isfinite(x); })) {
            value = cv::Matx22d::eye();
        }
        of_matches.push_back(value);
    }
    return of_matches;
}

}  // namespace

PairInput PairInput::with_focals(const cv::Vec2d& factors) const {
    PairInput zoomed = *this;
    for (Correspondence& match : zoomed.correspondences) {
        match = {match[0] / factors[0], match[1] / factors[0], match[2] / factors[1], match[3] / factors[1]};
    }
    for (const auto& [camera, factor] :
         {std::pair{&zoomed.intrinsics1, factors[0]}, std::pair{&zoomed.intrinsics2, factors[1]}}) {
        for (const auto& [row, column] : {std::pair{0, 0}, std::pair{0, 1}, std::pair{1, 1}}) {
            camera->K(row, column) *= factor;
        }
        camera->guessed = false;
    }
    return zoomed;
}

double PairInput::epipolar_distance_px(std::size_t row, const cv::Matx33d& E) const {
    const Correspondence& match = correspondences[row];
    const cv::Vec3d line2 = E * ray1(match), line1 = E.t() * ray2(match);
    cv::Vec2d normal1(line1[0], line1[1]), normal2(line2[0], line2[1]);
    if (!stretch1.empty()) {
        normal1 = stretch1[row].t() * normal1;
    }
    if (!stretch2.empty()) {
        normal2 = stretch2[row].t() * normal2;
    }
    const double squared_norm = normal1.dot(normal1) + normal2.dot(normal2);
    return std::abs(ray2(match).dot(line2)) / std::sqrt(std::max(squared_norm, std::numeric_limits<double>::min())) *
           focal_px();
}

cv::Matx33d PairInput::fundamental_in_units(const cv::Matx33d& F) const {
    if (unit_px == 1.0) {
        return F;
    }
    const cv::Matx33d unit = cv::Matx33d::diag({unit_px, unit_px, 1.0});
    const cv::Matx33d converted = unit * F * unit;
    return converted * (1.0 / cv::norm(converted));
}

cv::Matx33d PairInput::homography_in_units(const cv::Matx33d& H) const {
    const cv::Matx33d unit = cv::Matx33d::diag({unit_px, unit_px, 1.0});
    const cv::Matx33d converted = unit.inv() * H * unit;
    return std::abs(converted(2, 2)) > 1e-12 ? converted * (1.0 / converted(2, 2)) : converted;
}

Correspondence PairInput::pixels(const Correspondence& match) const {
    const cv::Point2d first = intrinsics1.project(match[0], match[1]), second = intrinsics2.project(match[2], match[3]);
    return {first.x, first.y, second.x, second.y};
}

PairInput prepare_pair(const MatchPair& pair) {
    const std::vector<cv::Point2d>&given_points1 = pair.keypoints1.points, &given_points2 = pair.keypoints2.points;
    check_keypoints(pair.keypoints1, "keypoints1");
    check_keypoints(pair.keypoints2, "keypoints2");
    check_matches(pair.matches, given_points1.size(), given_points2.size());
    const auto [given1, given2] = resolve_intrinsics(given_points1, given_points2, pair.camera1, pair.camera2);
    check_shared_camera(pair);

    if (!(pair.resolution > 0.0) || !std::isfinite(pair.resolution)) {
        throw ArgumentError("resolution: expected a number above 0");
    }
    PairInput input;
    const double size = std::max(extent(given_points1), extent(given_points2));
    const auto [per_unit, yardstick] = pixels_per_unit(given1, given2, size);
    const bool in_pixels = per_unit == 1.0;
    const double unit_px = in_pixels ? 1.0 / pair.resolution : per_unit;
    const std::vector<cv::Point2d> points1 = scaled(given_points1, unit_px), points2 = scaled(given_points2, unit_px);
    input.unit_px = unit_px;
    input.intrinsics1 = given1;
    input.intrinsics2 = given2;
    if (!in_pixels && given1.guessed) {
        std::tie(input.intrinsics1, input.intrinsics2) = resolve_intrinsics(points1, points2, {}, {});
    } else if (unit_px != 1.0) {
        const cv::Matx33d zoom = cv::Matx33d::diag({unit_px, unit_px, 1.0});
        input.intrinsics1.K = zoom * given1.K;
        input.intrinsics2.K = zoom * given2.K;
    }
    for (const Intrinsics* camera : {&input.intrinsics1, &input.intrinsics2}) {
        if (!camera->assumption.empty()) {
            input.assumptions.push_back(camera->assumption);
        }
    }
    std::ostringstream sentence;
    sentence.precision(3);
    if (in_pixels && pair.resolution != 1.0) {
        sentence << "thresholds are in pixels of the image in which the keypoints were found, " << pair.resolution
                 << " of K's to one";
        input.assumptions.push_back(sentence.str());
    }
    if (!in_pixels) {
        sentence << "coordinates are no pixels, they extend over " << size
                 << ": thresholds are those of an image in which " << yardstick << " is 1000 pixels";
        input.assumptions.push_back(sentence.str());
        input.largest_threshold = kLargestThresholdShare * yardstick;
    }
    int image = 0;
    for (const auto& [camera, given] :
         {std::pair{&given1, &pair.camera1}, std::pair{&given2, &pair.camera2}}) {
        ++image;
        const double cx = camera->K(0, 2), cy = camera->K(1, 2);
        const bool inside = cx > 0.0 && cy > 0.0 && cx < given->size.width - 1.0 && cy < given->size.height - 1.0;
        if (!camera->guessed && given->size != cv::Size2d() && !inside) {
            input.assumptions.push_back("the principal point of K" + std::to_string(image) +
                                        " lies outside of image " + std::to_string(image) +
                                        ": is it the K of another size?");
        }
    }
    for (const std::string& doubt : {lens_doubt(given1, given_points1, 1), lens_doubt(given2, given_points2, 2)}) {
        if (!doubt.empty()) {
            input.assumptions.push_back(doubt);
        }
    }

    const Matches& matches = pair.matches;
    const std::size_t count = matches.index1.size();
    input.stretch1 = stretch_of_matches(input.intrinsics1, points1, matches.index1);
    input.stretch2 = stretch_of_matches(input.intrinsics2, points2, matches.index2);
    const std::vector<cv::Point2d> normalized1 = input.intrinsics1.normalize(points1);
    const std::vector<cv::Point2d> normalized2 = input.intrinsics2.normalize(points2);
    input.correspondences.assign(count, Correspondence::all(kNaN));
    input.valid.assign(count, 0);
    for (std::size_t i = 0; i < count; ++i) {
        if (matches.index1[i] < 0) {
            continue;
        }
        const cv::Point2d& x1 = normalized1[static_cast<std::size_t>(matches.index1[i])];
        const cv::Point2d& x2 = normalized2[static_cast<std::size_t>(matches.index2[i])];
        input.correspondences[i] = {x1.x, x1.y, x2.x, x2.y};
        input.valid[i] = std::abs(x1.x) < kMaxNormalized && std::abs(x1.y) < kMaxNormalized &&
                         std::abs(x2.x) < kMaxNormalized && std::abs(x2.y) < kMaxNormalized;
    }
    std::vector<double> distances = matches.distances;
    for (double& distance : distances) {
        distance = std::abs(distance) < kNoDistance ? distance : kNaN;
    }
    const Attributes known = merge_attributes(pair, distances);
    input.attributes = encode_attributes(known, count);
    input.order = order_of(known, distances, count);
    input.noise = relative_noise(known, input.valid);
    return input;
}

}  // namespace mgca::detail

namespace mgca {

Keypoints::Keypoints(const std::vector<cv::KeyPoint>& keypoints) {
    points.reserve(keypoints.size());
    sizes.reserve(keypoints.size());
    angles.reserve(keypoints.size());
    for (const cv::KeyPoint& keypoint : keypoints) {
        points.emplace_back(keypoint.pt);
        sizes.push_back(keypoint.size);
        angles.push_back(keypoint.angle);
    }
}

Keypoints::Keypoints(const std::vector<cv::Point2f>& pixels) : points(pixels.begin(), pixels.end()) {}

Keypoints::Keypoints(std::vector<cv::Point2d> pixels) : points(std::move(pixels)) {}

Matches::Matches(const std::vector<cv::DMatch>& matches) {
    for (const cv::DMatch& match : matches) {
        index1.push_back(match.queryIdx);
        index2.push_back(match.trainIdx);
        distances.push_back(match.distance);
    }
}

Matches::Matches(const std::vector<std::vector<cv::DMatch>>& matches) {
    for (const std::vector<cv::DMatch>& row : matches) {
        index1.push_back(row.empty() ? -1 : row[0].queryIdx);
        index2.push_back(row.empty() ? -1 : row[0].trainIdx);
        distances.push_back(row.empty() ? detail::kNaN : row[0].distance);
        second_distances.push_back(row.size() < 2 ? detail::kNaN : row[1].distance);
        if (!row.empty() && index1.back() == -1 && index2.back() == -1) {
            index1.back() = -2;  // -1 in both would mean that there is no match at all
        }
    }
}

Matches Matches::same_rows(std::size_t count) {
    Matches matches;
    for (std::size_t i = 0; i < count; ++i) {
        matches.index1.push_back(static_cast<int>(i));
    }
    matches.index2 = matches.index1;
    return matches;
}

}  // namespace mgca
