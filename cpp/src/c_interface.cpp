// The C interface, mgca/mgca.h, over the C++ one.

#include <mgca/filter.hpp>
#include <mgca/mgca.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <exception>
#include <limits>
#include <new>
#include <optional>
#include <string>
#include <utility>
#include <vector>

struct mgca_model {
    mgca::Model model;
};

struct mgca_filter {
    mgca::Model model;
    mgca::Options options;
};

struct mgca_pair {
    mgca::MatchPair pair;
    bool same_rows = true;  // no matches were set
};

struct mgca_result {
    mgca::Result result;
};

namespace {

using mgca::ArgumentError;

// Of a size of its own: words on a lack of memory must need none.
constexpr std::size_t kErrorSize = 1024;
thread_local char last_error[kErrorSize] = "";

int failed(int kind, const char* words) noexcept {
    std::snprintf(last_error, kErrorSize, "%s", words);
    return kind;
}

/// Run a call, with its exceptions turned into numbers.
template <typename Call>
int guarded(const Call& call) noexcept {
    try {
        call();
        return MGCA_DONE;
    } catch (const mgca::ArgumentError& error) {
        return failed(MGCA_ARGUMENT_ERROR, error.what());
    } catch (const mgca::ModelError& error) {
        return failed(MGCA_MODEL_ERROR, error.what());
    } catch (const mgca::Error& error) {
        return failed(MGCA_RUNTIME_ERROR, error.what());
    } catch (const std::bad_alloc&) {
        return failed(MGCA_INTERNAL_ERROR, "not enough memory");
    } catch (const std::exception& error) {
        return failed(MGCA_INTERNAL_ERROR, error.what());
    } catch (...) {
        return failed(MGCA_INTERNAL_ERROR, "unknown error");
    }
}

/// What a pointer points at; throws where it is null.
template <typename T>
T& at(T* pointer, const char* name) {
    if (pointer == nullptr) {
        throw ArgumentError(std::string(name) + ": must not be NULL");
    }
    return *pointer;
}

/// Make a new object where the caller wants it, null before it is there.
template <typename T, typename Make>
int created(T** place, const char* name, const Make& make) noexcept {
    return guarded([&] {
        at(place, name) = nullptr;
        *place = make();
    });
}

/// A copy of `count` values, none for a null pointer; throws where values are missing.
template <typename To, typename From>
std::vector<To> copied(const From* values, std::size_t count, const char* name) {
    if (count > 0) {
        at(values, name);
    }
    return std::vector<To>(values, values + count);
}

template <typename To, typename From>
std::vector<To> copied_if_given(const From* values, std::size_t count) {
    return values == nullptr ? std::vector<To>() : std::vector<To>(values, values + count);
}

std::vector<cv::Point2d> points(const double* values, std::size_t count, const char* name) {
    if (count > 0) {
        at(values, name);
    }
    std::vector<cv::Point2d> pixels;
    pixels.reserve(count);
    for (std::size_t i = 0; i < count; ++i) {
        pixels.emplace_back(values[2 * i], values[2 * i + 1]);
    }
    return pixels;
}

std::optional<cv::Matx33d> intrinsics(const double* K) {
    return K == nullptr ? std::nullopt : std::optional<cv::Matx33d>(cv::Matx33d(K));
}

mgca::RuntimeOptions runtime_options(int threads, const char* providers) {
    mgca::RuntimeOptions options;
    options.threads = threads;
    const std::string names = providers == nullptr ? "" : providers;
    for (std::size_t begin = 0; begin < names.size();) {
        const std::size_t end = std::min(names.find(',', begin), names.size());
        const std::size_t first = names.find_first_not_of(' ', begin), last = names.find_last_not_of(' ', end - 1);
        if (end > begin && first < end) {
            options.providers.push_back(names.substr(first, last + 1 - first));
        }
        begin = end + 1;
    }
    return options;
}

template <typename T>
T& of_image(int image, T& first, T& second) {
    if (image != 1 && image != 2) {
        throw ArgumentError("image: expected 1 or 2, got " + std::to_string(image));
    }
    return image == 1 ? first : second;
}

[[noreturn]] void unknown(const char* what, const std::string& name) {
    throw ArgumentError(std::string(what) + ": unknown: '" + name + "'");
}

int whole(double value, const std::string& option) {
    if (!(std::abs(value) <= std::numeric_limits<int>::max()) || value != std::floor(value)) {
        throw ArgumentError(option + ": expected an integer, got " + std::to_string(value));
    }
    return static_cast<int>(value);
}

/// Change the options of a filter, or leave them as they are where they would be wrong.
template <typename Change>
int with_options(mgca_filter* filter, const Change& change) noexcept {
    return guarded([&] {
        mgca::Options options = at(filter, "filter").options;
        change(options);
        filter->options = mgca::Filter(filter->model, options).options();
    });
}

mgca_result* answer(const mgca_filter* filter, const mgca::MatchPair& pair) {
    const mgca_filter& known = at(filter, "filter");
    return new mgca_result{mgca::Filter(known.model, known.options)(pair)};
}

/// A value of a result; `none` where the handle is null or the call fails.
template <typename T, typename Call>
T value_of(const mgca_result* result, T none, const Call& call) noexcept {
    T value = none;
    guarded([&] { value = call(at(result, "result").result); });
    return value;
}

template <typename T>
double number(const std::optional<T>& value) {
    return value ? static_cast<double>(*value) : std::numeric_limits<double>::quiet_NaN();
}

}  // namespace

