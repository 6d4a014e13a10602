// Tells right feature matches from wrong ones and estimates the relative pose, with the network in a model file of the
// Python package mgca_filter (`mgca_filter.model_path()` says where it lies):
//
//     const mgca::MgcaFilter filter("mgca_small.onnx");
//     const mgca::FilterResult result = filter(keypoints1, keypoints2, knn_matches, K1, K2);
//
// Header-only, C++17: copy the three mgca_*.hpp files. Needs OpenCV 4.5.1 or newer, and ONNX Runtime 1.15 or newer or
// OpenCV 5 (see mgca_model.hpp).

#pragma once

#include "mgca_model.hpp"
#include "mgca_two_view.hpp"

#include <opencv2/core.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <filesystem>
#include <iterator>
#include <limits>
#include <numeric>
#include <optional>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace mgca {

/// Settings of the filter.
struct FilterOptions {
    double threshold_px = 1.0;  ///< Inlier threshold of the final mask: Sampson distance, pixels; the fit has its own.
    double confidence = 0.999;  ///< Of the robust fit, between 0 and 1.
    int seed = 0;               ///< Of every random choice, not negative.
};

/// Relative pose of camera 2 to camera 1: X2 = R X1 + t, x2^T E x1 = 0 with points multiplied by the inverse of K.
struct TwoViewGeometry {
    cv::Matx33d E;  ///< Essential matrix of unit Frobenius norm.
    cv::Matx33d R;  ///< Rotation.
    cv::Vec3d t;    ///< Translation of unit length.
};

/// Answer for M matches; every vector has one entry per match, in the order of the input.
struct FilterResult {
    std::vector<float> scores;                 ///< Calibrated probabilities that the matches are right.
    std::vector<float> logits;                 ///< What the scores were calibrated from.
    std::vector<unsigned char> network_mask;   ///< 1 where the logit is above the model's decision threshold.
    std::vector<unsigned char> mask;           ///< 1 where the match agrees with the geometry; all 0 without one.
    std::optional<TwoViewGeometry> geometry;   ///< Nothing where no pose was found.
};

/// The filter; keeps its model open. Safe to use from several threads.
class MgcaFilter {
public:
    /// One row of cv::DescriptorMatcher::knnMatch per match: the first candidate is the match, the second gives the
    /// ratio of distances.
    using KnnMatches = std::vector<std::vector<cv::DMatch>>;

    /// Throws ModelError where the model file is missing, damaged, or of another contract, and std::invalid_argument
    /// for an option out of range.
    explicit MgcaFilter(const std::filesystem::path& model_file, const FilterOptions& options = {})
        : metadata_(read_metadata(model_file)), network_(model_file), options_(options) {
        if (!(options.threshold_px > 0.0) || !(options.confidence > 0.0 && options.confidence < 1.0) ||
            options.seed < 0) {
            throw std::invalid_argument("options: expected threshold_px > 0, confidence in (0, 1) and seed >= 0");
        }
    }

    const ModelMetadata& metadata() const { return metadata_; }

    /// Filter the matches of one pair of images.
    ///
    /// @param keypoints1, keypoints2 pixels of the images without distortion, the centre of the top-left pixel is
    ///     (0, 0). Size and angle (degrees, -1 = unknown) are used where they are known. Points that are not finite
    ///     are set aside: their matches get a score of 0.
    /// @param matches knnMatch rows; an empty row gets a score of 0.
    /// @param K1, K2 intrinsics, pixels: [[fx, s, cx], [0, fy, cy], [0, 0, 1]].
    ///
    /// Throws std::invalid_argument for an index out of range or a matrix that is no K, and the runtime's exception
    /// where the network fails (see Network::infer). Data never raises: too few matches give a result without geometry.
    FilterResult operator()(const std::vector<cv::KeyPoint>& keypoints1, const std::vector<cv::KeyPoint>& keypoints2,
                            const KnnMatches& matches, const cv::Matx33d& K1, const cv::Matx33d& K2) const {
        const Pair pair = prepare(keypoints1, keypoints2, matches, K1, K2);
        const std::vector<std::size_t> sent = select_network_input(pair);
        FilterResult result;
        result.logits = compute_logits(pair, sent);
        for (std::size_t i = 0; i < matches.size(); ++i) {
            result.scores.push_back(pair.valid[i] ? metadata_.probability(result.logits[i]) : 0.0F);
            result.network_mask.push_back(result.logits[i] > metadata_.decision_threshold);
        }
        fit(pair, sent, result);
        return result;
    }

