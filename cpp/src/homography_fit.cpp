#include "homography_fit.hpp"

#include "degeneracy.hpp"
#include "evidence.hpp"
#include "least_squares.hpp"
#include "statistics.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <random>
#include <set>
#include <utility>

namespace mgca::detail {
namespace {

constexpr double kTiny = std::numeric_limits<double>::min();
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr int kFreedom = 8;
constexpr std::size_t kSampleSize = 4;
// A plane seen so obliquely that it shrinks by more than this in one direction holds no keypoints.
constexpr double kMaxStretch = 30.0;
// Matches that hypotheses are compared on, the best of the list.
constexpr std::size_t kMaxScored = 1000;
constexpr int kBatchSamples = 240;
constexpr std::size_t kSmallestHead = 12, kNeighbours = 8;
// Of every batch this many hypotheses are refined.
constexpr std::size_t kRefinedPerBatch = 2;
// A match that the scores reject still counts a little: they may be wrong about a small object.
constexpr double kLeastWeight = 0.2;
// A sample has two coordinates of noise a match: the first step of its refinement reaches this much further.
constexpr double kWideFactor = 3.0;
constexpr double kCauchySigmas = 1.25;
constexpr int kPolishRounds = 6;
// Matches farther than this many thresholds from a homography do not come near by polishing it.
constexpr double kReach = 12.0;
// Least squares.
constexpr double kInitialDamping = 1e-6, kMaxDamping = 1e3, kConvergedDecrease = 1e-9;
// Planes are seldom perfect: a match is off the plane beyond this multiple of the threshold. Once H is known, two matches
// off the plane determine the fundamental matrix.
constexpr double kOffPlaneFactor = 2.0, kParallaxFreedom = 2.0;
// Chance.
constexpr std::size_t kChanceRows = 400, kSmallestChanceHead = 16;
constexpr std::array<double, 3> kThresholdFactors{0.5, 1.0, 2.0};

using Sample = std::array<std::size_t, kSampleSize>;
using Matx88d = cv::Matx<double, 8, 8>;
using Vec8d = cv::Vec<double, 8>;
using Directions = cv::Matx<double, 9, 8>;

cv::Matx33d unit_norm(const cv::Matx33d& H) { return H * (1.0 / std::max(cv::norm(H), kTiny)); }

/// What a homography leaves of one match; its errors whitened by the Cholesky factor of J J^T.
struct Residual {
    double w, l11, l21, l22, r1, r2, squared;

