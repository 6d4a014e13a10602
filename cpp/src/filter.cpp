// The public door; the flow of one pair, one call per step, in order; mgca_filter/match_filter.py.

#include "focal_estimate.hpp"
#include "mirror.hpp"
#include "model.hpp"
#include "robust_fit.hpp"
#include "scoring.hpp"
#include "verdict.hpp"

#include <mgca/filter.hpp>

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <iomanip>
#include <memory>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

namespace mgca {

namespace {

void check(const Options& options) {
    const auto inside = [](double value) { return value > 0.0 && value < 1.0; };
    if (!(options.threshold > 0.0) || !std::isfinite(options.threshold)) {
        throw ArgumentError("threshold: expected a number above 0, got " + std::to_string(options.threshold));
    }
    if (options.keep_precision && !inside(*options.keep_precision)) {
        throw ArgumentError("keep_precision: expected a number above 0 and below 1, got " +
                            std::to_string(*options.keep_precision));
    }
    if (!inside(options.confidence)) {
        throw ArgumentError("confidence: expected a number above 0 and below 1, got " +
                            std::to_string(options.confidence));
    }
    if (options.max_iterations < 1) {
        throw ArgumentError("max_iterations: expected 1 or more, got " + std::to_string(options.max_iterations));
    }
    if (options.seed < 0) {
        throw ArgumentError("seed: expected 0 or more, got " + std::to_string(options.seed));
    }
}

/// Mask that asks the scores alone.
detail::Mask keep_by_scores(const detail::PairInput& pair, const std::vector<float>& scores, const Options& options) {
    if (options.keep_precision) {
        return detail::largest_set_of_precision(scores, pair.valid, *options.keep_precision);
    }
    detail::Mask kept(scores.size());
    for (std::size_t i = 0; i < scores.size(); ++i) {
        kept[i] = scores[i] > 0.5F && pair.valid[i] != 0 ? 1 : 0;
    }
    return kept;
}

cv::Matx33d zoom_of(double factor) { return cv::Matx33d::diag({factor, factor, 1.0}); }

/// What was assumed of the cameras whose focal lengths were estimated.
std::vector<std::string> focal_sentences(const cv::Vec2d& focal_px, const cv::Vec2d& sigmas) {
    const auto sentence = [&](int i, const char* whose) {
        return "focal length " + std::to_string(std::llround(focal_px[i])) + " px of " + whose +
               " estimated from the matches, to " + std::to_string(std::llround(100.0 * sigmas[i])) + " %";
    };
    if (focal_px[0] == focal_px[1]) {
        return {sentence(0, "both images")};
    }
    return {sentence(0, "image 1"), sentence(1, "image 2")};
}

/// Why a mask of that precision is empty.
std::string empty_sentence(double precision, const std::vector<float>& scores) {
    const float best = scores.empty() ? 0.0F : *std::max_element(scores.begin(), scores.end());
    std::ostringstream sentence;
    sentence << "keep_precision=" << precision << " keeps no match, for the best score is " << std::fixed
             << std::setprecision(2) << std::max(best, 0.0F)
             << ": the status speaks of the geometry alone; a threshold keeps what agrees with it";
    return sentence.str();
}

/// One pair on its way, step by step.
class Job {
public:
    using Networks = std::vector<std::shared_ptr<const detail::OpenNetwork>>;

    /// Read the pair.
    Job(const MatchPair& matches, const Networks& networks, const Options& options)
        : networks_(networks), options_(options), deepest_(networks.back()->metadata),
          pair_(detail::prepare_pair(matches)), given_(pair_.calibrated()) {
        if (options.geometry == Geometry::essential && !given_) {
            throw ArgumentError("camera1.K: the geometry 'essential' needs the intrinsics");
        }
        if (options.geometry == Geometry::fundamental) {
            pair_.intrinsics1.guessed = pair_.intrinsics2.guessed = true;
        }
    }