    /// The same for cv::DescriptorMatcher::match, which leaves the ratio of distances unknown.
    FilterResult operator()(const std::vector<cv::KeyPoint>& keypoints1, const std::vector<cv::KeyPoint>& keypoints2,
                            const std::vector<cv::DMatch>& matches, const cv::Matx33d& K1,
                            const cv::Matx33d& K2) const {
        KnnMatches rows;
        rows.reserve(matches.size());
        for (const cv::DMatch& match : matches) {
            rows.push_back({match});
        }
        return (*this)(keypoints1, keypoints2, rows, K1, K2);
    }

private:
    // More matches than this do not enter the network: the best by ratio go.
    static constexpr std::size_t kMaxNetworkMatches = 8000;
    // With fewer accepted matches than this, the best-scored ones fill up what the robust fit sees.
    static constexpr std::size_t kMinFitMatches = 32;
    // Low enough for a probability of zero under any calibration.
    static constexpr float kInvalidLogit = -100.0F;
    // Matches that stay outside the network stay this far below the decision threshold, whatever the prior says.
    static constexpr double kRejectedMargin = 1e-3;
    // Normalised coordinates beyond this (89.9 degrees off the axis) come from broken input, not from a lens.
    static constexpr double kMaxNormalized = 1e3;
    static constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();

    /// Matches of one pair; `valid` where the coordinates are usable.
    struct Pair {
        std::vector<Correspondence> correspondences;
        std::vector<Attributes> attributes;
        std::vector<bool> valid;
        double focal_px = 0.0;
    };

    /// Step 1: pixels and what the matcher knew, to normalised coordinates and encoded attributes.
    static Pair prepare(const std::vector<cv::KeyPoint>& keypoints1, const std::vector<cv::KeyPoint>& keypoints2,
                        const KnnMatches& matches, const cv::Matx33d& K1, const cv::Matx33d& K2) {
        check_intrinsics(K1, "K1");
        check_intrinsics(K2, "K2");
        check_indices(matches, keypoints1.size(), keypoints2.size());
        const std::optional<std::vector<bool>> best = best_of_list(matches, keypoints2.size());
        Pair pair;
        pair.focal_px = (K1(0, 0) + K1(1, 1) + K2(0, 0) + K2(1, 1)) / 4.0;
        for (std::size_t i = 0; i < matches.size(); ++i) {
            Attributes attributes{};
            Correspondence correspondence = Correspondence::all(kUnknown);
            if (!matches[i].empty()) {
                const cv::KeyPoint& first = keypoints1[static_cast<std::size_t>(matches[i][0].queryIdx)];
                const cv::KeyPoint& second = keypoints2[static_cast<std::size_t>(matches[i][0].trainIdx)];
                const cv::Vec2d x1 = normalize(first.pt, K1), x2 = normalize(second.pt, K2);
                correspondence = {x1[0], x1[1], x2[0], x2[1]};
                encode_shape(first, second, attributes);
            }
            encode_ratio(matches[i], attributes);
            if (best) {
                attributes[1] = (*best)[i] ? 1.0F : 0.0F;
                attributes[6] = 1.0F;
            }
            pair.correspondences.push_back(correspondence);
            pair.attributes.push_back(attributes);
            pair.valid.push_back(std::all_of(correspondence.val, correspondence.val + 4,
                                             [](double x) { return std::abs(x) < kMaxNormalized; }));
        }
        return pair;
    }

    static void check_intrinsics(const cv::Matx33d& K, const char* name) {
        const bool finite = std::all_of(K.val, K.val + 9, [](double value) { return std::isfinite(value); });
        if (!finite || K(0, 0) <= 0.0 || K(1, 1) <= 0.0 || K(1, 0) != 0.0 || K(2, 0) != 0.0 || K(2, 1) != 0.0 ||
            K(2, 2) != 1.0) {
            throw std::invalid_argument(std::string(name) +
                                        ": expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0");
        }
    }