    Residual(const Correspondence& match, const cv::Matx33d& H) {
        const double x1 = match[0], y1 = match[1], x2 = match[2], y2 = match[3];
        const double u = H(0, 0) * x1 + H(0, 1) * y1 + H(0, 2), v = H(1, 0) * x1 + H(1, 1) * y1 + H(1, 2);
        w = H(2, 0) * x1 + H(2, 1) * y1 + H(2, 2);
        const double j11 = x2 * H(2, 0) - H(0, 0), j12 = x2 * H(2, 1) - H(0, 1);
        const double j21 = y2 * H(2, 0) - H(1, 0), j22 = y2 * H(2, 1) - H(1, 1);
        const double a = std::max(j11 * j11 + j12 * j12 + w * w, kTiny), b = j11 * j21 + j12 * j22;
        const double c = j21 * j21 + j22 * j22 + w * w;
        l11 = std::sqrt(a);
        l21 = b / l11;
        l22 = std::sqrt(std::max(c - l21 * l21, kTiny));
        r1 = (x2 * w - u) / l11;
        r2 = (y2 * w - v - l21 * r1) / l22;
        squared = r1 * r1 + r2 * r2;
        if (!(w > 0.0) || !std::isfinite(squared)) {
            squared = kInfinity;
        }
    }
};

double truncated(const Correspondences& rows, const cv::Matx33d& H, double threshold,
                 const std::vector<double>& weights) {
    double cost = 0.0;
    for (std::size_t i = 0; i < rows.size(); ++i) {
        cost += weights[i] * std::min(Residual(rows[i], H).squared, threshold * threshold);
    }
    return cost;
}

/// Directions in which the entries of H may move: those of the Householder reflection orthogonal to it.
Directions directions(const cv::Matx33d& H) {
    const cv::Matx33d h = unit_norm(H);
    int axis = 0;
    for (int i = 1; i < 9; ++i) {
        axis = std::abs(h.val[i]) > std::abs(h.val[axis]) ? i : axis;
    }
    cv::Vec<double, 9> v(h.val);
    v[axis] += std::copysign(1.0, h.val[axis]);
    const double factor = 2.0 / v.dot(v);
    Directions result;
    int column = 0;
    for (int j = 0; j < 9; ++j) {
        if (j != axis) {
            for (int i = 0; i < 9; ++i) {
                result(i, column) = (i == j ? 1.0 : 0.0) - factor * v[i] * v[j];
            }
            ++column;
        }
    }
    return result;
}

/// Levenberg-Marquardt on the truncated Sampson error; the matches within are chosen anew in every round.
cv::Matx33d refine(const Correspondences& rows, cv::Matx33d H, double threshold, const std::vector<double>& weights,
                   int rounds) {
    double cost = truncated(rows, H, threshold, weights), damping = kInitialDamping;
    for (int round = 0; round < rounds; ++round) {
        const Directions along = directions(H);
        Matx88d hessian;
        Vec8d gradient;
        int near = 0;
        double cost_of_near = 0.0;
        for (std::size_t i = 0; i < rows.size(); ++i) {
            const Residual residual(rows[i], H);
            if (!(residual.squared < threshold * threshold)) {
                continue;
            }
            ++near;
            cost_of_near += weights[i] * residual.squared;
            const double x1 = rows[i][0], y1 = rows[i][1], x2 = rows[i][2], y2 = rows[i][3];
            cv::Matx<double, 1, 9> first(-x1, -y1, -1.0, 0.0, 0.0, 0.0, x2 * x1, x2 * y1, x2);
            first = first * (1.0 / residual.l11);
            cv::Matx<double, 1, 9> second(0.0, 0.0, 0.0, -x1, -y1, -1.0, y2 * x1, y2 * y1, y2);
            second = (second - residual.l21 * first) * (1.0 / residual.l22);
            const cv::Matx<double, 1, 8> j1 = first * along, j2 = second * along;
            hessian += weights[i] * (j1.t() * j1 + j2.t() * j2);
            for (int k = 0; k < 8; ++k) {
                gradient[k] += weights[i] * (j1(k) * residual.r1 + j2(k) * residual.r2);
            }
        }
        if (2 * near < kFreedom) {
            break;
        }
        const double smallest = 1e-12 * std::max(cv::trace(hessian), kTiny);
        const double previous = cost;
        for (; damping < kMaxDamping; damping *= 10.0) {
            Matx88d damped = hessian;
            for (int k = 0; k < 8; ++k) {
                damped(k, k) += damping * (hessian(k, k) + smallest);
            }
            const cv::Matx<double, 8, 1> step = damped.solve(cv::Matx<double, 8, 1>(-gradient), cv::DECOMP_LU);
            if (!promises<8>(hessian, gradient, step, kConvergedDecrease * cost_of_near)) {
                return H;
            }
            const cv::Matx<double, 9, 1> move = along * step;
            const cv::Matx33d candidate = unit_norm(H + cv::Matx33d(move.val));
            const double candidate_cost = truncated(rows, candidate, threshold, weights);
            if (candidate_cost < cost) {
                H = candidate;
                cost = candidate_cost;
                damping = std::max(0.1 * damping, 1e-12);
                break;
            }
        }
        if (cost >= (1.0 - kConvergedDecrease) * previous) {
            break;
        }
    }
    return H;
}

/// H of unit norm and of the sign that puts the matches that agree best on the positive side.
cv::Matx33d facing(const Correspondences& matches, const cv::Matx33d& given) {
    const cv::Matx33d H = unit_norm(given);
    double size = kTiny, votes = 0.0;
    for (const Correspondence& match : matches) {
        for (const double value : match.val) {
            size = std::isfinite(value) ? std::max(size, std::abs(value)) : size;
        }
    }
    for (const Correspondence& match : matches) {
        const cv::Vec3d mapped = H * ray1(match);
        const double u = mapped[0] / mapped[2] - match[2], v = mapped[1] / mapped[2] - match[3];
        const double vote = (mapped[2] > 0.0 ? 1.0 : mapped[2] < 0.0 ? -1.0 : 0.0) / (u * u + v * v + 1e-18 * size * size);
        votes += std::isfinite(vote) ? vote : 0.0;
    }
    return votes < 0.0 ? -1.0 * H : H;
}

/// How often each match's point in either image occurs, the more often of both.
std::vector<double> multiplicity(const Correspondences& rows) {
    std::map<std::pair<double, double>, double> first, second;
    for (const Correspondence& row : rows) {
        first[{row[0], row[1]}] += 1.0;
        second[{row[2], row[3]}] += 1.0;
    }
    std::vector<double> counts;
    for (const Correspondence& row : rows) {
        counts.push_back(std::max(first[{row[0], row[1]}], second[{row[2], row[3]}]));
    }
    return counts;
}

/// Hypotheses of one pair, and the best so far; points are centred and of unit size.
class PlaneSearch {
public:
    PlaneSearch(Correspondences rows, std::vector<double> weights, double threshold, const HomographyOptions& options)
        : rows_(std::move(rows)),
          weights_(std::move(weights)),
          ones_(rows_.size(), 1.0),
          threshold_(threshold),
          options_(options),
          random_(static_cast<std::uint64_t>(options.seed)) {}

