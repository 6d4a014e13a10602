#include "degeneracy.hpp"

#include "evidence.hpp"
#include "homography.hpp"
#include "statistics.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace mgca::detail {
namespace {

constexpr double kExplainedShare = 0.95, kMaxAccidentalShare = 0.3;
constexpr std::size_t kChanceRows = 400;
constexpr int kTrimRounds = 5;
constexpr int kModelFreedom = 5;
// A match this many sigmas off counts no more than that.
constexpr double kGricCut = 5.0, kPriceOfDimension = 2.2;

Mask within(const std::vector<double>& distances, double limit) {
    Mask near(distances.size());
    std::transform(distances.begin(), distances.end(), near.begin(),
                   [limit](double distance) { return distance <= limit ? 1 : 0; });
    return near;
}

double log_binomial(int n, int k) { return std::lgamma(n + 1.0) - std::lgamma(k + 1.0) - std::lgamma(n - k + 1.0); }

}  // namespace

Support measure_support(const Correspondences& matches, const cv::Matx33d& M, double threshold) {
    Correspondences rows;
    for (const std::size_t row : distinct_rows(matches)) {
        rows.push_back(matches[row]);
    }
    Support support;
    for (const Correspondence& match : rows) {
        support.count += sampson_distance(match, M) < threshold ? 1 : 0;
    }
    const double rate = chance_rate(rows, M, threshold);
    const int count = static_cast<int>(rows.size());
    const double wrong = (count - support.count) / std::max(1.0 - rate, rate);
    support.log10_nfa = log10_false_alarms(count, support.count, rate);
    support.chance_count = std::min(static_cast<double>(support.count), wrong * rate);
    return support;
}

double chance_rate(const Correspondences& matches, const cv::Matx33d& M, double threshold) {
    const std::size_t step = std::max<std::size_t>(1, (matches.size() + kChanceRows - 1) / kChanceRows);
    std::vector<cv::Vec3d> x2, line2;
    std::vector<double> norm1, norm2;  // squared, of the line normals: they depend on one point each
    for (std::size_t i = 0; i < matches.size(); i += step) {
        const cv::Vec3d line = M * ray1(matches[i]), other = M.t() * ray2(matches[i]);
        x2.push_back(ray2(matches[i]));
        line2.push_back(line);
        norm2.push_back(line[0] * line[0] + line[1] * line[1]);
        norm1.push_back(other[0] * other[0] + other[1] * other[1]);
    }
    const std::size_t count = x2.size();
    std::size_t agreeing = 0;
    for (std::size_t i = 0; i < count; ++i) {
        for (std::size_t j = 0; j < count; ++j) {
            const double error = x2[i][0] * line2[j][0] + x2[i][1] * line2[j][1] + line2[j][2];
            agreeing += i != j && error * error < threshold * threshold * (norm2[j] + norm1[i]) ? 1 : 0;
        }
    }
    // Laplace's rule: a rate that was never observed is not zero.
    const auto n = static_cast<double>(count);
    return (static_cast<double>(agreeing) + 1.0) / (n * (n - 1.0) + 2.0);
}

double log10_false_alarms(int count, int inliers, double rate) {
    if (inliers <= kModelFreedom) {
        return std::numeric_limits<double>::infinity();
    }
    const double tests = std::log(count) + log_binomial(count, inliers) + log_binomial(inliers, kModelFreedom);
    return (tests + (inliers - kModelFreedom) * std::log(std::min(rate, 1.0))) / std::log(10.0);
}