    static void check_indices(const KnnMatches& matches, std::size_t count1, std::size_t count2) {
        const auto outside = [](int index, std::size_t count) {
            return index < 0 || static_cast<std::size_t>(index) >= count;
        };
        for (std::size_t i = 0; i < matches.size(); ++i) {
            if (!matches[i].empty() &&
                (outside(matches[i][0].queryIdx, count1) || outside(matches[i][0].trainIdx, count2))) {
                throw std::invalid_argument("matches[" + std::to_string(i) + "]: index out of range for " +
                                            std::to_string(count1) + " and " + std::to_string(count2) + " keypoints");
            }
        }
    }

    static cv::Vec2d normalize(const cv::Point2f& point, const cv::Matx33d& K) {
        const double y = (point.y - K(1, 2)) / K(1, 1);
        return {(point.x - K(0, 2) - K(0, 1) * y) / K(0, 0), y};
    }

    /// Distance of a candidate; unknown where there is none, or where it was never set (OpenCV's largest float).
    static double distance(const std::vector<cv::DMatch>& row, std::size_t candidate) {
        const double value = candidate < row.size() ? row[candidate].distance : kUnknown;
        return std::abs(value) < 1e38 ? value : kUnknown;
    }

    static void encode_ratio(const std::vector<cv::DMatch>& row, Attributes& attributes) {
        const double nearest = distance(row, 0), second = distance(row, 1);
        if (std::isnan(nearest) || std::isnan(second)) {
            return;
        }
        // Two candidates at distance zero cannot be told apart.
        attributes[0] = static_cast<float>(second <= 0.0 ? 1.0 : std::clamp(nearest / second, 0.0, 1.0));
        attributes[5] = 1.0F;
    }

    static void encode_shape(const cv::KeyPoint& first, const cv::KeyPoint& second, Attributes& attributes) {
        for (const cv::KeyPoint* keypoint : {&first, &second}) {
            if (!(keypoint->size > 0.0F && keypoint->angle >= 0.0F) || !std::isfinite(keypoint->size) ||
                !std::isfinite(keypoint->angle)) {
                return;
            }
        }
        const double turn = (static_cast<double>(second.angle) - first.angle) * CV_PI / 180.0;
        attributes[2] = static_cast<float>(std::log2(static_cast<double>(second.size) / first.size));
        attributes[3] = static_cast<float>(std::cos(turn));
        attributes[4] = static_cast<float>(std::sin(turn));
        attributes[7] = 1.0F;
    }

    /// True where no other match reaches the same keypoint of image 2 at a smaller distance; nothing where the
    /// distances cannot say: some are missing, or several matches all have the same.
    static std::optional<std::vector<bool>> best_of_list(const KnnMatches& matches, std::size_t count2) {
        std::vector<double> smallest(count2, std::numeric_limits<double>::infinity());
        std::vector<double> distances;
        for (const std::vector<cv::DMatch>& row : matches) {
            if (row.empty()) {
                continue;
            }
            distances.push_back(distance(row, 0));
            if (std::isnan(distances.back())) {
                return std::nullopt;
            }
            double& reached = smallest[static_cast<std::size_t>(row[0].trainIdx)];
            reached = std::min(reached, distances.back());
        }
        const auto [low, high] = std::minmax_element(distances.begin(), distances.end());
        if (distances.empty() || (distances.size() > 1 && *low == *high)) {
            return std::nullopt;
        }
        std::vector<bool> best;
        for (const std::vector<cv::DMatch>& row : matches) {
            best.push_back(!row.empty() && distance(row, 0) <= smallest[static_cast<std::size_t>(row[0].trainIdx)]);
        }
        return best;
    }

    /// Step 2: the matches that enter the network: those that are, as far as is known, best of the list and of a low
    /// ratio, or all of them where these are too few; rows in ascending order.
    std::vector<std::size_t> select_network_input(const Pair& pair) const {
        std::vector<std::size_t> all, candidates;
        for (std::size_t i = 0; i < pair.valid.size(); ++i) {
            if (!pair.valid[i]) {
                continue;
            }
            const Attributes& a = pair.attributes[i];
            const bool known = a[5] > 0.0F && a[6] > 0.0F;
            const bool hopeless = known && (a[0] >= static_cast<float>(metadata_.candidate_max_ratio) || a[1] == 0.0F);
            all.push_back(i);
            if (!hopeless) {
                candidates.push_back(i);
            }
        }
        if (candidates.size() < static_cast<std::size_t>(std::max(metadata_.candidate_min_count, 0))) {
            candidates = std::move(all);
        }
        if (candidates.size() > kMaxNetworkMatches) {
            std::shuffle(candidates.begin(), candidates.end(), std::mt19937(static_cast<unsigned>(options_.seed)));
            const auto ratio = [&](std::size_t i) {
                return pair.attributes[i][5] > 0.0F ? pair.attributes[i][0] : 1.0F;
            };
            std::stable_sort(candidates.begin(), candidates.end(),
                             [&](std::size_t i, std::size_t j) { return ratio(i) < ratio(j); });
            candidates.resize(kMaxNetworkMatches);
            std::sort(candidates.begin(), candidates.end());
        }
        return candidates;
    }