    /// The best-supported map, polished.
    std::optional<cv::Matx33d> run() {
        if (rows_.size() == kSampleSize) {
            consider({{0, 1, 2, 3}});
        }
        if (rows_.size() > kSampleSize) {
            draw();
        }
        return best_ ? std::optional(polish(*best_)) : std::nullopt;
    }

    /// Least squares with Cauchy weights at the scale of the noise, among the inliers.
    cv::Matx33d polish(cv::Matx33d H) const {
        for (int round = 0; round < kPolishRounds; ++round) {
            std::vector<double> squared, near;
            for (const Correspondence& row : rows_) {
                squared.push_back(Residual(row, H).squared);
                if (squared.back() < threshold_ * threshold_) {
                    near.push_back(squared.back());
                }
            }
            if (2 * static_cast<int>(near.size()) <= kFreedom) {
                return H;
            }
            // The median of a Rayleigh distribution is 1.18 of its standard deviation.
            const double scale = std::max(kCauchySigmas * std::sqrt(median(near)) / 1.18, 1e-12);
            std::vector<double> weights;
            for (const double value : squared) {
                weights.push_back(1.0 / (1.0 + (value < threshold_ * threshold_ ? value : 0.0) / (scale * scale)));
            }
            const cv::Matx33d polished = refine(rows_, H, threshold_, weights, 3);
            if (!possible(polished)) {
                return H;
            }
            H = polished;
        }
        return H;
    }

private:
    void draw() {
        std::vector<std::size_t> heads{rows_.size()};
        while (heads.back() / 2 >= kSmallestHead) {
            heads.push_back(heads.back() / 2);
        }
        std::reverse(heads.begin(), heads.end());
        const std::vector<std::array<std::size_t, kNeighbours>> near = neighbours();
        double drawn = 0.0;
        for (int left = options_.max_iterations; left > 0;) {
            const int size = std::min(left, kBatchSamples), from_near = near.empty() ? 0 : size / 4;
            left -= size;
            const int number_of_heads = static_cast<int>(heads.size());
            const int per_head = (size - from_near + number_of_heads - 1) / number_of_heads;
            std::vector<Sample> samples;
            const auto add = [&](const Sample& sample) {
                if (std::set<std::size_t>(sample.begin(), sample.end()).size() == kSampleSize) {
                    samples.push_back(sample);
                }
            };
            for (const std::size_t head : heads) {
                for (int i = 0; i < per_head; ++i) {
                    add({below(head), below(head), below(head), below(head)});
                }
            }
            drawn += per_head;
            for (int i = 0; i < from_near; ++i) {
                const double part = std::uniform_real_distribution<double>(0.0, 1.0)(random_);
                const auto first = std::min(
                    static_cast<std::size_t>(static_cast<double>(rows_.size()) * part * part), rows_.size() - 1);
                const auto& others = near[first % near.size()];
                add({first, others[below(kNeighbours)], others[below(kNeighbours)], others[below(kNeighbours)]});
            }
            consider(samples);
            if (enough(heads, drawn)) {
                break;
            }
        }
    }

