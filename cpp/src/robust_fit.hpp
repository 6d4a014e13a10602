// The robust fit: what is proposed, refined, chosen, in this order; mgca_filter/fit/robust_fit.py.
//
// An easy pair ends before the network: a run or two on the list alone explain it, no other pose comes near, and its
// inliers hold it firmly. Otherwise unlike sources propose, on the scores of a quick network; where the first of
// them agree, the deeper network and the other sources are left out.

#pragma once

#include "choice.hpp"
#include "evidence.hpp"
#include "sources.hpp"

#include <mgca/filter.hpp>

#include <optional>
#include <string>
#include <vector>

namespace mgca::detail {

constexpr double kRefinePx = 1.0;
// The last refinement: a match counts half at three times the median distance of the inliers, between these limits; none
// counts beyond the reach, nor with so many times the inliers' median parallax: a wrong match of two images that hardly
// differ is far from still, and the farther it moved, the longer is its lever.
constexpr double kHalfWeightMedians = 3.0, kLeastHalfWeightPx = 1e-3, kHalfWeightPx = 0.5, kLastReachPx = 6.0;
constexpr double kLargestParallaxMedians = 25.0;

/// Model of a pair of images, on the normalised image planes.
struct TwoViewModel {
    cv::Matx33d M;  // x2^T M x1 = 0, unit norm: E, or with guessed intrinsics F in normalised coordinates
    cv::Matx33d E;  // essential matrix of unit Frobenius norm
    Pose pose;
    std::string origin;  // name of the source that proposed it
    std::string ended;   // "before the network", "first sources" or "all sources"
    std::optional<double> confidence;     // that the pose is within 10 degrees; nothing with guessed intrinsics
    std::optional<Judgement> judgement;   // the measurements behind the choice; likewise
    // The pose that is expected to lie nearer to the truth than the best explanation of the matches, which the others are;
    // nothing where that is no other answer.
    std::optional<Pose> expected = std::nullopt;

    /// What is answered where the matches hold a pose at all: the same with the expected one, where there is one.
    TwoViewModel answer() const;
};

/// Hypotheses of a pair as they come, refined, and the choice among them.
class Search {
public:
    Search(Evidence evidence, const Coefficients& coefficients, const Options& options);

    /// The model of a list that explains itself; nothing where the network is wanted.
    std::optional<TwoViewModel> before_network();

    /// The model where the scores of a quick network settle it; nothing where a deeper one is wanted.
    std::optional<TwoViewModel> after_first_look(Evidence evidence);

    /// The model by all sources, on scored matches; nothing where none is found.
    std::optional<TwoViewModel> with_network(Evidence evidence);

    /// What the fit saw last.
    const Evidence& evidence() const { return evidence_; }

private:
    struct Found {
        Pose pose;
        Family family;
        std::string origin;
    };

    void take(Evidence evidence);
    std::vector<cv::Matx33d> run(const Proposal& proposal) const;
    void propose(const Proposal& proposal);
    void propose_twins();
    void add(Found found);
    int near(const Pose& pose) const;
    double explained();
    bool settled();
    const Judgement& judge();
    std::optional<TwoViewModel> chosen(const char* ended);
    std::optional<TwoViewModel> refined(std::optional<TwoViewModel> model) const;
    std::optional<TwoViewModel> with_expected(std::optional<TwoViewModel> model) const;
    std::optional<TwoViewModel> fundamental();

    const Coefficients& coefficients_;
    const Options& options_;
    Evidence evidence_;
    Correspondences judged_, fitted_;
    std::vector<Found> poses_;
    std::optional<Pose> twins_of_;
    std::optional<Judgement> judgement_;
};

/// Scores of a pair that ended before the network, from the residuals of its matches to the model.
std::vector<float> scores_by_residuals(const PairInput& pair, const TwoViewModel& model,
                                       const Coefficients& coefficients);

/// The pose of an essential matrix that puts most of the matches near it in front of both cameras, however far they are.
std::optional<Pose> pose_from_essential(const cv::Matx33d& E, const Correspondences& matches, double focal_px);

}  // namespace mgca::detail