    /// Step 3: logits of all matches: the network's, the prior's below the decision threshold, or invalid.
    std::vector<float> compute_logits(const Pair& pair, const std::vector<std::size_t>& sent) const {
        std::vector<float> logits(pair.valid.size(), kInvalidLogit);
        const auto ceiling = static_cast<float>(metadata_.decision_threshold - kRejectedMargin);
        for (std::size_t i = 0; i < logits.size(); ++i) {
            if (pair.valid[i]) {
                logits[i] = std::min(metadata_.prior.logit(pair.attributes[i]), ceiling);
            }
        }
        if (sent.empty()) {
            return logits;
        }
        std::vector<float> correspondences, attributes;
        for (const std::size_t i : sent) {
            for (const double coordinate : pair.correspondences[i].val) {
                correspondences.push_back(static_cast<float>(coordinate));
            }
            attributes.insert(attributes.end(), pair.attributes[i].begin(), pair.attributes[i].end());
        }
        const std::vector<float> answer = network_.infer(std::move(correspondences), std::move(attributes));
        for (std::size_t k = 0; k < sent.size(); ++k) {
            logits[sent[k]] = std::isfinite(answer[k]) ? answer[k] : kInvalidLogit;
        }
        return logits;
    }

    /// Step 4: the matches that the robust fit sees, the most promising first: the accepted ones, or the best-scored
    /// ones where those are few. Saturated scores order badly among themselves; the ratio tells them apart.
    std::vector<std::size_t> select_for_fit(const Pair& pair, const std::vector<std::size_t>& sent,
                                            const FilterResult& result) const {
        std::vector<std::size_t> order;
        std::copy_if(sent.begin(), sent.end(), std::back_inserter(order),
                     [&](std::size_t i) { return result.network_mask[i] != 0; });
        const auto sort_descending = [&](auto&& value) {
            std::stable_sort(order.begin(), order.end(),
                             [&](std::size_t i, std::size_t j) { return value(i) > value(j); });
        };
        if (order.size() < kMinFitMatches) {
            order = sent;
            sort_descending([&](std::size_t i) { return result.logits[i]; });
            order.resize(std::min(order.size(), kMinFitMatches));
        }
        sort_descending([&](std::size_t i) {
            const Attributes& a = pair.attributes[i];
            return result.scores[i] * (a[5] > 0.0F ? 1.2 - a[0] : 1.0);
        });
        return order;
    }

    /// Step 5: the robust fit, then all matches are tested against it.
    void fit(const Pair& pair, const std::vector<std::size_t>& sent, FilterResult& result) const {
        result.mask.assign(pair.valid.size(), 0);
        std::vector<Correspondence> ordered;
        for (const std::size_t i : select_for_fit(pair, sent, result)) {
            ordered.push_back(pair.correspondences[i]);
        }
        RobustFitOptions fit_options;
        fit_options.confidence = options_.confidence;
        fit_options.seed = options_.seed;
        const std::optional<Pose> pose = estimate_pose(ordered, pair.focal_px, fit_options);
        if (!pose) {
            return;
        }
        const cv::Matx33d E = essential_from_pose(*pose);
        for (std::size_t i = 0; i < result.mask.size(); ++i) {
            result.mask[i] = pair.valid[i] &&
                             sampson_distance(pair.correspondences[i], E) * pair.focal_px < options_.threshold_px;
        }
        result.geometry = TwoViewGeometry{E, pose->R, pose->t};
    }

    ModelMetadata metadata_;
    Network network_;
    FilterOptions options_;
};

}  // namespace mgca