    std::size_t below(std::size_t limit) {
        return std::uniform_int_distribution<std::size_t>(0, limit - 1)(random_);
    }

    /// Rows nearest to each match in both images at once; none where there are hardly more.
    std::vector<std::array<std::size_t, kNeighbours>> neighbours() const {
        const std::size_t count = std::min(rows_.size(), kMaxScored);
        std::vector<std::array<std::size_t, kNeighbours>> near;
        if (count < 3 * kNeighbours) {
            return near;
        }
        std::vector<std::pair<double, std::size_t>> distances;
        for (std::size_t i = 0; i < count; ++i) {
            distances.clear();
            for (std::size_t j = 0; j < count; ++j) {
                const Correspondence d = rows_[i] - rows_[j];
                distances.emplace_back(i == j ? kInfinity : d.dot(d), j);
            }
            std::nth_element(distances.begin(), distances.begin() + kNeighbours, distances.end());
            std::array<std::size_t, kNeighbours>& row = near.emplace_back();
            std::transform(distances.begin(), distances.begin() + kNeighbours, row.begin(),
                           [](const auto& item) { return item.second; });
        }
        return near;
    }

    /// The map through a sample that a plane can give: the four points keep their orientation.
    std::optional<cv::Matx33d> solve(const Sample& sample) const {
        const auto column = [&](std::size_t k, bool second) {
            return second ? ray2(rows_[sample[k]]) : ray1(rows_[sample[k]]);
        };
        const auto triangle = [&](bool second) {
            const cv::Vec3d a = column(0, second), b = column(1, second), c = column(2, second);
            return cv::Matx33d(a[0], b[0], c[0], a[1], b[1], c[1], a[2], b[2], c[2]);
        };
        const cv::Matx33d triangle1 = triangle(false), triangle2 = triangle(true);
        const double det1 = cv::determinant(triangle1), det2 = cv::determinant(triangle2);
        if (!(std::abs(det1) > 1e-12) || !(std::abs(det2) > 1e-12) || !(options_.reflection || det1 * det2 > 0.0)) {
            return std::nullopt;
        }
        const cv::Matx33d inverse1 = triangle1.inv();
        const cv::Vec3d fourth1 = inverse1 * column(3, false), fourth2 = triangle2.inv() * column(3, true);
        cv::Vec3d ratios;
        for (int k = 0; k < 3; ++k) {
            ratios[k] = fourth2[k] / fourth1[k];
            if (!(ratios[k] > 1e-6) || !(ratios[k] < 1e6) || !(std::abs(fourth1[k]) > 1e-9)) {
                return std::nullopt;
            }
        }
        return unit_norm(triangle2 * cv::Matx33d::diag({ratios[0], ratios[1], ratios[2]}) * inverse1);
    }