extern "C" {

const char* mgca_last_error(void) { return last_error; }

const char* mgca_version(void) { return MGCA_VERSION; }

const char* mgca_status_word(int status) { return mgca::to_string(static_cast<mgca::Status>(status)); }

int mgca_model_open(const char* file, int threads, const char* providers, mgca_model** model) {
    return created(model, "model", [&] {
        const mgca::RuntimeOptions options = runtime_options(threads, providers);
        return new mgca_model{file == nullptr ? mgca::embedded_model(options) : mgca::Model::from_file(file, options)};
    });
}

int mgca_model_open_memory(const void* data, size_t size, int threads, const char* providers, mgca_model** model) {
    return created(model, "model", [&] {
        return new mgca_model{mgca::Model::from_memory(data, size, runtime_options(threads, providers))};
    });
}

int mgca_model_with_first_look(const mgca_model* model, const mgca_model* first_look, mgca_model** both) {
    return created(both, "both", [&] {
        return new mgca_model{at(model, "model").model.with_first_look(at(first_look, "first_look").model)};
    });
}

const char* mgca_model_name(const mgca_model* model) { return model == nullptr ? "" : model->model.name().c_str(); }

const char* mgca_model_version(const mgca_model* model) {
    return model == nullptr ? "" : model->model.version().c_str();
}

const char* mgca_model_sha256(const mgca_model* model) { return model == nullptr ? "" : model->model.sha256().c_str(); }

const char* mgca_model_note(const mgca_model* model, size_t index) {
    return model == nullptr || index >= model->model.notes().size() ? nullptr : model->model.notes()[index].c_str();
}

void mgca_model_close(mgca_model* model) { delete model; }

int mgca_filter_create(const mgca_model* model, mgca_filter** filter) {
    return created(filter, "filter", [&] { return new mgca_filter{at(model, "model").model, {}}; });
}

int mgca_filter_set_number(mgca_filter* filter, const char* option, double value) {
    return with_options(filter, [&](mgca::Options& options) {
        const std::string name = &at(option, "option");
        if (name == "threshold") {
            options.threshold = value;
        } else if (name == "keep_precision") {
            options.keep_precision = value;
        } else if (name == "confidence") {
            options.confidence = value;
        } else if (name == "max_iterations") {
            options.max_iterations = whole(value, name);
        } else if (name == "seed") {
            options.seed = whole(value, name);
        } else {
            unknown("option", name);
        }
    });
}

int mgca_filter_set_word(mgca_filter* filter, const char* option, const char* value) {
    return with_options(filter, [&](mgca::Options& options) {
        const std::string name = &at(option, "option"), word = &at(value, "value");
        if (name == "method") {
            options.method = mgca::to_method(word);
        } else if (name == "effort") {
            options.effort = mgca::to_effort(word);
        } else if (name == "geometry") {
            options.geometry = mgca::to_geometry(word);
        } else {
            unknown("option", name);
        }
    });
}

int mgca_filter_points(const mgca_filter* filter, const double* points1, const double* points2, const float* ratio,
                       size_t count, const double* K1, const double* K2, mgca_result** result) {
    return created(result, "result", [&] {
        mgca::MatchPair pair;
        pair.keypoints1 = points(points1, count, "points1");
        pair.keypoints2 = points(points2, count, "points2");
        pair.matches = mgca::Matches::same_rows(count);
        pair.attributes.ratio = copied_if_given<float>(ratio, count);
        pair.camera1.K = intrinsics(K1);
        pair.camera2.K = intrinsics(K2);
        return answer(filter, pair);
    });
}

int mgca_filter_run(const mgca_filter* filter, const mgca_pair* pair, mgca_result** result) {
    return created(result, "result", [&] {
        mgca::MatchPair matches = at(pair, "pair").pair;
        if (pair->same_rows) {
            if (matches.keypoints1.points.size() != matches.keypoints2.points.size()) {
                throw ArgumentError("matches: none were set, and the images have unlike numbers of keypoints");
            }
            matches.matches = mgca::Matches::same_rows(matches.keypoints1.points.size());
        }
        return answer(filter, matches);
    });
}

void mgca_filter_free(mgca_filter* filter) { delete filter; }

int mgca_pair_create(mgca_pair** pair) {
    return created(pair, "pair", [] { return new mgca_pair; });
}

int mgca_pair_set_keypoints(mgca_pair* pair, int image, const double* pixels, const float* sizes, const float* angles,
                            size_t count) {
    return guarded([&] {
        mgca::MatchPair& known = at(pair, "pair").pair;
        mgca::Keypoints keypoints = points(pixels, count, "points");
        keypoints.sizes = copied_if_given<float>(sizes, count);
        keypoints.angles = copied_if_given<float>(angles, count);
        of_image(image, known.keypoints1, known.keypoints2) = std::move(keypoints);
    });
}

int mgca_pair_set_matches(mgca_pair* pair, const int32_t* indices, const double* distances,
                          const double* second_distances, size_t count) {
    return guarded([&] {
        mgca_pair& known = at(pair, "pair");
        mgca::Matches matches = mgca::Matches::same_rows(count);
        for (std::size_t i = 0; indices != nullptr && i < count; ++i) {
            matches.index1[i] = indices[2 * i];
            matches.index2[i] = indices[2 * i + 1];
        }
        matches.distances = copied_if_given<double>(distances, count);
        matches.second_distances = copied_if_given<double>(second_distances, count);
        known.pair.matches = std::move(matches);
        known.same_rows = false;
    });
}

int mgca_pair_set_camera(mgca_pair* pair, int image, const double* K, const double* distortion, size_t num_distortion,
                         double width, double height) {
    return guarded([&] {
        mgca::MatchPair& known = at(pair, "pair").pair;
        mgca::Camera& camera = of_image(image, known.camera1, known.camera2);
        std::vector<double> coefficients = copied<double>(distortion, num_distortion, "distortion");
        camera.K = intrinsics(K);
        camera.distortion = std::move(coefficients);
        camera.size = {width, height};
    });
}

int mgca_pair_set_fisheye(mgca_pair* pair, int image, const double* k) {
    return guarded([&] {
        mgca::MatchPair& known = at(pair, "pair").pair;
        at(k, "k");
        of_image(image, known.camera1, known.camera2).fisheye = mgca::Fisheye{k[0], k[1], k[2], k[3]};
    });
}

int mgca_pair_set_attribute(mgca_pair* pair, const char* name, const float* values, size_t count) {
    return guarded([&] {
        mgca::Attributes& known = at(pair, "pair").pair.attributes;
        const std::string word = &at(name, "name");
        if (word == "best") {
            std::vector<unsigned char> best;
            for (const float value : copied<float>(values, count, "values")) {
                best.push_back(value != 0.0F ? 1 : 0);
            }
            known.best = std::move(best);
            return;
        }
        std::vector<float>* place = word == "ratio"    ? &known.ratio
                                    : word == "size1"  ? &known.size1
                                    : word == "size2"  ? &known.size2
                                    : word == "angle1" ? &known.angle1
                                    : word == "angle2" ? &known.angle2
                                                       : nullptr;
        if (place == nullptr) {
            unknown("name", word);
        }
        *place = copied<float>(values, count, "values");
    });
}

int mgca_pair_set_resolution(mgca_pair* pair, double resolution) {
    return guarded([&] { at(pair, "pair").pair.resolution = resolution; });
}

void mgca_pair_free(mgca_pair* pair) { delete pair; }

int mgca_result_status(const mgca_result* result) {
    return value_of(result, -1, [](const mgca::Result& known) { return static_cast<int>(known.status); });
}

int mgca_result_ok(const mgca_result* result) {
    return value_of(result, 0, [](const mgca::Result& known) { return known.ok() ? 1 : 0; });
}

int mgca_result_verified(const mgca_result* result) {
    return value_of(result, 0, [](const mgca::Result& known) { return known.verified() ? 1 : 0; });
}

size_t mgca_result_size(const mgca_result* result) {
    return value_of(result, std::size_t{0}, [](const mgca::Result& known) { return known.mask.size(); });
}

const unsigned char* mgca_result_mask(const mgca_result* result) {
    return value_of<const unsigned char*>(result, nullptr, [](const mgca::Result& known) { return known.mask.data(); });
}

const float* mgca_result_scores(const mgca_result* result) {
    return value_of<const float*>(result, nullptr, [](const mgca::Result& known) { return known.scores.data(); });
}

const float* mgca_result_logits(const mgca_result* result) {
    return value_of<const float*>(result, nullptr, [](const mgca::Result& known) { return known.logits.data(); });
}

const double* mgca_result_matrix(const mgca_result* result, const char* name) {
    return value_of<const double*>(result, nullptr, [&](const mgca::Result& known) {
        const std::string word = &at(name, "name");
        const std::optional<cv::Matx33d>* matrix = word == "E"   ? &known.E
                                                   : word == "F" ? &known.F
                                                   : word == "R" ? &known.R
                                                   : word == "H" ? &known.H
                                                                 : nullptr;
        if (matrix == nullptr) {
            unknown("name", word);
        }
        return *matrix ? (*matrix)->val : nullptr;
    });
}

const double* mgca_result_translation(const mgca_result* result) {
    return value_of<const double*>(result, nullptr,
                                   [](const mgca::Result& known) { return known.t ? known.t->val : nullptr; });
}

double mgca_result_number(const mgca_result* result, const char* name) {
    return value_of(result, std::numeric_limits<double>::quiet_NaN(), [&](const mgca::Result& known) {
        const std::string word = &at(name, "name");
        if (word == "num_inliers") {
            return static_cast<double>(known.num_inliers);
        }
        if (word == "num_accepted") {
            return static_cast<double>(known.num_accepted);
        }
        if (word == "num_network_matches") {
            return static_cast<double>(known.num_network_matches);
        }
        if (word == "support") {
            return number(known.support);
        }
        if (word == "mirrored") {
            return known.mirrored ? 1.0 : 0.0;
        }
        if (word == "focal_doubt") {
            return known.focal_doubt ? 1.0 : 0.0;
        }
        if (word == "focal_px1" || word == "focal_px2" || word == "focal_sigma1" || word == "focal_sigma2") {
            const std::optional<cv::Vec2d>& both = word.find("focal_px") == 0 ? known.focal_px : known.focal_sigma;
            return both ? (*both)[word.back() - '1'] : std::numeric_limits<double>::quiet_NaN();
        }
        const std::optional<double>* value = word == "confidence"              ? &known.confidence
                                             : word == "log10_false_alarms"    ? &known.log10_false_alarms
                                             : word == "translation_sigma_deg" ? &known.translation_sigma_deg
                                             : word == "focal_sigma_deg"       ? &known.focal_sigma_deg
                                             : word == "fitted_confidence"     ? &known.fitted_confidence
                                             : word == "focal_factor"          ? &known.focal_factor
                                                                               : nullptr;
        if (value == nullptr) {
            unknown("name", word);
        }
        return number(*value);
    });
}

const char* mgca_result_word(const mgca_result* result, const char* name) {
    return value_of<const char*>(result, nullptr, [&](const mgca::Result& known) {
        const std::string word = &at(name, "name");
        if (word == "intrinsics") {
            return mgca::to_string(known.intrinsics);
        }
        if (word != "origin" && word != "ended") {
            unknown("name", word);
        }
        return word == "origin" ? known.origin.c_str() : known.ended.c_str();
    });
}

const char* mgca_result_network(const mgca_result* result, size_t index) {
    return value_of<const char*>(result, nullptr, [&](const mgca::Result& known) {
        return index < known.networks.size() ? known.networks[index].c_str() : nullptr;
    });
}

const char* mgca_result_assumption(const mgca_result* result, size_t index) {
    return value_of<const char*>(result, nullptr, [&](const mgca::Result& known) {
        return index < known.assumptions.size() ? known.assumptions[index].c_str() : nullptr;
    });
}

void mgca_result_free(mgca_result* result) { delete result; }

}  // extern "C"
