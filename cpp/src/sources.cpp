#include "sources.hpp"

#include "homography.hpp"

#include <algorithm>
#include <cmath>

namespace mgca::detail {
namespace {

// A rough run on the list sees no more matches than this: what it proposes is refined and judged on all.
constexpr std::size_t kRoughMatches = 600;

/// The list in its own order; for a rough run the most promising of a long one, or, where nothing tells them, some of all
/// parts of it.
Correspondences listed(const Evidence& evidence, bool rough) {
    Correspondences rows = evidence.by_list_order();
    if (!rough || rows.size() <= kRoughMatches) {
        return rows;
    }
    const std::size_t count = rows.size();
    if (std::none_of(evidence.order.begin(), evidence.order.end(), [](double o) { return std::isfinite(o); })) {
        for (std::size_t i = 0; i < kRoughMatches; ++i) {
            rows[i] = rows[i * count / kRoughMatches];
        }
    }
    rows.resize(kRoughMatches);
    return rows;
}

std::vector<cv::Matx33d> estimate(const Correspondences& rows, const Evidence& evidence,
                                  const EstimatorOptions& options) {
    if (rows.size() < kMinMatches) {
        return {};
    }
    const auto M = fit_epipolar(rows, evidence.focal_px, options, evidence.calibrated);
    return M ? std::vector<cv::Matx33d>{*M} : std::vector<cv::Matx33d>{};
}

}  // namespace

std::vector<cv::Matx33d> propose(const Proposal& proposal, const Evidence& evidence, const EstimatorOptions& options) {
    switch (proposal.source) {
        case Source::network: {
            const auto E = evidence.network_essential();
            return E && evidence.calibrated ? std::vector<cv::Matx33d>{*E} : std::vector<cv::Matx33d>{};
        }
        case Source::listed: return estimate(listed(evidence, options.rough), evidence, options);
        case Source::accepted: return estimate(evidence.take(evidence.accepted()), evidence, options);
        case Source::above: return estimate(evidence.take(evidence.above(proposal.margin)), evidence, options);
    }
    return {};
}

std::vector<cv::Matx33d> propose_plane(const Evidence& evidence, const Pose& pose, int seed) {
    const double threshold = 1.0 / evidence.focal_px;
    const cv::Matx33d E = essential_from_pose(pose);
    Correspondences near;
    for (const Correspondence& match : evidence.take(evidence.accepted())) {
        if (sampson_distance(match, E) < threshold) {
            near.push_back(match);
        }
    }
    const auto H = fit_homography(near, kHomographyThresholdFactor * threshold, seed);
    if (!H) {
        return {};
    }
    // Of the four poses two and two differ in the sign of t alone, which E does not know.
    const std::vector<Pose> poses = poses_from_homography(*H);
    std::vector<cv::Matx33d> essentials;
    for (std::size_t i = 0; i < poses.size(); i += 2) {
        essentials.push_back(essential_from_pose(poses[i]));
    }
    return essentials;
}

}  // namespace mgca::detail