    /// Refine the most promising hypotheses and keep the best of all.
    void consider(const std::vector<Sample>& samples) {
        std::vector<std::pair<double, cv::Matx33d>> hypotheses;
        for (const Sample& sample : samples) {
            if (const auto H = solve(sample)) {
                // Hypotheses are rough: what they are going to reach after refinement shows at a wider threshold.
                hypotheses.emplace_back(-screen(*H, kWideFactor * threshold_), *H);
            }
        }
        std::stable_sort(hypotheses.begin(), hypotheses.end(),
                         [](const auto& a, const auto& b) { return a.first < b.first; });
        hypotheses.resize(std::min(hypotheses.size(), kRefinedPerBatch));
        for (const auto& [merit, hypothesis] : hypotheses) {
            cv::Matx33d H = refine(rows_, hypothesis, kWideFactor * threshold_, ones_, 4);
            H = refine(rows_, H, threshold_, ones_, 8);
            const double support = support_of(H);
            if (support > best_support_ && possible(H)) {
                best_ = H;
                best_support_ = support;
            }
        }
    }

    /// Support under a first-order distance that takes the local scale for alike in all directions.
    double screen(const cv::Matx33d& H, double threshold) const {
        const double determinant = std::abs(cv::determinant(H));
        double sum = 0.0;
        for (std::size_t i = 0; i < std::min(rows_.size(), kMaxScored); ++i) {
            const cv::Vec3d mapped = H * ray1(rows_[i]);
            const double w = mapped[2];
            if (!(w > 0.0)) {
                continue;
            }
            const double u = mapped[0] / w - rows_[i][2], v = mapped[1] / w - rows_[i][3];
            const double squared = (u * u + v * v) / (threshold * threshold * (1.0 + determinant / (w * w * w)));
            sum += squared < 1.0 ? weights_[i] * (1.0 - squared) : 0.0;
        }
        return sum;
    }

    /// Summed weights of the matches that agree, less the further off they are (MSAC).
    double support_of(const cv::Matx33d& H) const {
        return std::accumulate(weights_.begin(), weights_.end(), 0.0) -
               truncated(rows_, H, threshold_, weights_) / (threshold_ * threshold_);
    }

    /// False where a map mirrors, collapses or stretches the inliers as no plane does.
    bool possible(const cv::Matx33d& H) const {
        int near = 0;
        double orientation = 1.0;
        for (const Correspondence& row : rows_) {
            const Residual residual(row, H);
            if (!(residual.squared < threshold_ * threshold_)) {
                continue;
            }
            ++near;
            const cv::Vec3d mapped = H * ray1(row);
            const double x = mapped[0] / mapped[2], y = mapped[1] / mapped[2];
            const cv::Matx22d frame((H(0, 0) - x * H(2, 0)) / residual.w, (H(0, 1) - x * H(2, 1)) / residual.w,
                                    (H(1, 0) - y * H(2, 0)) / residual.w, (H(1, 1) - y * H(2, 1)) / residual.w);
            // Singular values of a 2x2 matrix from its norm and determinant.
            if (near == 1 && options_.reflection) {
                orientation = std::copysign(1.0, cv::determinant(frame));
            }
            const double determinant = orientation * cv::determinant(frame), norm = frame.ddot(frame);
            const double root = std::sqrt(std::max(norm * norm - 4.0 * determinant * determinant, 0.0));
            const double largest = std::sqrt(0.5 * (norm + root)), smallest = determinant / largest;
            if (!(determinant > 0.0) || !(largest < kMaxStretch) || !(smallest > 1.0 / kMaxStretch)) {
                return false;
            }
        }
        return 2 * near >= kFreedom;
    }