    Result run() {
        if (!explain_by_list()) {
            ask_networks();
        }
        score();
        const detail::Verdict verdict = judge();
        describe(verdict);
        return std::move(result_);
    }

private:
    /// A run on the list alone may explain it.
    bool explain_by_list() {
        if (options_.method == Method::none) {
            return false;
        }
        evidence_ = detail::gather_before(pair_);
        if (options_.geometry != Geometry::homography) {
            search_.emplace(*evidence_, deepest_.choice, options_);
            if (options_.method == Method::automatic && options_.effort == Effort::automatic) {
                model_ = search_->before_network();
            }
        }
        return model_.has_value();
    }

    /// Networks, the quickest first, until one settles the pair; each sees what those before it left undecided.
    void ask_networks() {
        rows_ = detail::select_network_input(pair_, networks_.front()->metadata, options_.seed);
        detail::Rows sent = rows_;
        std::vector<detail::Opinion> priors;  // of what enters no network
        for (const auto& one : networks_) {
            priors.push_back(detail::Opinion::of(detail::prior_logits(pair_, sent, one->metadata), one->metadata));
        }
        opinion_ = detail::Opinion::mean(priors);
        for (std::size_t i = 0; i < networks_.size(); ++i) {
            const auto& one = networks_[i];
            const auto output = detail::run_network(*one->network, pair_, sent);
            result_.networks.push_back(one->metadata.name);
            if (output) {
                result_.network_essential = output->essential;
                const auto heard = detail::Opinion::of(detail::finite_logits(*output), one->metadata);
                opinion_ = opinion_->joined(heard, sent);
            }
            const bool last = i + 1 == networks_.size();
            if (last || options_.effort == Effort::automatic) {
                fit(last);
            }
            if (model_) {
                return;
            }
            sent = opinion_->undecided(sent);
        }
    }

    /// Scores by the networks that were asked.
    std::vector<float> scores_by_networks() const {
        std::vector<float> scores(pair_.valid.size(), 0.0F);
        for (std::size_t i = 0; i < scores.size(); ++i) {
            if (pair_.valid[i] != 0) {
                scores[i] = detail::sigmoid(opinion_->log_odds[i]);
            }
        }
        return scores;
    }

    /// The model on what the first network saw; unless no deeper one is left, where the scores so far settle it.
    void fit(bool last) {
        if (!evidence_) {
            return;
        }
        const std::vector<float> scores = scores_by_networks();
        evidence_ = detail::gather_scored(pair_, rows_, scores, opinion_->margins, network_essential());
        if (search_) {
            model_ = last ? search_->with_network(*evidence_) : search_->after_first_look(*evidence_);
        }
        if (model_ && !given_ && options_.geometry == Geometry::automatic) {
            fit_under_estimated_focal(scores);
        }
    }

    /// A second fit, of an essential matrix, where the matches tell the focal lengths that were guessed.
    void fit_under_estimated_focal(const std::vector<float>& scores) {
        for (const detail::FocalEstimate& estimate : detail::estimate_focals(*evidence_, model_->M)) {
            detail::PairInput zoomed = pair_.with_focals(estimate.factors);
            cv::Matx33d E = network_essential();
            if (detail::usable(E)) {
                E = detail::project_to_essential(zoom_of(estimate.factors[1]) * E * zoom_of(estimate.factors[0]));
            }
            detail::Evidence scored = detail::gather_scored(zoomed, rows_, scores, opinion_->margins, E);
            detail::Search again(detail::gather_before(zoomed), deepest_.choice, options_);
            auto better = again.with_network(scored);
            if (better && detail::agrees_as_well(scored, *better, *evidence_, *model_)) {
                pair_ = std::move(zoomed);
                evidence_ = std::move(scored);
                model_ = std::move(better);
                focal_ = estimate;
                return;
            }
        }
    }

    /// Scores and logits of all matches: by the networks, or, of a pair that needed none, by the residuals.
    void score() {
        if (opinion_) {
            result_.scores = scores_by_networks();
            for (const float margin : opinion_->margins) {
                result_.logits.push_back(margin + static_cast<float>(deepest_.decision_threshold));
            }
            return;
        }
        result_.scores = detail::scores_by_residuals(pair_, *model_, deepest_.choice);
        for (std::size_t i = 0; i < result_.scores.size(); ++i) {
            result_.logits.push_back(pair_.valid[i] != 0 ? deepest_.calibration.logit(result_.scores[i])
                                                         : detail::kInvalidLogit);
        }
    }