std::vector<double> line_distances(const std::vector<cv::Point2d>& points, double threshold) {
    Mask near(points.size(), 1);
    std::vector<double> distances(points.size(), 0.0);
    for (int round = 0; round < kTrimRounds && !points.empty(); ++round) {
        cv::Point2d centre;
        double count = 0.0;
        for (std::size_t i = 0; i < points.size(); ++i) {
            if (near[i] != 0) {
                centre += points[i];
                count += 1.0;
            }
        }
        centre *= 1.0 / count;
        cv::Matx22d scatter;
        for (std::size_t i = 0; i < points.size(); ++i) {
            if (near[i] != 0) {
                const cv::Point2d d = points[i] - centre;
                scatter(0, 0) += d.x * d.x;
                scatter(0, 1) += d.x * d.y;
                scatter(1, 1) += d.y * d.y;
            }
        }
        scatter(1, 0) = scatter(0, 1);
        cv::Matx21d values;
        cv::Matx22d vectors;  // in rows, the largest first
        cv::eigen(scatter, values, vectors);
        const cv::Point2d across(vectors(1, 0), vectors(1, 1));
        std::transform(points.begin(), points.end(), distances.begin(),
                       [&](const cv::Point2d& point) { return std::abs((point - centre).dot(across)); });
        near = within(distances, std::max(threshold, median(distances)));
    }
    return distances;
}

cv::Matx33d fit_rotation(const Correspondences& matches, double threshold) {
    cv::Matx33d R = cv::Matx33d::eye();
    Mask near(matches.size(), 1);
    for (int round = 0; round < kTrimRounds && !matches.empty(); ++round) {
        cv::Matx33d covariance;
        for (std::size_t i = 0; i < matches.size(); ++i) {
            if (near[i] != 0) {
                covariance += cv::normalize(ray2(matches[i])) * cv::normalize(ray1(matches[i])).t();
            }
        }
        cv::Matx33d U, Vt;
        cv::Matx31d values;
        cv::SVD::compute(covariance, values, U, Vt);
        R = U * cv::Matx33d::diag({1.0, 1.0, cv::determinant(U * Vt)}) * Vt;
        const std::vector<double> distances = homography_distances(matches, R);
        near = within(distances, std::max(threshold, median(distances)));
    }
    return R;
}

bool prefers_rotation(const std::vector<double>& rotation_px, const std::vector<double>& epipolar_px) {
    std::vector<double> turned, epipolar;
    for (std::size_t i = 0; i < rotation_px.size(); ++i) {
        if (rotation_px[i] < 2.0 * kExplainedThresholdFactor) {
            turned.push_back(rotation_px[i]);
            epipolar.push_back(epipolar_px[i]);
        }
    }
    if (turned.empty()) {
        return false;
    }
    const auto count = static_cast<double>(turned.size());
    // E has taken as many residuals as it has degrees of freedom.
    const double left = std::max(count - kModelFreedom, 1.0);
    const double noise = std::max(kToSigma * median(epipolar) * std::sqrt(count / left), kLeastNoisePx);
    // Half the root of four squared components: of noise alone their expectation is twice that of a Sampson distance.
    const auto cost = [noise](const std::vector<double>& distances) {
        double sum = 0.0;
        for (const double distance : distances) {
            sum += std::min(distance * distance / (noise * noise), kGricCut * kGricCut);
        }
        return sum;
    };
    // Steeper than log 4 a match: E was chosen among many, and the noise is that of the residuals that it leaves.
    const double price = kPriceOfDimension * count + 2.0 * std::log(4.0 * count);
    return cost(turned) - cost(epipolar) < price;
}

bool explains(const std::vector<double>& distances, double threshold, const Support& support, int freedom) {
    const double count = std::min(static_cast<double>(distances.size()), static_cast<double>(support.count));
    // Two standard deviations of a Poisson count: accidents do not come in their exact mean number.
    const double accidents = support.chance_count + 2.0 * std::sqrt(support.chance_count) + freedom;
    const double wanted = kExplainedShare * (count - std::min(accidents, kMaxAccidentalShare * count));
    const auto explained = std::count_if(distances.begin(), distances.end(), [&](double distance) {
        return distance < kExplainedThresholdFactor * threshold;
    });
    return !distances.empty() && static_cast<double>(explained) >= wanted;
}

}  // namespace mgca::detail