    /// True where some head of the list has given enough samples for its share of inliers.
    bool enough(const std::vector<std::size_t>& heads, double drawn) const {
        if (!best_) {
            return false;
        }
        std::size_t position = 0, near = 0;
        for (const std::size_t head : heads) {
            for (; position < head; ++position) {
                near += Residual(rows_[position], *best_).squared < threshold_ * threshold_ ? 1 : 0;
            }
            const double share = static_cast<double>(near) / static_cast<double>(head);
            const double right = std::min(std::pow(share, static_cast<double>(kSampleSize)), 1.0 - 1e-12);
            if (drawn * std::log1p(-right) < std::log(1.0 - options_.confidence)) {
                return true;
            }
        }
        return false;
    }

    Correspondences rows_;
    std::vector<double> weights_, ones_;
    double threshold_;
    HomographyOptions options_;
    std::mt19937_64 random_;
    std::optional<cv::Matx33d> best_;
    double best_support_ = 0.0;
};

/// Share of the wrong pairings of the same points that agree with a homography, at each multiple of the threshold.
std::array<double, kThresholdFactors.size()> plane_chance_rates(const Correspondences& matches, const cv::Matx33d& H,
                                                                double threshold) {
    const std::size_t step = std::max<std::size_t>(1, (matches.size() + kChanceRows - 1) / kChanceRows);
    const cv::Matx33d inverse = H.inv(cv::DECOMP_SVD);
    std::vector<cv::Point2d> first, second, mapped, back;
    for (std::size_t i = 0; i < matches.size(); i += step) {
        const cv::Vec3d to = H * ray1(matches[i]), from = inverse * ray2(matches[i]);
        first.emplace_back(matches[i][0], matches[i][1]);
        second.emplace_back(matches[i][2], matches[i][3]);
        mapped.emplace_back(to[0] / to[2], to[1] / to[2]);
        back.emplace_back(from[0] / from[2], from[1] / from[2]);
    }
    const std::size_t count = first.size();
    std::array<std::size_t, kThresholdFactors.size()> agreeing{};
    for (std::size_t i = 0; i < count; ++i) {
        for (std::size_t j = 0; j < count; ++j) {
            if (i == j) {
                continue;
            }
            const cv::Point2d f = mapped[i] - second[j], b = first[i] - back[j];
            const double forward = f.dot(f), backward = b.dot(b);
            for (std::size_t k = 0; k < agreeing.size(); ++k) {
                const double limit = kThresholdFactors[k] * threshold;
                agreeing[k] += forward * backward < limit * limit * (forward + backward) ? 1 : 0;
            }
        }
    }
    double largest = 0.0;
    for (const int image : {0, 2}) {
        cv::Vec2d low(kInfinity, kInfinity), high(-kInfinity, -kInfinity);
        for (const Correspondence& match : matches) {
            for (int k = 0; k < 2; ++k) {
                low[k] = std::min(low[k], match[image + k]);
                high[k] = std::max(high[k], match[image + k]);
            }
        }
        largest = std::max(largest, (high[0] - low[0]) * (high[1] - low[1]));
    }
    const auto n = static_cast<double>(count);
    std::array<double, kThresholdFactors.size()> rates{};
    for (std::size_t k = 0; k < rates.size(); ++k) {
        const double limit = kThresholdFactors[k] * threshold, disc = CV_PI * limit * limit;
        const double expected = std::min(2.0 * disc / std::max(largest, disc), 0.5);
        rates[k] = (static_cast<double>(agreeing[k]) + 1.0) / (n * (n - 1.0) + 1.0 / expected);
    }
    return rates;
}

/// Inliers of which no two lie in the same cell of either image: one blob is found several times.
Mask independent(const Correspondences& matches, const std::vector<double>& distances, double threshold,
                 double radius) {
    Mask chosen(matches.size(), 0);
    std::array<std::set<std::pair<double, double>>, 2> taken;
    for (std::size_t i = 0; i < matches.size(); ++i) {
        if (!(distances[i] < threshold)) {
            continue;
        }
        const auto cell = [&](int k) {
            return std::pair{std::floor(matches[i][k] / radius), std::floor(matches[i][k + 1] / radius)};
        };
        if (taken[0].count(cell(0)) == 0 && taken[1].count(cell(2)) == 0) {
            taken[0].insert(cell(0));
            taken[1].insert(cell(2));
            chosen[i] = 1;
        }
    }
    return chosen;
}

double log_binomial(double n, double k) { return std::lgamma(n + 1.0) - std::lgamma(k + 1.0) - std::lgamma(n - k + 1.0); }

double plane_log10_nfa(std::size_t count, std::size_t inliers, double rate, double freedom = kFreedom / 2) {
    const auto n = static_cast<double>(count), k = static_cast<double>(inliers);
    if (k <= freedom) {
        return kInfinity;
    }
    const double tests = std::log(n) + log_binomial(n, k) + log_binomial(k, freedom);
    return (tests + (k - freedom) * std::log(std::min(rate, 1.0))) / std::log(10.0);
}

/// Points of both images centred and of unit size: x_unit ~ to_unit x.
struct UnitFrame {
    Correspondence centre;
    double unit = 1.0;

