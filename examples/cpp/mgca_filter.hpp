// Tells right feature matches from wrong ones and estimates the relative pose, with the network in a model file of the
// Python package mgca_filter (`mgca_filter.model_path()` says where it lies):
//
//     const mgca::MgcaFilter filter("mgca_small.onnx");
//     const mgca::FilterResult result = filter(keypoints1, keypoints2, knn_matches, K1, K2);
//
// Header-only, C++17: copy the mgca_*.hpp files. Needs OpenCV 4.5.1 or newer, and ONNX Runtime 1.15 or newer or
// OpenCV 5 (see mgca_network.hpp).

#pragma once

#include "mgca_epipolar.hpp"
#include "mgca_model.hpp"
#include "mgca_network.hpp"
#include "mgca_pair.hpp"
#include "mgca_ranking.hpp"
#include "mgca_robust_fit.hpp"

#include <opencv2/core.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <filesystem>
#include <optional>
#include <random>
#include <stdexcept>
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
        const Pair pair = read_pair(keypoints1, keypoints2, matches, K1, K2);
        const std::vector<std::size_t> sent = select_network_input(pair);
        const NetworkOutput network = run_network(pair, sent);
        FilterResult result;
        result.logits = assemble_logits(pair, sent, network.logits);
        for (std::size_t i = 0; i < matches.size(); ++i) {
            result.scores.push_back(pair.valid[i] ? metadata_.probability(result.logits[i]) : 0.0F);
            result.network_mask.push_back(margin(result.logits[i]) > 0.0F);
        }
        fit(pair, sent, network.E, result);
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
    // Low enough for a probability of zero under any calibration.
    static constexpr float kInvalidLogit = -100.0F;
    // Matches that stay outside the network stay this far below the decision threshold, whatever the prior says.
    static constexpr double kRejectedMargin = 1e-3;

    /// How far a logit lies above the decision threshold.
    float margin(float logit) const { return logit - static_cast<float>(metadata_.decision_threshold); }

    /// The matches that enter the network: those that are, as far as is known, best of the list and of a low ratio, or
    /// all of them where these are too few; rows in ascending order.
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

    /// The network's answer for the matches that enter it; nothing where none does.
    NetworkOutput run_network(const Pair& pair, const std::vector<std::size_t>& sent) const {
        if (sent.empty()) {
            return {};
        }
        std::vector<float> correspondences, attributes;
        for (const std::size_t i : sent) {
            for (const double coordinate : pair.correspondences[i].val) {
                correspondences.push_back(static_cast<float>(coordinate));
            }
            attributes.insert(attributes.end(), pair.attributes[i].begin(), pair.attributes[i].end());
        }
        return network_.infer(std::move(correspondences), std::move(attributes));
    }

    /// Logits of all matches: the network's, the prior's below the decision threshold, or invalid.
    std::vector<float> assemble_logits(const Pair& pair, const std::vector<std::size_t>& sent,
                                       const std::vector<float>& answer) const {
        std::vector<float> logits(pair.valid.size(), kInvalidLogit);
        const auto ceiling = static_cast<float>(metadata_.decision_threshold - kRejectedMargin);
        for (std::size_t i = 0; i < logits.size(); ++i) {
            if (pair.valid[i]) {
                logits[i] = std::min(metadata_.prior.logit(pair.attributes[i]), ceiling);
            }
        }
        for (std::size_t k = 0; k < sent.size(); ++k) {
            logits[sent[k]] = std::isfinite(answer[k]) ? answer[k] : kInvalidLogit;
        }
        return logits;
    }

    /// The robust fit to what the network saw, then all matches are tested against it.
    void fit(const Pair& pair, const std::vector<std::size_t>& sent, const cv::Matx33d& network_essential,
             FilterResult& result) const {
        result.mask.assign(pair.valid.size(), 0);
        std::vector<ScoredMatch> scored;
        for (const std::size_t i : sent) {
            const Attributes& a = pair.attributes[i];
            const std::optional<double> ratio = a[5] > 0.0F ? std::optional<double>(a[0]) : std::nullopt;
            scored.push_back({pair.correspondences[i], result.scores[i], margin(result.logits[i]), ratio});
        }
        RobustFitOptions fit_options;
        fit_options.confidence = options_.confidence;
        fit_options.seed = options_.seed;
        const std::optional<Pose> pose =
            estimate_pose(RankedMatches(scored), network_essential, pair.focal_px, fit_options);
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