    /// Re-test of all matches, and the verdict.
    detail::Verdict judge() {
        if (!evidence_) {
            return detail::verdict_by_scores(pair_, keep_by_scores(pair_, result_.scores, options_));
        }
        const double threshold_px = pair_.threshold_px(options_.threshold);
        detail::Verdict verdict = options_.geometry == Geometry::homography
                                      ? detail::judge_homography(pair_, *evidence_, threshold_px, options_)
                                      : detail::judge(pair_, model_, *evidence_, threshold_px, deepest_.choice, options_);
        if (focal_ && verdict.status == Status::suspicious_intrinsics) {
            // The intrinsics are nobody's claim.
            verdict.status = verdict.H ? Status::planar : Status::low_support;
        }
        if (focal_ && verdict.status == Status::planar) {
            verdict.E.reset();  // a plane tells no focal length
            verdict.R.reset();
            verdict.t.reset();
        }
        if (!given_ && !focal_ && options_.geometry == Geometry::automatic && verdict.t) {
            verdict.E.reset();  // nor do matches that no focal length explains
            verdict.R.reset();
            verdict.t.reset();
        }
        verdict = detail::judge_mirror(pair_, *evidence_, std::move(verdict), threshold_px, options_);
        if (focal_ && model_->confidence && verdict.t) {
            // A pose is no surer than its focal lengths; the matches are not in doubt with it.
            result_.fitted_confidence = model_->confidence;
            result_.focal_sigma_deg = detail::pose_sigma_deg(*evidence_, *model_, *focal_);
            model_->confidence = detail::confidence_under_estimate(*model_->confidence, *result_.focal_sigma_deg);
            if (verdict.status == Status::ok && *model_->confidence < deepest_.choice.verdict[1]) {
                verdict.status = Status::low_support;
                result_.focal_doubt = true;
            }
        }
        if (options_.keep_precision && (verdict.F || verdict.R || verdict.H)) {
            verdict.mask = keep_by_scores(pair_, result_.scores, options_);
        }
        return verdict;
    }

    /// The rest of the answer.
    void describe(const detail::Verdict& verdict) {
        result_.status = verdict.status;
        result_.mask = verdict.mask;
        result_.num_inliers = static_cast<int>(std::count(result_.mask.begin(), result_.mask.end(), 1));
        result_.E = verdict.E;
        result_.F = verdict.F;
        result_.R = verdict.R;
        result_.t = verdict.t;
        result_.H = verdict.H;
        result_.support = verdict.support;
        result_.log10_false_alarms = verdict.log10_false_alarms;
        result_.translation_sigma_deg = verdict.translation_sigma_deg;
        result_.focal_factor = verdict.focal_factor;
        result_.mirrored = verdict.mirrored;
        result_.num_network_matches = static_cast<int>(rows_.size());
        const auto threshold = static_cast<float>(deepest_.decision_threshold);
        result_.num_accepted = static_cast<int>(std::count_if(result_.logits.begin(), result_.logits.end(),
                                                              [&](float logit) { return logit > threshold; }));
        if (model_) {
            const detail::TwoViewModel answer = model_->answer();
            result_.fitted_essential = answer.E;
            result_.origin = answer.origin;
            result_.ended = model_->ended;
            if (verdict.t) {
                result_.confidence = model_->confidence;
            }
        }
        result_.intrinsics = given_ ? IntrinsicsSource::given : IntrinsicsSource::guessed;
        result_.assumptions = pair_.assumptions;
        if (focal_) {
            result_.intrinsics = IntrinsicsSource::estimated;
            const cv::Matx33d &K1 = pair_.intrinsics1.K, &K2 = pair_.intrinsics2.K;
            const cv::Vec2d focal_px(detail::mean_focal_length(K1, K1), detail::mean_focal_length(K2, K2));
            result_.focal_px = focal_px / pair_.unit_px;
            result_.focal_sigma = focal_->sigmas;
            for (std::string& sentence : focal_sentences(*result_.focal_px, focal_->sigmas)) {
                result_.assumptions.push_back(std::move(sentence));
            }
        }
        if (verdict.mirrored) {
            result_.assumptions.push_back(
                "one of the images is mirrored: the matches agree with a view that no camera has");
        }
        if (options_.keep_precision && result_.num_inliers == 0 && (result_.F || result_.R || result_.H)) {
            result_.assumptions.push_back(empty_sentence(*options_.keep_precision, result_.scores));
        }
    }

