#include "estimators.hpp"

#include "opencv_geometry.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <random>
#include <utility>
#include <vector>

namespace mgca::detail {
namespace {

constexpr double kHomographyConfidence = 0.999;
constexpr int kHomographyIterations = 1000;

// A rough run: rounds of local optimisation, and the most that is asked of the probability of a clean sample.
constexpr int kRoughLoIterations = 3;
constexpr double kRoughConfidence = 0.95;

// For F OpenCV's USAC_MAGSAC optimises on larger samples.
constexpr int kMagsacFundamentalLoSample = 50;

enum class Preset { prosac, magsac, homography };

/// OpenCV's presets USAC_PROSAC and USAC_MAGSAC, which cannot be seeded themselves: with these settings UsacParams gives
/// their very bits at seed 0.
cv::UsacParams usac_params(Preset preset, double threshold, double confidence, int max_iterations, int seed) {
    cv::UsacParams params;
    const bool magsac = preset == Preset::magsac;
    params.sampler = preset == Preset::prosac ? cv::SAMPLING_PROSAC : cv::SAMPLING_UNIFORM;
    params.score = magsac ? cv::SCORE_METHOD_MAGSAC : cv::SCORE_METHOD_MSAC;
    params.loMethod = magsac ? cv::LOCAL_OPTIM_SIGMA : cv::LOCAL_OPTIM_INNER_LO;
    params.loIterations = magsac ? 10 : 20;
    params.loSampleSize = magsac ? 14 : 12;
    params.threshold = threshold;
    params.confidence = confidence;
    params.maxIterations = max_iterations;
    params.randomGeneratorState = seed;
    return params;
}

/// Points of one image, multiplied by `unit`.
std::vector<cv::Point2d> points(const Correspondences& rows, int image, double unit) {
    std::vector<cv::Point2d> result;
    result.reserve(rows.size());
    for (const Correspondence& match : rows) {
        result.emplace_back(match[2 * image - 2] * unit, match[2 * image - 1] * unit);
    }
    return result;
}

/// The best of the models that an estimator stacks, for points multiplied by `unit`; of unit Frobenius norm, for `rows`.
std::optional<cv::Matx33d> best_of_stack(const cv::Mat& stacked, double unit, const Correspondences& rows,
                                         double threshold) {
    std::vector<cv::Matx33d> models;
    if (stacked.cols != 3 || stacked.rows % 3 != 0) {
        return std::nullopt;
    }
    const cv::Matx33d scale = cv::Matx33d::diag({unit, unit, 1.0});
    for (int row = 0; row + 3 <= stacked.rows; row += 3) {
        const cv::Matx33d model(stacked.rowRange(row, row + 3));
        if (usable(model)) {
            models.push_back(scale * model * scale);
        }
    }
    if (models.empty()) {
        return std::nullopt;
    }
    const auto cost = [&](const cv::Matx33d& model) {
        double sum = 0.0;
        for (const Correspondence& match : rows) {
            const double distance = std::min(sampson_distance(match, model), threshold);
            sum += distance * distance;
        }
        return sum;
    };
    cv::Matx33d best = models.front();
    if (models.size() > 1) {
        double least = cost(best);
        for (std::size_t i = 1; i < models.size(); ++i) {
            const double other = cost(models[i]);
            if (other < least) {
                best = models[i];
                least = other;
            }
        }
    }
    return best * (1.0 / cv::norm(best));
}

}  // namespace

std::optional<cv::Matx33d> fit_epipolar(const Correspondences& rows, double focal_px, const EstimatorOptions& options,
                                        bool calibrated) {
    Correspondences shuffled;
    const bool ransac = options.method == Estimator::ransac;
    if (ransac && options.seed != 0) {
        // The classic RANSAC has a generator of its own with a fixed seed: shuffling is what changes its draws.
        shuffled = rows;
        std::shuffle(shuffled.begin(), shuffled.end(), std::mt19937_64(static_cast<std::uint64_t>(options.seed)));
    }
    const Correspondences& ordered = shuffled.empty() ? rows : shuffled;
    // For F OpenCV holds some constants in pixels (MAGSAC fails on the normalised plane); E it normalises itself.
    const double unit = calibrated ? 1.0 : focal_px;
    const double threshold = options.threshold_px / focal_px * unit;
    const std::vector<cv::Point2d> x1 = points(ordered, 1, unit), x2 = points(ordered, 2, unit);
    const cv::Matx33d identity = cv::Matx33d::eye();
    cv::Mat stacked;
    try {
        if (ransac && calibrated) {
            stacked = cv::findEssentialMat(x1, x2, identity, cv::RANSAC, options.confidence, threshold,
                                           options.max_iterations);
        } else if (ransac) {
            stacked = cv::findFundamentalMat(x1, x2, cv::FM_RANSAC, threshold, options.confidence,
                                             options.max_iterations);
        } else {
            const Preset preset = options.method == Estimator::prosac ? Preset::prosac : Preset::magsac;
            cv::UsacParams params =
                usac_params(preset, threshold, options.confidence, options.max_iterations, options.seed);
            if (options.rough) {
                params.loIterations = kRoughLoIterations;
                params.confidence = std::min(options.confidence, kRoughConfidence);
            }
            if (!calibrated && preset == Preset::magsac) {
                params.loSampleSize = kMagsacFundamentalLoSample;
            }
            stacked = calibrated ? cv::findEssentialMat(x1, x2, identity, identity, cv::noArray(), cv::noArray(),
                                                        cv::noArray(), params)
                                 : cv::findFundamentalMat(x1, x2, cv::noArray(), params);
        }
    } catch (const cv::Exception&) {
        return std::nullopt;
    }
    return best_of_stack(stacked, unit, ordered, options.threshold_px / focal_px);
}

std::optional<cv::Matx33d> fit_homography(const Correspondences& rows, double threshold, int seed,
                                          bool ordered) {
    if (rows.size() < 4) {
        return std::nullopt;
    }
    cv::Mat scaled;
    try {
        // OpenCV holds some constants in pixels: in units of the threshold, any coordinates look like pixels to it.
        const double unit = 1.0 / threshold;
        scaled = cv::findHomography(
            points(rows, 1, unit), points(rows, 2, unit), cv::noArray(),
            usac_params(ordered ? Preset::prosac : Preset::homography, 1.0, kHomographyConfidence, kHomographyIterations, seed));
    } catch (const cv::Exception&) {
        return std::nullopt;
    }
    if (scaled.size() != cv::Size(3, 3) || !cv::checkRange(scaled)) {
        return std::nullopt;
    }
    const cv::Matx33d S = cv::Matx33d::diag({1.0 / threshold, 1.0 / threshold, 1.0});
    const cv::Matx33d H = S.inv() * cv::Matx33d(scaled) * S;
    if (std::abs(H(2, 2)) < 1e-12) {
        return std::nullopt;
    }
    return H * (1.0 / H(2, 2));
}

}  // namespace mgca::detail
