#include "homography.hpp"

#include "opencv_geometry.hpp"

#include <cmath>
#include <limits>

namespace mgca::detail {

std::vector<Pose> poses_from_homography(const cv::Matx33d& H) {
    std::vector<cv::Mat> rotations, translations, normals;
    try {
        cv::decomposeHomographyMat(H, cv::Matx33d::eye(), rotations, translations, normals);
    } catch (const cv::Exception&) {
        return {};
    }
    std::vector<Pose> poses;
    for (std::size_t i = 0; i < rotations.size(); ++i) {
        const double length = cv::norm(translations[i]);
        if (cv::checkRange(rotations[i]) && std::isfinite(length) && length > 1e-9) {
            const cv::Matx31d t(translations[i]);
            poses.push_back({cv::Matx33d(rotations[i]), cv::Vec3d(t(0), t(1), t(2)) * (1.0 / length)});
        }
    }
    return poses;
}

std::vector<double> homography_distances(const Correspondences& matches, const cv::Matx33d& H) {
    const cv::Matx33d back = H.inv(cv::DECOMP_SVD);
    std::vector<double> distances;
    distances.reserve(matches.size());
    for (const Correspondence& match : matches) {
        const cv::Vec3d p2 = H * ray1(match), p1 = back * ray2(match);
        const double u2 = p2[0] / p2[2] - match[2], v2 = p2[1] / p2[2] - match[3];
        const double u1 = p1[0] / p1[2] - match[0], v1 = p1[1] / p1[2] - match[1];
        const double distance = 0.5 * std::sqrt(u2 * u2 + v2 * v2 + u1 * u1 + v1 * v1);
        distances.push_back(std::isfinite(distance) ? distance : std::numeric_limits<double>::infinity());
    }
    return distances;
}

}  // namespace mgca::detail
