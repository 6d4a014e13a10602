#include "mirror.hpp"

#include "homography_fit.hpp"

#include <algorithm>
#include <random>
#include <utility>

namespace mgca::detail {
namespace {

// This share of the matches that agree with a pose lies on the mirrored plane; in front of a facade others join them,
// which mistake one window of a row for another.
constexpr double kLeastShare = 0.25;
constexpr double kMirrorPx = 2.0;
constexpr int kTriangles = 300;
// Share of triangles that turn: of a mirrored plane with wrong matches about it; of a mirrored scene with depth, of
// whose pose nothing else tells.
constexpr double kTurnedPlane = 0.5, kTurnedScene = 0.7;

int count_near(const std::vector<double>& distances, double threshold) {
    return static_cast<int>(
        std::count_if(distances.begin(), distances.end(), [=](double distance) { return distance < threshold; }));
}

}  // namespace

Verdict judge_mirror(const PairInput& pair, const Evidence& evidence, Verdict verdict, double mask_threshold_px,
                     const Options& options) {
    Correspondences matches;
    for (const std::size_t position : evidence.accepted()) {
        if (!verdict.R || verdict.mask[evidence.rows[position]] != 0) {
            matches.push_back(pair.pixels(evidence.correspondences[position]));
        }
    }
    if (verdict.status == Status::pure_rotation || matches.size() < kFirmMatches) {
        return verdict;
    }
    const double turned = share_of_turned_triangles(matches);
    if (turned < kTurnedPlane) {
        return verdict;
    }
    HomographyOptions plane;
    plane.threshold = kMirrorPx;
    plane.confidence = options.confidence;
    plane.seed = options.seed;
    plane.reflection = true;
    const auto H = estimate_homography(matches, plane, {});
    const int support = H ? count_near(sampson_distances_to_homography(matches, *H), kMirrorPx) : 0;
    const bool mirrors = H && support > kLeastShare * static_cast<double>(matches.size()) && cv::determinant(*H) < 0.0;
    const double log10_nfa = mirrors ? homography_false_alarms(matches, *H, kMirrorPx) : 0.0;
    if (!mirrors || log10_nfa > kMeaningfulLog10Nfa) {
        if (verdict.t && turned >= kTurnedScene) {
            verdict.status = Status::low_support;
            verdict.E.reset();
            verdict.R.reset();
            verdict.t.reset();
            verdict.mirrored = true;
        }
        return verdict;
    }
    Correspondences valid;
    Rows rows;
    for (std::size_t i = 0; i < pair.valid.size(); ++i) {
        if (pair.valid[i] != 0) {
            rows.push_back(i);
            valid.push_back(pair.pixels(pair.correspondences[i]));
        }
    }
    const std::vector<double> distances = sampson_distances_to_homography(valid, *H);
    Verdict mirrored;
    mirrored.mask.assign(pair.valid.size(), 0);
    for (std::size_t k = 0; k < rows.size(); ++k) {
        mirrored.mask[rows[k]] = distances[k] < mask_threshold_px ? 1 : 0;
    }
    mirrored.status = options.geometry == Geometry::homography ? Status::ok : Status::planar;
    mirrored.H = pair.homography_in_units(*H);
    mirrored.support = support;
    mirrored.log10_false_alarms = log10_nfa;
    mirrored.mirrored = true;
    return mirrored;
}

double share_of_turned_triangles(const Correspondences& matches) {
    std::mt19937_64 random(0);
    std::uniform_int_distribution<std::size_t> any(0, matches.size() - 1);
    int turned = 0, kept = 0;
    for (int i = 0; i < kTriangles; ++i) {
        const Correspondence& first = matches[any(random)];
        const Correspondence a = matches[any(random)] - first, b = matches[any(random)] - first;
        const double agreement = (a[0] * b[1] - a[1] * b[0]) * (a[2] * b[3] - a[3] * b[2]);
        turned += agreement < 0.0 ? 1 : 0;
        kept += agreement > 0.0 ? 1 : 0;
    }
    return static_cast<double>(turned) / std::max(turned + kept, 1);
}

}  // namespace mgca::detail