    cv::Matx33d to_unit(int image) const {
        return {1.0, 0.0, -centre[2 * image], 0.0, 1.0, -centre[2 * image + 1], 0.0, 0.0, unit};
    }
};

/// Nothing where they have no extent.
std::optional<UnitFrame> unit_frame(const Correspondences& rows) {
    UnitFrame frame;
    for (const Correspondence& row : rows) {
        frame.centre += row;
    }
    frame.centre *= 1.0 / static_cast<double>(rows.size());
    double sum = 0.0;
    for (const Correspondence& row : rows) {
        sum += (row - frame.centre).dot(row - frame.centre);
    }
    frame.unit = std::sqrt(sum / (4.0 * static_cast<double>(rows.size())));
    return std::isfinite(frame.unit) && frame.unit > 0.0 ? std::optional(frame) : std::nullopt;
}

/// OpenCV's scale, H(2, 2) = 1, where the origin is not mapped to infinity.
cv::Matx33d scaled(const cv::Matx33d& given) {
    const cv::Matx33d H = unit_norm(given);
    return std::abs(H(2, 2)) > 1e-12 ? H * (1.0 / H(2, 2)) : H;
}

}  // namespace

std::vector<double> sampson_distances_to_homography(const Correspondences& matches, const cv::Matx33d& H) {
    std::vector<double> distances(matches.size(), kInfinity);
    if (!std::all_of(H.val, H.val + 9, [](double value) { return std::isfinite(value); })) {
        return distances;
    }
    const cv::Matx33d faced = facing(matches, H);
    std::transform(matches.begin(), matches.end(), distances.begin(),
                   [&](const Correspondence& match) { return std::sqrt(Residual(match, faced).squared); });
    return distances;
}

std::optional<cv::Matx33d> estimate_homography(const Correspondences& matches, const HomographyOptions& options,
                                               const std::vector<double>& weights) {
    std::vector<std::size_t> order(matches.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    if (!weights.empty()) {
        std::stable_sort(order.begin(), order.end(),
                         [&](std::size_t a, std::size_t b) { return weights[a] > weights[b]; });
    }
    if (order.size() < kSampleSize) {
        return std::nullopt;
    }
    Correspondences rows;
    for (const std::size_t i : order) {
        rows.push_back(matches[i]);
    }
    const auto frame = unit_frame(rows);
    if (!frame) {
        return std::nullopt;
    }
    std::vector<double> weight = multiplicity(rows);
    for (std::size_t k = 0; k < rows.size(); ++k) {
        const double given = weights.empty() ? 1.0 : std::clamp(weights[order[k]], 0.0, 1.0);
        weight[k] = std::max(given, kLeastWeight) / weight[k];
        rows[k] = (rows[k] - frame->centre) / frame->unit;
    }
    const auto found = PlaneSearch(std::move(rows), std::move(weight), options.threshold / frame->unit, options).run();
    return found ? std::optional(scaled(frame->to_unit(1).inv() * *found * frame->to_unit(0))) : std::nullopt;
}

cv::Matx33d polish_homography(const Correspondences& matches, const cv::Matx33d& H, const HomographyOptions& options) {
    Rows distinct = distinct_rows(matches);
    std::sort(distinct.begin(), distinct.end());
    Correspondences rows;
    for (const std::size_t i : distinct) {
        rows.push_back(matches[i]);
    }
    const std::vector<double> distances = sampson_distances_to_homography(rows, H);
    std::size_t kept = 0;
    for (std::size_t i = 0; i < rows.size(); ++i) {
        if (distances[i] < kReach * options.threshold) {
            rows[kept++] = rows[i];
        }
    }
    rows.resize(kept);
    const auto frame = rows.size() < kSampleSize ? std::nullopt : unit_frame(rows);
    if (!frame || !std::all_of(H.val, H.val + 9, [](double value) { return std::isfinite(value); })) {
        return H;
    }
    const cv::Matx33d start = unit_norm(frame->to_unit(1) * facing(rows, H) * frame->to_unit(0).inv());
    for (Correspondence& row : rows) {
        row = (row - frame->centre) / frame->unit;
    }
    std::vector<double> ones(rows.size(), 1.0);
    const PlaneSearch search(std::move(rows), std::move(ones), options.threshold / frame->unit, options);
    return scaled(frame->to_unit(1).inv() * search.polish(start) * frame->to_unit(0));
}

double parallax_false_alarms(const Correspondences& matches, const cv::Matx33d& H, const cv::Matx33d& F,
                             double threshold) {
    const std::vector<double> to_plane = sampson_distances_to_homography(matches, H);
    Correspondences off;
    for (std::size_t i = 0; i < matches.size(); ++i) {
        if (to_plane[i] > kOffPlaneFactor * threshold) {
            off.push_back(matches[i]);
        }
    }
    if (static_cast<double>(off.size()) <= kParallaxFreedom) {
        return kInfinity;
    }
    const Mask witnesses = independent(off, sampson_distances(off, F), threshold, 2.0 * threshold);
    const auto count = static_cast<std::size_t>(std::count(witnesses.begin(), witnesses.end(), 1));
    return plane_log10_nfa(off.size(), count, chance_rate(off, F, threshold), kParallaxFreedom);
}

PlaneSupport plane_support(const Correspondences& matches, const cv::Matx33d& H, double threshold) {
    const std::vector<double> distances = sampson_distances_to_homography(matches, H);
    std::vector<std::size_t> heads{matches.size()};
    while (heads.back() / 2 >= kSmallestChanceHead) {
        heads.push_back(heads.back() / 2);
    }
    PlaneSupport support{0, kInfinity};
    const auto rates = plane_chance_rates(matches, H, threshold);
    for (std::size_t k = 0; k < rates.size(); ++k) {
        const double factor = kThresholdFactors[k], rate = rates[k];
        const Mask witnesses = independent(matches, distances, factor * threshold, 2.0 * threshold);
        if (factor == 1.0) {
            support.count = static_cast<int>(std::count(witnesses.begin(), witnesses.end(), 1));
        }
        for (const std::size_t head : heads) {
            const auto end = witnesses.begin() + static_cast<std::ptrdiff_t>(head);
            const auto inliers = static_cast<std::size_t>(std::count(witnesses.begin(), end, 1));
            support.log10_nfa = std::min(support.log10_nfa, plane_log10_nfa(head, inliers, rate));
        }
    }
    support.log10_nfa += std::log10(static_cast<double>(heads.size() * kThresholdFactors.size()));
    return support;
}

double homography_false_alarms(const Correspondences& matches, const cv::Matx33d& H, double threshold) {
    return plane_support(matches, H, threshold).log10_nfa;
}

}  // namespace mgca::detail
