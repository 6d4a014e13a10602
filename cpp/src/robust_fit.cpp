#include "robust_fit.hpp"

#include "bayes_estimate.hpp"
#include "pose_refinement.hpp"
#include "statistics.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

namespace mgca::detail {
namespace {

// A hypothesis this close to a refined one would end there; one this close to the best is no twin of it.
constexpr double kSameDeg = 0.3, kTwinDeg = 2.0;
// The early end is given up where a run explains less than the first share of the list; above the second, one will do.
constexpr double kPromising = 0.3, kCertain = 0.7;
// A twin that explains less than this share of what the best pose does within so many pixels, before it is refined, is
// no alternative.
constexpr double kTwinShare = 0.5, kTwinPx = 2.0;
// Of fewer matches than this the best explanation is best by luck. From this angle on the pose that is expected nearest to
// the truth is another answer; else the refined one is finer.
constexpr std::size_t kFewMatches = 200;
constexpr double kExpectedDeg = 2.0;

constexpr Proposal kList{"list", Family::list_uniform, Source::listed, Estimator::magsac, 0.5, 300, 0, 0.0, true};
constexpr Proposal kListCoarse{
    "list, 1 px", Family::list_uniform, Source::listed, Estimator::magsac, 1.0, 300, 4, 0.0, true};
constexpr Proposal kNetwork{"network", Family::network, Source::network};
constexpr Proposal kAccepted{"accepted", Family::accepted, Source::accepted, Estimator::magsac, 0.5, 300, 1, 0.0, true};
constexpr Proposal kScoreOrder{"score order", Family::score_order, Source::above, Estimator::prosac, 1.0, 1000, 0, -1.0};
constexpr Proposal kListOrder{"list order", Family::list_ordered, Source::listed, Estimator::prosac, 0.5, 1000, 0};
constexpr Proposal kScoreOrderAll{
    "score order, all", Family::score_order, Source::above, Estimator::prosac, 0.5, 1000, 3, -2.0};

// What needs no network; then what uses it; then what is still tried where those do not settle it.
constexpr std::array kBeforeNetwork{kList, kListCoarse};
constexpr std::array kFirst{kNetwork, kAccepted, kScoreOrder};
constexpr std::array kSecond{kListCoarse, kListOrder, kScoreOrderAll};

/// One robust estimator alone, for those who ask for it.
std::optional<Proposal> alone(Method method) {
    switch (method) {
        case Method::prosac:
            return Proposal{"prosac", Family::score_order, Source::above, Estimator::prosac, 0.5, 5000, 0, -1.0};
        case Method::magsac:
            return Proposal{"magsac", Family::accepted, Source::accepted, Estimator::magsac, 0.5, 5000, 0};
        case Method::ransac:
            return Proposal{"ransac", Family::accepted, Source::accepted, Estimator::ransac, 0.5, 5000, 0};
        default: return std::nullopt;
    }
}

/// The poses that the network E allows, or none.
std::vector<Pose> poses_of_network(const Evidence& evidence) {
    const auto E = evidence.network_essential();
    if (!E) {
        return {};
    }
    const auto poses = decompose_essential(*E);
    return {poses.begin(), poses.end()};
}

Correspondences select(const Correspondences& matches, const Mask& mask) {
    Correspondences selected;
    for (std::size_t i = 0; i < matches.size(); ++i) {
        if (mask[i] != 0) {
            selected.push_back(matches[i]);
        }
    }
    return selected;
}

std::vector<double> select(const std::vector<double>& values, const Mask& mask) {
    std::vector<double> selected;
    for (std::size_t i = 0; i < values.size(); ++i) {
        if (mask[i] != 0) {
            selected.push_back(values[i]);
        }
    }
    return selected;
}

}  // namespace

TwoViewModel TwoViewModel::answer() const {
    TwoViewModel answer = *this;
    if (expected) {
        answer.pose = *expected;
        answer.M = answer.E = essential_from_pose(*expected);
        answer.origin = "expected best";
        answer.expected.reset();
    }
    return answer;
}

Search::Search(Evidence evidence, const Coefficients& coefficients, const Options& options)
    : coefficients_(coefficients), options_(options) {
    take(std::move(evidence));
}

std::optional<TwoViewModel> Search::before_network() {
    if (evidence_.size() < kMinMatches || !evidence_.calibrated) {
        return std::nullopt;
    }
    for (const Proposal& proposal : kBeforeNetwork) {
        propose(proposal);
        const double share = explained();
        if (share < kPromising) {
            return std::nullopt;
        }
        if (share > kCertain) {
            break;
        }
    }
    propose_twins();
    std::optional<TwoViewModel> model = chosen("before the network");
    if (!model || !explains_list(*model->judgement, coefficients_)) {
        return std::nullopt;
    }
    return refined(std::move(model));
}

std::optional<TwoViewModel> Search::after_first_look(Evidence evidence) {
    if (evidence.size() < kMinMatches || !evidence.calibrated || options_.method != Method::automatic) {
        return std::nullopt;
    }
    take(std::move(evidence));
    for (const Proposal& proposal : kFirst) {
        propose(proposal);
    }
    if (!settled()) {
        return std::nullopt;
    }
    propose_twins();
    return refined(chosen("first sources"));
}

std::optional<TwoViewModel> Search::with_network(Evidence evidence) {
    take(std::move(evidence));
    if (evidence_.size() < kMinMatches) {
        return std::nullopt;
    }
    if (!evidence_.calibrated) {
        return fundamental();
    }
    if (const auto one = alone(options_.method)) {
        poses_.clear();
        propose(*one);
        return refined(chosen("all sources"));
    }
    for (const Proposal& proposal : kFirst) {
        propose(proposal);
    }
    const char* ended = "first sources";
    if (!settled()) {
        ended = "all sources";
        if (!poses_.empty()) {
            propose_twins();
        }
        for (const Proposal& proposal : kSecond) {
            const bool known = std::any_of(poses_.begin(), poses_.end(),
                                           [&](const Found& pose) { return pose.origin == proposal.name; });
            if (!known) {
                propose(proposal);
            }
        }
    }
    if (!poses_.empty()) {
        propose_twins();
    }
    return with_expected(refined(chosen(ended)));
}

void Search::take(Evidence evidence) {
    evidence_ = std::move(evidence);
    judgement_.reset();
    judged_ = select(evidence_.correspondences, evidence_.once);
    Mask fitted = evidence_.listed;
    std::size_t count = 0;
    for (std::size_t i = 0; i < fitted.size(); ++i) {
        const bool accepted = evidence_.network && evidence_.network->scores[i] > kAcceptedScore;
        fitted[i] = (fitted[i] != 0 || accepted) && evidence_.once[i] != 0;
        count += fitted[i];
    }
    fitted_ = count >= kMinMatches ? select(evidence_.correspondences, fitted) : judged_;
}

std::vector<cv::Matx33d> Search::run(const Proposal& proposal) const {
    EstimatorOptions options;
    options.method = proposal.method;
    options.threshold_px = proposal.threshold_px;
    options.confidence = options_.confidence;
    options.max_iterations = std::min(proposal.iterations, options_.max_iterations);
    options.seed = static_cast<int>((static_cast<long long>(options_.seed) + proposal.number) % (1LL << 31));
    options.rough = proposal.rough && evidence_.calibrated;
    return detail::propose(proposal, evidence_, options);
}

void Search::propose(const Proposal& proposal) {
    for (const cv::Matx33d& E : run(proposal)) {
        if (const auto pose = pose_from_essential(E, fitted_, evidence_.focal_px)) {
            add({*pose, proposal.family, proposal.name});
        }
    }
}

void Search::propose_twins() {
    // Under a dominant plane every pose has a twin that explains it as well: let both be judged.
    const Pose best = poses_[judge().chosen].pose;
    if (twins_of_ && pose_angle_deg(*twins_of_, best) < kTwinDeg) {
        return;
    }
    twins_of_ = best;
    for (const cv::Matx33d& E : propose_plane(evidence_, best, options_.seed)) {
        const auto twin = pose_from_essential(E, fitted_, evidence_.focal_px);
        const bool is_new = twin && std::all_of(poses_.begin(), poses_.end(), [&](const Found& other) {
                                return pose_angle_deg(*twin, other.pose) > kTwinDeg;
                            });
        if (is_new && near(*twin) > kTwinShare * near(best)) {
            add({*twin, Family::plane, "plane"});
        }
    }
}

void Search::add(Found found) {
    const auto known = std::find_if(poses_.begin(), poses_.end(), [&](const Found& other) {
        return pose_angle_deg(found.pose, other.pose) < kSameDeg;
    });
    found.pose = known != poses_.end() ? known->pose
                                       : refine_pose(fitted_, found.pose, kRefinePx / evidence_.focal_px);
    poses_.push_back(std::move(found));
    judgement_.reset();
}

int Search::near(const Pose& pose) const {
    return static_cast<int>(measure_residuals(fitted_, pose, evidence_.focal_px).explained(kTwinPx));
}

double Search::explained() { return poses_.empty() ? 0.0 : std::exp(judge()[Feature::log_share]); }

bool Search::settled() {
    if (poses_.empty()) {
        return false;
    }
    const double families = coefficients_.settled[0], certain = coefficients_.settled[1],
                 hopeless = coefficients_.settled[2];
    const Judgement& judgement = judge();
    const double confidence = detail::confidence(judgement, coefficients_);
    const bool agreed = judgement[Feature::other_families_2_deg] >= families && confidence > certain;
    return agreed || confidence < hopeless;
}

const Judgement& Search::judge() {
    if (!judgement_) {
        std::vector<Hypothesis> hypotheses;
        for (const Found& pose : poses_) {
            hypotheses.push_back({pose.pose, pose.family});
        }
        std::optional<std::vector<double>> scores;
        if (evidence_.network) {
            scores = select(evidence_.network->scores, evidence_.once);
        }
        judgement_ = judge_hypotheses(judged_, scores, hypotheses, evidence_.focal_px, poses_of_network(evidence_),
                                      coefficients_);
    }
    return *judgement_;
}

std::optional<TwoViewModel> Search::chosen(const char* ended) {
    if (poses_.empty()) {
        return std::nullopt;
    }
    const Judgement& judgement = judge();
    const Found& pose = poses_[judgement.chosen];
    const cv::Matx33d E = essential_from_pose(pose.pose);
    const double confidence =
        evidence_.network ? detail::confidence(judgement, coefficients_) : early_confidence(judgement, coefficients_);
    return TwoViewModel{E, E, pose.pose, pose.origin, ended, confidence, judgement};
}

std::optional<TwoViewModel> Search::refined(std::optional<TwoViewModel> model) const {
    if (!model) {
        return std::nullopt;
    }
    // A match counts by its noise and by the probability that it is right: its score, more where most of the list agrees
    // with the pose, for then the list knows better.
    std::vector<double> weights(judged_.size(), 1.0);
    if (evidence_.network) {
        weights = select(evidence_.network->scores, evidence_.once);
        const double share = std::exp((*model->judgement)[Feature::log_share]);
        const double right = std::pow(share, 3), wrong = std::pow(1.0 - share, 3);
        for (double& weight : weights) {
            weight = 1.0 - (1.0 - weight) * (1.0 - right / (right + wrong));
        }
    }
    const Residuals residuals = measure_residuals(judged_, model->pose, evidence_.focal_px);
    std::vector<double> moved, distances, moved_inliers;
    for (std::size_t i = 0; i < judged_.size(); ++i) {
        moved.push_back(parallax(judged_[i], model->pose.R));
        if (residuals.explains(i)) {
            distances.push_back(residuals.distance_px[i]);
            moved_inliers.push_back(moved[i]);
        }
    }
    if (distances.empty()) {
        return model;
    }
    const double half_px = std::clamp(kHalfWeightMedians * median(distances), kLeastHalfWeightPx, kHalfWeightPx);
    const double farthest = kLargestParallaxMedians * median(moved_inliers);
    const std::vector<double> noise = select(evidence_.noise, evidence_.once);
    Correspondences still;
    std::vector<double> scale, counted;
    for (std::size_t i = 0; i < judged_.size(); ++i) {
        if (moved[i] <= farthest) {
            still.push_back(judged_[i]);
            scale.push_back(half_px * noise[i] / evidence_.focal_px);
            counted.push_back(weights[i]);
        }
    }
    model->pose = refine_pose_by_weights(still, model->pose, scale, counted, kLastReachPx / evidence_.focal_px);
    model->M = model->E = essential_from_pose(model->pose);
    return model;
}

std::optional<TwoViewModel> Search::with_expected(std::optional<TwoViewModel> model) const {
    // Nothing is asked of many matches, nor of an answer that is sure, or hopeless.
    const double certain = coefficients_.settled[1], hopeless = coefficients_.settled[2];
    if (!model || judged_.size() >= kFewMatches ||
        !(hopeless < *model->confidence && *model->confidence <= certain)) {
        return model;
    }
    std::vector<Pose> hypotheses;
    for (const Found& found : poses_) {
        hypotheses.push_back(found.pose);
    }
    const std::vector<double> scores = select(evidence_.network->scores, evidence_.once);
    const auto found =
        expected_best(judged_, scores, hypotheses, model->judgement->scale, evidence_.focal_px, coefficients_);
    if (found && pose_angle_deg(*found, model->pose) >= kExpectedDeg) {
        model->expected = found;
    }
    return model;
}

std::optional<TwoViewModel> Search::fundamental() {
    // The same sources with F estimators. The choice is the likelihood alone: without intrinsics depths mean little.
    std::vector<Proposal> wanted{kList, kAccepted, kScoreOrder, kListOrder, kScoreOrderAll};
    if (const auto one = alone(options_.method)) {
        wanted = {*one};
    }
    std::vector<std::pair<cv::Matx33d, std::string>> found;
    std::vector<Residuals> residuals;
    for (const Proposal& proposal : wanted) {
        for (const cv::Matx33d& F : run(proposal)) {
            found.emplace_back(F, proposal.name);
            Residuals& residual = residuals.emplace_back();
            residual.distance_px = sampson_distances(judged_, F);
            for (double& distance : residual.distance_px) {
                distance *= evidence_.focal_px;
            }
            residual.behind.assign(judged_.size(), 0);
        }
    }
    if (found.empty()) {
        return std::nullopt;
    }
    std::vector<double> probability = select(evidence_.network->scores, evidence_.once);
    const std::vector<double> counts = independent_counts(judged_, probability, coefficients_);
    for (double& score : probability) {
        score = score_prior(score, coefficients_);
    }
    std::size_t best = 0, best_column = 0;
    const auto likelihood = log_likelihoods(residuals, probability, coefficients_, counts);
    for (std::size_t column = 0; column < coefficients_.noise_scales.size(); ++column) {
        for (std::size_t h = 0; h < found.size(); ++h) {
            if (likelihood[h][column] > likelihood[best][best_column]) {
                best = h;
                best_column = column;
            }
        }
    }
    const auto& [F, origin] = found[best];
    const auto pose = pose_from_essential(F, evidence_.correspondences, evidence_.focal_px);
    if (!pose) {
        return std::nullopt;
    }
    return TwoViewModel{F, project_to_essential(F), *pose, origin, "all sources", std::nullopt, std::nullopt};
}

std::vector<float> scores_by_residuals(const PairInput& pair, const TwoViewModel& model,
                                       const Coefficients& coefficients) {
    const Mask listed = listed_rows(pair.attributes, pair.valid);
    Correspondences valid;
    std::vector<Mask> groups(2);
    for (std::size_t i = 0; i < pair.valid.size(); ++i) {
        if (pair.valid[i] != 0) {
            valid.push_back(pair.correspondences[i]);
            groups[0].push_back(listed[i] != 0 ? 1 : 0);
            groups[1].push_back(listed[i] != 0 ? 0 : 1);
        }
    }
    const Residuals residuals = measure_residuals(valid, model.pose, pair.focal_px());
    const double scale = model.judgement ? model.judgement->scale : 1.0;
    const std::vector<double> probability = posterior(residuals, groups, scale, coefficients);
    std::vector<float> scores(pair.valid.size(), 0.0F);
    std::size_t k = 0;
    for (std::size_t i = 0; i < scores.size(); ++i) {
        if (pair.valid[i] != 0) {
            scores[i] = static_cast<float>(probability[k++]);
        }
    }
    return scores;
}

std::optional<Pose> pose_from_essential(const cv::Matx33d& E, const Correspondences& matches, double focal_px) {
    if (!usable(E)) {
        return std::nullopt;
    }
    Correspondences near;
    for (const Correspondence& match : matches) {
        if (sampson_distance(match, E) < kRefinePx / focal_px) {
            near.push_back(match);
        }
    }
    if (near.empty()) {
        return std::nullopt;
    }
    std::optional<Pose> best;
    std::ptrdiff_t fewest = 0;
    for (const Pose& pose : decompose_essential(E)) {
        const Residuals residuals = measure_residuals(near, pose, focal_px);
        const std::ptrdiff_t behind = std::count(residuals.behind.begin(), residuals.behind.end(), 1);
        if (!best || behind < fewest) {
            best = pose;
            fewest = behind;
        }
    }
    return best;
}

}  // namespace mgca::detail
