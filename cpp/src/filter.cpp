// The public door; the flow of one pair, one call per step, in order; mgca_filter/match_filter.py.

#include "embedded_model.hpp"
#include "focal_estimate.hpp"
#include "mirror.hpp"
#include "model_file.hpp"
#include "network.hpp"
#include "robust_fit.hpp"
#include "scoring.hpp"
#include "sha256.hpp"
#include "verdict.hpp"

#include <mgca/filter.hpp>

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <iomanip>
#include <sstream>
#include <string_view>
#include <utility>

namespace mgca {

struct Model::State {
    detail::ModelMetadata metadata;
    std::string sha256;
    std::unique_ptr<detail::Network> network;
};

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

void check(const RuntimeOptions& options) {
    if (options.threads < 0) {
        throw ArgumentError("threads: expected 0 or more, got " + std::to_string(options.threads));
    }
}

std::shared_ptr<const Model::State> open_model(std::string_view content, const std::string& source,
                                               const std::filesystem::path& file, const RuntimeOptions& options) {
    check(options);
    auto state = std::make_shared<Model::State>();
    state->metadata = detail::read_metadata(content, source);
    state->sha256 = detail::sha256(content);
    state->network = detail::open_network(content, source, file, options);
    return state;
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

Model Model::from_file(const std::filesystem::path& file, const RuntimeOptions& options) {
    return Model(open_model(detail::read_model_file(file), file.string(), file, options));
}

Model Model::from_memory(const void* data, std::size_t size, const RuntimeOptions& options) {
    if (data == nullptr) {
        throw ArgumentError("data: expected the bytes of a model file");
    }
    return Model(open_model({static_cast<const char*>(data), size}, "model in memory", {}, options));
}

bool has_embedded_model() noexcept { return !detail::embedded_model().empty(); }

Model embedded_model(const RuntimeOptions& options) {
    if (!has_embedded_model()) {
        throw ModelError("this library was built without a model in it (MGCA_EMBED_MODEL=ON); use Model::from_file");
    }
    return Model(open_model(detail::embedded_model(), "embedded model", {}, options));
}

const std::string& Model::name() const noexcept { return state_->metadata.name; }

const std::string& Model::version() const noexcept { return state_->metadata.version; }

const std::string& Model::sha256() const noexcept { return state_->sha256; }

const std::vector<std::string>& Model::notes() const noexcept { return state_->network->notes(); }

std::string Model::runtime() { return detail::runtime_name(); }

Filter::Filter(Model model, const Options& options) : model_(std::move(model)), options_(options) { check(options); }

Result Filter::operator()(const MatchPair& matches) const {
    const detail::ModelMetadata& metadata = model_.state_->metadata;
    // 1. Read the pair.
    detail::PairInput pair = detail::prepare_pair(matches);
    const bool given = pair.calibrated();
    if (options_.geometry == Geometry::essential && !given) {
        throw ArgumentError("camera1.K: the geometry 'essential' needs the intrinsics");
    }
    if (options_.geometry == Geometry::fundamental) {
        pair.intrinsics1.guessed = pair.intrinsics2.guessed = true;
    }
    Result result;
    result.intrinsics = given ? IntrinsicsSource::given : IntrinsicsSource::guessed;

    // 2. A run on the list alone may explain it.
    std::optional<detail::Evidence> evidence;
    std::optional<detail::Search> search;
    std::optional<detail::TwoViewModel> model;
    if (options_.method != Method::none) {
        evidence = detail::gather_before(pair);
        if (options_.geometry != Geometry::homography) {
            search.emplace(*evidence, metadata.choice, options_);
            if (options_.method == Method::automatic && options_.effort == Effort::automatic) {
                model = search->before_network();
            }
        }
    }

    // 3. Scores: from the residuals, or by the network, and the fit on what it saw.
    const std::size_t count = pair.valid.size();
    std::optional<detail::FocalEstimate> focal;
    if (model) {
        result.scores = detail::scores_by_residuals(pair, *model, metadata.choice);
        for (std::size_t i = 0; i < count; ++i) {
            result.logits.push_back(pair.valid[i] != 0 ? metadata.calibration.logit(result.scores[i])
                                                       : detail::kInvalidLogit);
        }
    } else {
        const detail::Rows sent = detail::select_network_input(pair, metadata, options_.seed);
        const auto output = detail::run_network(*model_.state_->network, pair, sent);
        result.num_network_matches = static_cast<int>(sent.size());
        result.logits = detail::assemble_logits(pair, sent, output, metadata);
        std::vector<float> margins;
        for (std::size_t i = 0; i < count; ++i) {
            result.scores.push_back(pair.valid[i] != 0 ? metadata.calibration.probability(result.logits[i]) : 0.0F);
            margins.push_back(result.logits[i] - static_cast<float>(metadata.decision_threshold));
        }
        const cv::Matx33d essential = output ? output->essential : cv::Matx33d();
        if (output) {
            result.network_essential = essential;
        }
        if (evidence) {
            evidence = detail::gather_scored(pair, sent, result.scores, margins, essential);
        }
        if (search) {
            model = search->with_network(*evidence);
        }
        if (model && !given && options_.geometry == Geometry::automatic) {
            // A second fit, of an essential matrix, where the matches tell the focal lengths that were guessed.
            for (const detail::FocalEstimate& estimate : detail::estimate_focals(*evidence, model->M)) {
                detail::PairInput zoomed = pair.with_focals(estimate.factors);
                cv::Matx33d E = essential;
                if (detail::usable(E)) {
                    E = detail::project_to_essential(zoom_of(estimate.factors[1]) * E * zoom_of(estimate.factors[0]));
                }
                detail::Evidence scored = detail::gather_scored(zoomed, sent, result.scores, margins, E);
                detail::Search again(detail::gather_before(zoomed), metadata.choice, options_);
                auto better = again.with_network(scored);
                if (better && detail::agrees_as_well(scored, *better, *evidence, *model)) {
                    pair = std::move(zoomed);
                    evidence = std::move(scored);
                    model = std::move(better);
                    focal = estimate;
                    break;
                }
            }
        }
    }

    // 4. Re-test of all matches, and the verdict.
    detail::Verdict verdict;
    if (!evidence) {
        verdict = detail::verdict_by_scores(pair, keep_by_scores(pair, result.scores, options_));
    } else {
        const double threshold_px = pair.threshold_px(options_.threshold);
        verdict = options_.geometry == Geometry::homography
                      ? detail::judge_homography(pair, *evidence, threshold_px, options_)
                      : detail::judge(pair, model, *evidence, threshold_px, metadata.choice, options_);
        if (focal && verdict.status == Status::suspicious_intrinsics) {
            // The intrinsics are nobody's claim.
            verdict.status = verdict.H ? Status::planar : Status::low_support;
        }
        if (focal && verdict.status == Status::planar) {
            verdict.E.reset();  // a plane tells no focal length
            verdict.R.reset();
            verdict.t.reset();
        }
        if (!given && !focal && options_.geometry == Geometry::automatic && verdict.t) {
            verdict.E.reset();  // nor do matches that no focal length explains
            verdict.R.reset();
            verdict.t.reset();
        }
        verdict = detail::judge_mirror(pair, *evidence, std::move(verdict), threshold_px, options_);
        if (focal && model->confidence && verdict.t) {
            // A pose is no surer than its focal lengths; the matches are not in doubt with it.
            result.fitted_confidence = model->confidence;
            result.focal_sigma_deg = detail::pose_sigma_deg(*evidence, *model, *focal);
            model->confidence = detail::confidence_under_estimate(*model->confidence, *result.focal_sigma_deg);
            if (verdict.status == Status::ok && *model->confidence < metadata.choice.verdict[1]) {
                verdict.status = Status::low_support;
                result.focal_doubt = true;
            }
        }
        if (options_.keep_precision && (verdict.F || verdict.R || verdict.H)) {
            verdict.mask = keep_by_scores(pair, result.scores, options_);
        }
    }
    result.num_accepted = static_cast<int>(
        std::count_if(result.logits.begin(), result.logits.end(),
                      [&](float logit) { return logit > static_cast<float>(metadata.decision_threshold); }));
    if (model) {
        result.fitted_essential = model->E;
        result.origin = model->origin;
        result.ended = model->ended;
        if (verdict.t) {
            result.confidence = model->confidence;
        }
    }
    result.assumptions = pair.assumptions;
    if (focal) {
        result.intrinsics = IntrinsicsSource::estimated;
        const cv::Matx33d &K1 = pair.intrinsics1.K, &K2 = pair.intrinsics2.K;
        const cv::Vec2d focal_px(detail::mean_focal_length(K1, K1), detail::mean_focal_length(K2, K2));
        result.focal_px = focal_px / pair.unit_px;
        result.focal_sigma = focal->sigmas;
        for (std::string& sentence : focal_sentences(*result.focal_px, focal->sigmas)) {
            result.assumptions.push_back(std::move(sentence));
        }
    }
    if (verdict.mirrored) {
        result.assumptions.push_back("one of the images is mirrored: the matches agree with a view that no camera has");
    }
    result.translation_sigma_deg = verdict.translation_sigma_deg;
    result.status = verdict.status;
    result.mask = std::move(verdict.mask);
    result.mirrored = verdict.mirrored;
    result.num_inliers = static_cast<int>(std::count(result.mask.begin(), result.mask.end(), 1));
    result.E = verdict.E;
    result.F = verdict.F;
    result.R = verdict.R;
    result.t = verdict.t;
    result.H = verdict.H;
    result.support = verdict.support;
    result.log10_false_alarms = verdict.log10_false_alarms;
    result.focal_factor = verdict.focal_factor;
    if (options_.keep_precision && result.num_inliers == 0 && (result.F || result.R || result.H)) {
        result.assumptions.push_back(empty_sentence(*options_.keep_precision, result.scores));
    }
    return result;
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