    /// The network E of the network that was asked last, or zeros.
    cv::Matx33d network_essential() const { return result_.network_essential.value_or(cv::Matx33d()); }

    const Networks& networks_;
    const Options& options_;
    const detail::ModelMetadata& deepest_;
    detail::PairInput pair_;
    bool given_;  // the intrinsics
    std::optional<detail::Evidence> evidence_;
    std::optional<detail::Search> search_;
    std::optional<detail::TwoViewModel> model_;
    detail::Rows rows_;  // that the first network saw
    std::optional<detail::Opinion> opinion_;
    std::optional<detail::FocalEstimate> focal_;
    Result result_;
};

template <typename Value>
Value by_word(const char* name, const std::string& word, std::initializer_list<std::pair<const char*, Value>> values) {
    std::string words;
    for (const auto& [known, value] : values) {
        if (word == known) {
            return value;
        }
        words += (words.empty() ? "" : ", ") + std::string(known);
    }
    throw ArgumentError(std::string(name) + ": expected one of " + words + ", got '" + word + "'");
}

}  // namespace

const char* to_string(Status status) noexcept {
    switch (status) {
        case Status::ok: return "ok";
        case Status::too_few_matches: return "too_few_matches";
        case Status::no_geometry: return "no_geometry";
        case Status::low_support: return "low_support";
        case Status::unrelated: return "unrelated";
        case Status::planar: return "planar";
        case Status::pure_rotation: return "pure_rotation";
        case Status::suspicious_intrinsics: return "suspicious_intrinsics";
    }
    return "";
}

const char* to_string(IntrinsicsSource source) noexcept {
    switch (source) {
        case IntrinsicsSource::given: return "given";
        case IntrinsicsSource::estimated: return "estimated";
        case IntrinsicsSource::guessed: return "guessed";
    }
    return "";
}

Method to_method(const std::string& word) {
    return by_word<Method>("method", word,
                           {{"auto", Method::automatic},
                            {"prosac", Method::prosac},
                            {"magsac", Method::magsac},
                            {"ransac", Method::ransac},
                            {"none", Method::none}});
}

Effort to_effort(const std::string& word) {
    return by_word<Effort>("effort", word, {{"auto", Effort::automatic}, {"full", Effort::full}});
}

Geometry to_geometry(const std::string& word) {
    return by_word<Geometry>("geometry", word,
                             {{"auto", Geometry::automatic},
                              {"essential", Geometry::essential},
                              {"fundamental", Geometry::fundamental},
                              {"homography", Geometry::homography}});
}

Filter::Filter(Model model, const Options& options) : model_(std::move(model)), options_(options) { check(options); }

Result Filter::operator()(const MatchPair& pair) const {
    return Job(pair, model_.state_->networks, options_).run();
}

Result Filter::operator()(const Keypoints& keypoints1, const Keypoints& keypoints2, const Matches& matches,
                          const Camera& camera1, const Camera& camera2) const {
    return (*this)(MatchPair{keypoints1, keypoints2, matches, camera1, camera2, {}, 1.0});
}

Result Filter::operator()(const Keypoints& keypoints1, const Keypoints& keypoints2, const Matches& matches,
                          const Camera& camera) const {
    return (*this)(MatchPair{keypoints1, keypoints2, matches, camera, camera, {}, 1.0});
}

}  // namespace mgca
