// The public interface: misuse throws one family and names what is wrong, data never throws, every option is felt.

#include "check.hpp"
#include "golden_files.hpp"

#include <mgca/mgca.h>

#include <atomic>
#include <cmath>
#include <fstream>
#include <iterator>
#include <limits>
#include <random>
#include <thread>

namespace {

using mgca::ArgumentError;
using mgca::Camera;
using mgca::Filter;
using mgca::Keypoints;
using mgca::MatchPair;
using mgca::Matches;
using mgca::Model;
using mgca::ModelError;
using mgca::Options;
using mgca::Result;
using mgca::Status;

std::string read_bytes(const std::filesystem::path& file) {
    std::ifstream stream(file, std::ios::binary);
    return {std::istreambuf_iterator<char>(stream), {}};
}

bool same(const Result& a, const Result& b) {
    return a.networks == b.networks && a.mask == b.mask && a.scores == b.scores && a.logits == b.logits && a.status == b.status &&
           a.R.has_value() == b.R.has_value() && (!a.R || cv::norm(*a.R - *b.R) == 0.0);
}

void options_are_checked(const Model& model) {
    const auto with = [&](auto change, const char* words) {
        Options options;
        change(options);
        check::throws<ArgumentError>([&] { const Filter filter(model, options); }, words);
    };
    with([](Options& o) { o.threshold = 0.0; }, "threshold");
    with([](Options& o) { o.threshold = std::numeric_limits<double>::quiet_NaN(); }, "threshold");
    with([](Options& o) { o.keep_precision = 1.0; }, "keep_precision");
    with([](Options& o) { o.confidence = 0.0; }, "confidence");
    with([](Options& o) { o.max_iterations = 0; }, "max_iterations");
    with([](Options& o) { o.seed = -1; }, "seed");
}

void model_files_are_checked(const std::filesystem::path& file) {
    const std::string content = read_bytes(file);
    mgca::RuntimeOptions runtime;
    runtime.threads = -1;
    check::throws<ArgumentError>([&] { Model::from_file(file, runtime); }, "threads");
    check::throws<ArgumentError>([] { Model::from_memory(nullptr, 0); }, "data");
    check::throws<ModelError>([] { Model::from_file("no such file.onnx"); }, "no such file.onnx: model file not found");
    check::throws<ModelError>([&] { Model::from_memory(content.data(), content.size() / 2); }, "truncated or damaged");
    check::throws<ModelError>([] { Model::from_memory("hello, world", 12); }, "model in memory");
    std::string other = content;
    const std::size_t key = other.find("contract_version");
    other[key + 18] = '9';  // behind the key: tag and length of the value
    check::throws<ModelError>([&] { Model::from_memory(other.data(), other.size()); }, "contract version 9");
    std::string unnamed = content;
    unnamed.replace(unnamed.find("candidate_rule"), 14, "candidate_rale");
    check::throws<ModelError>([&] { Model::from_memory(unnamed.data(), unnamed.size()); },
                              "metadata missing: candidate_rule");
    std::string broken = content;
    broken.replace(broken.find("\"scale\""), 7, "\"scole\"");
    check::throws<ModelError>([&] { Model::from_memory(broken.data(), broken.size()); }, "'calibration'");
    std::string short_choice = content;
    short_choice.replace(short_choice.find("\"early_end\""), 11, "\"early_and\"");
    check::throws<ModelError>([&] { Model::from_memory(short_choice.data(), short_choice.size()); },
                              "early_end is missing");
    mgca::RuntimeOptions provider;
    provider.providers = {"NoSuchExecutionProvider"};
    provider.cpu_fallback = false;
    check::throws<mgca::Error>([&] { Model::from_file(file, provider); }, "has no NoSuchExecutionProvider");
    provider.cpu_fallback = true;
    const Model given_way = Model::from_file(file, provider);
    check::that(given_way.notes().size() == 1 &&
                    given_way.notes()[0].find("another provider than asked for: this ONNX Runtime has no") !=
                        std::string::npos,
                "a provider that gives way is noted");
    std::string renamed = content;
    for (std::size_t at = 0; (at = renamed.find("correspondences", at)) != std::string::npos; ++at) {
        renamed.replace(at, 15, "correspondencez");
    }
    check::throws<ModelError>([&] { Model::from_memory(renamed.data(), renamed.size()); }, "expected correspondences");
    // All of one family, which is also a std::runtime_error.
    check::throws<mgca::Error>([] { Model::from_file("no such file.onnx"); }, "not found");
    check::throws<std::runtime_error>([] { Model::from_file("no such file.onnx"); }, "not found");
}

/// SHA256SUMS beside a file, as sha256sum writes it.
void sums_are_checked(const std::filesystem::path& file, const Model& model) {
    const std::filesystem::path folder = std::filesystem::temp_directory_path() / "mgca_test_sums";
    std::filesystem::create_directories(folder);
    const std::filesystem::path copy = folder / "model.onnx";
    std::filesystem::copy_file(file, copy, std::filesystem::copy_options::overwrite_existing);
    const auto with_sum = [&](const std::string& line) {
        std::ofstream(folder / "SHA256SUMS") << std::string(64, '0') << "  other.onnx\n" << line;
        return Model::from_file(copy).sha256();
    };
    check::equal(with_sum(model.sha256() + "  model.onnx\n"), model.sha256(), "the sum that is listed");
    check::equal(with_sum(""), model.sha256(), "a file that is not listed is not compared");
    check::throws<ModelError>([&] { with_sum(std::string(64, '1') + "  model.onnx\n"); }, "damaged or replaced");
    std::filesystem::remove_all(folder);
}

void models_are_named(const Model& model) {
    check::that(model.notes().empty(), "nothing is noted where nothing was asked for");
    check::that(!model.name().empty() && !model.version().empty(), "name and version of the model");
    check::that(!Model::runtime().empty(), "name of the runtime");
    check::equal(std::string(MGCA_VERSION),
                 std::to_string(MGCA_VERSION_MAJOR) + "." + std::to_string(MGCA_VERSION_MINOR) + "." +
                     std::to_string(MGCA_VERSION_PATCH),
                 "version macros agree");
}

void inputs_are_checked(const Model& model, const MatchPair& good) {
    const Filter filter(model);
    const auto with = [&](auto change, const char* words) {
        MatchPair pair = good;
        change(pair);
        check::throws<ArgumentError>([&] { filter(pair); }, words);
    };
    with([](MatchPair& p) { p.matches.index2[5] = 1000000; }, "matches[5]: index out of range");
    with([](MatchPair& p) { p.matches.index1[5] = -1; }, "matches[5]: index out of range");
    with([](MatchPair& p) { p.matches.index1.pop_back(); }, "index1 and index2");
    with([](MatchPair& p) { p.matches.distances.pop_back(); }, "matches.distances");
    with([](MatchPair& p) { p.matches.second_distances.pop_back(); }, "matches.second_distances");
    with([](MatchPair& p) { p.keypoints1.sizes.pop_back(); }, "keypoints1.sizes");
    with([](MatchPair& p) { p.keypoints2.angles.pop_back(); }, "keypoints2.angles");
    with([](MatchPair& p) { p.attributes.ratio = {0.5F}; }, "attributes.ratio");
    with([](MatchPair& p) { p.attributes.best = {1}; }, "attributes.best");
    with([](MatchPair& p) { p.camera1.K = cv::Matx33d::zeros(); }, "camera1.K");
    with([](MatchPair& p) { p.camera2.K = -*p.camera1.K; }, "camera2.K");
    with([](MatchPair& p) { p.camera1.K.reset(); p.camera2.K = cv::Matx33d::eye(); }, "camera1.K");
    with([](MatchPair& p) { p.camera1.distortion = {0.1, 0.2, 0.3}; }, "camera1.distortion");
    with([](MatchPair& p) { p.camera2.distortion = std::vector<double>(5, NAN); }, "camera2.distortion");
    with([](MatchPair& p) { p.camera1 = Camera(cv::Size2d(640, 480)); p.camera1.distortion = {0, 0, 0, 0}; },
         "distortion coefficients need K");
    with([](MatchPair& p) { p.camera1.fisheye = mgca::Fisheye{NAN, 0, 0, 0}; }, "camera1.fisheye");
    with([](MatchPair& p) { p.camera1.fisheye = mgca::Fisheye{}; p.camera1.distortion = {0, 0, 0, 0}; },
         "a fisheye has coefficients of its own");
    with([](MatchPair& p) { p.resolution = 0.0; }, "resolution");
    with([](MatchPair& p) { p.camera1.size = {0.5, 480.0}; }, "camera1.size");
    with([](MatchPair& p) { p.camera1.size = {640, 480}; p.camera2 = Camera(cv::Size2d(480, 640)); },
         "one K cannot be right");
    const std::vector<std::vector<cv::DMatch>> negative{{cv::DMatch(-1, -1, 1.0F)}};
    check::throws<ArgumentError>([&] { filter(good.keypoints1, good.keypoints2, negative); }, "matches[0]");
}

void data_never_throws(const Model& model) {
    std::mt19937 random(7);
    const float nan = std::numeric_limits<float>::quiet_NaN(), infinity = std::numeric_limits<float>::infinity();
    const Camera camera(cv::Matx33d(800, 0, 320, 0, 800, 240, 0, 0, 1));
    std::vector<float> special{0.0F, -0.0F, 1.0F, nan, infinity, -infinity, 1e30F, 1e-30F, 100.0F, 1e6F};
    for (const mgca::Method method : {mgca::Method::automatic, mgca::Method::prosac, mgca::Method::magsac,
                                      mgca::Method::ransac, mgca::Method::none}) {
        for (const int count : {0, 1, 5, 7, 8, 9, 40}) {
            for (const bool calibrated : {true, false}) {
                std::vector<cv::Point2f> points1, points2;
                std::vector<cv::DMatch> matches;
                for (int i = 0; i < count; ++i) {
                    const auto draw = [&] {
                        return random() % 4 == 0 ? special[random() % special.size()]
                                                 : static_cast<float>(random() % 6400) / 10.0F;
                    };
                    points1.emplace_back(draw(), draw());
                    points2.emplace_back(draw(), draw());
                    matches.emplace_back(i, i, random() % 5 == 0 ? nan : draw());
                }
                Options options;
                options.method = method;
                try {
                    const Result result = Filter(model, options)(points1, points2, matches, calibrated ? camera : Camera());
                    check::equal(result.mask.size(), matches.size(), "length of the mask");
                    check::equal(result.scores.size(), matches.size(), "length of the scores");
                } catch (const std::exception& error) {
                    check::that(false, std::string("data raised: ") + error.what());
                }
            }
        }
    }
}

void options_are_felt(const Model& model, const MatchPair& pair) {
    const auto answer = [&](auto change) {
        Options options;
        options.effort = mgca::Effort::full;
        change(options);
        return Filter(model, options)(pair);
    };
    const Result plain = answer([](Options&) {});
    check::that(plain.ok() && plain.num_network_matches > 0, "the pair goes through the network");
    check::that(same(plain, answer([](Options&) {})), "same options, same answer");
    check::that(plain.num_accepted > 0 && plain.network_essential && plain.fitted_essential, "what the network said");
    const cv::Vec4d moved = *plain.relative_pose(2.5) * cv::Vec4d(0.0, 0.0, 0.0, 1.0);
    check::near(cv::norm(cv::Vec3d(moved[0], moved[1], moved[2]) - 2.5 * *plain.t), 0.0, 1e-12, "relative pose");
    check::that(!Result().relative_pose(), "no pose, no matrix");
    check::that(answer([](Options& o) { o.threshold = 0.3; }).num_inliers < plain.num_inliers, "threshold is felt");
    check::that(answer([](Options& o) { o.keep_precision = 0.999; }).mask != plain.mask, "keep_precision is felt");
    // One estimator alone, whose answer no other outvotes.
    const auto alone = [&](auto change) {
        return answer([&](Options& o) {
            o.method = mgca::Method::magsac;
            change(o);
        });
    };
    const Result magsac = alone([](Options&) {});
    check::that(!same(magsac, alone([](Options& o) { o.max_iterations = 1; })), "max_iterations is felt");
    check::that(!same(magsac, alone([](Options& o) { o.seed = 11; })), "seed is felt");
    check::that(!same(magsac, alone([](Options& o) { o.confidence = 1e-6; })), "confidence is felt");
    check::that(answer([](Options& o) { o.method = mgca::Method::none; }).R.has_value() == false, "method is felt");
    const Result plane = answer([](Options& o) { o.geometry = mgca::Geometry::homography; });
    check::that(!plane.R && !plane.E && plane.mask != plain.mask, "geometry is felt");
    check::equal(answer([](Options& o) { o.method = mgca::Method::magsac; }).origin, std::string("magsac"), "method");
}

void cameras_are_felt(const Model& model, const MatchPair& pair) {
    const Filter filter(model);
    const Result guessed = filter(pair.keypoints1, pair.keypoints2, pair.matches);
    check::that(guessed.intrinsics != mgca::IntrinsicsSource::given, "without K it is guessed");
    const Result by_size = filter(pair.keypoints1, pair.keypoints2, pair.matches, Camera(cv::Size2d(2000, 1000)));
    check::that(by_size.assumptions != guessed.assumptions, "the size helps the guess");
    Camera bent = pair.camera1;
    bent.distortion = {-0.3, 0.1, 0.0, 0.0};
    const Result straight = filter(pair.keypoints1, pair.keypoints2, pair.matches, pair.camera1);
    const Result distorted = filter(pair.keypoints1, pair.keypoints2, pair.matches, bent);
    check::that(straight.mask != distorted.mask, "distortion is felt");
    check::that(same(straight, filter(pair)), "one camera is both");
    Camera fisheye = pair.camera1;
    fisheye.fisheye = mgca::Fisheye{};
    check::that(straight.mask != filter(pair.keypoints1, pair.keypoints2, pair.matches, fisheye).mask,
                "a fisheye is felt");
    Camera impossible = pair.camera1;
    impossible.distortion = {-1.5, 0.2, 0.0, 0.0};
    const Result doubtful = filter(pair.keypoints1, pair.keypoints2, pair.matches, impossible);
    check::that(doubtful.assumptions.size() == 2 && doubtful.assumptions[0].find("dist1 shows nothing at") == 0 &&
                    doubtful.assumptions[0].find("Fisheye(k1, k2, k3, k4)") != std::string::npos,
                "a lens that shows nothing is doubted");
    Camera wide(cv::Matx33d(150, 0, 320, 0, 150, 240, 0, 0, 1), {-0.02, 0.004, -0.001, 0.0002});
    const Result sideways = filter(pair.keypoints1, pair.keypoints2, pair.matches, wide);
    check::that(sideways.assumptions.size() == 2 &&
                    sideways.assumptions[0].find("the four coefficients of dist1 are read as a pinhole's") == 0,
                "four coefficients that see far to the side are doubted");
    wide.distortion.push_back(0.0);
    check::that(filter(pair.keypoints1, pair.keypoints2, pair.matches, wide).assumptions.empty(),
                "five are a pinhole's");
    MatchPair copy = pair;
    copy.resolution = 3.0;
    check::that(straight.num_inliers < filter(copy).num_inliers, "the resolution is felt");
    Options essential;
    essential.geometry = mgca::Geometry::essential;
    check::throws<ArgumentError>(
        [&] { Filter(model, essential)(pair.keypoints1, pair.keypoints2, pair.matches); }, "needs the intrinsics");
}

void two_cameras_have_two_focal_lengths(const Model& model, const MatchPair& pair) {
    const Result result = Filter(model)(pair);
    check::that(result.ok() && result.intrinsics == mgca::IntrinsicsSource::estimated, "focal lengths are estimated");
    if (check::that(result.focal_px && result.focal_sigma, "and given")) {
        check::near((*result.focal_px)[1] / (*result.focal_px)[0], 1.6, 0.1, "of two cameras");
        check::that((*result.focal_sigma)[0] > 0.0 && (*result.focal_sigma)[1] > 0.0, "with their spread");
        check::that(result.focal_sigma_deg.value_or(0.0) > 0.0 && *result.confidence <= *result.fitted_confidence,
                    "of which the confidence knows");
    }
    check::that(result.assumptions.size() == 4 &&
                    result.assumptions[3].find("px of image 2 estimated from the matches") != std::string::npos,
                "in a sentence each");
    MatchPair known = pair;
    known.camera1.K = cv::Matx33d(800, 0, 319.5, 0, 800, 239.5, 0, 0, 1);
    known.camera2.K = cv::Matx33d(1280, 0, 319.5, 0, 1280, 239.5, 0, 0, 1);
    check::that(!Filter(model)(known).focal_px, "what is given is not estimated");
    Result doubtful;
    doubtful.status = Status::low_support;
    check::that(!doubtful.verified(), "a model that is doubtful");
    doubtful.focal_doubt = true;
    check::that(!doubtful.ok() && doubtful.verified(), "a pose that is no surer than its focal lengths");
    Options options;
    options.geometry = mgca::Geometry::fundamental;
    check::that(!Filter(model, options)(pair).focal_px, "nor where F is asked for");
}

void a_mirrored_image_is_told(const Model& model, const MatchPair& pair) {
    const Result result = Filter(model)(pair);
    check::that(result.mirrored && result.status == Status::planar, "a mirrored plane");
    check::that(!result.E && !result.F && !result.R && !result.t && !result.confidence, "has no pose");
    check::that(result.H && cv::determinant(*result.H) < 0.0, "and a map that mirrors");
    check::that(result.assumptions.back().find("one of the images is mirrored") == 0, "which a sentence says");
    Options options;
    options.keep_precision = 0.99999;
    const Result empty = Filter(model, options)(pair);
    check::that(empty.num_inliers == 0 && empty.assumptions.back().find("keep_precision=0.99999 keeps no match") == 0,
                "an empty mask says why");
}

void threads_share_a_filter(const Model& model, const MatchPair& pair) {
    Options options;
    options.effort = mgca::Effort::full;
    const Filter filter(model, options);
    const Result expected = filter(pair);
    std::atomic<int> different{0};
    std::vector<std::thread> threads;
    for (int i = 0; i < 4; ++i) {
        threads.emplace_back([&] {
            const Filter copy = filter;
            for (int round = 0; round < 3; ++round) {
                different += same(copy(pair), expected) ? 0 : 1;
            }
        });
    }
    for (std::thread& thread : threads) {
        thread.join();
    }
    check::equal(different.load(), 0, "threads give the same answer");
}

void memory_and_file_agree(const std::filesystem::path& file, const Model& model, const MatchPair& pair) {
    mgca::RuntimeOptions runtime;
    runtime.threads = 2;
    const Filter from_memory = [&] {
        const std::string content = read_bytes(file);  // gone before the filter is used
        return Filter(Model::from_memory(content.data(), content.size(), runtime));
    }();
    check::that(same(from_memory(pair), Filter(model)(pair)), "a model in memory, on two threads, answers the same");
}

void embedded_models_are_the_files(const Model& model, const MatchPair& pair) {
    check::equal(mgca::has_embedded_model(), MGCA_TEST_EMBEDDED != 0, "whether models are embedded");
    if (mgca::has_embedded_model()) {
        check::that(same(Filter(mgca::embedded_model())(pair), Filter(model)(pair)), "the embedded models are the same");
        check::equal(mgca::embedded_model().sha256(), model.sha256(), "digests of the embedded models");
        mgca::RuntimeOptions runtime;
        runtime.threads = -1;
        check::throws<ArgumentError>([&] { mgca::embedded_model(runtime); }, "threads");
    } else {
        check::throws<ModelError>([] { mgca::embedded_model(); }, "MGCA_EMBED_MODEL");
    }
}

using Names = std::vector<std::string>;

/// A quick network, and a deeper one where that settles nothing.
void a_first_look_may_be_enough(const Model& deep, const Model& quick, const std::filesystem::path& golden) {
    const Model both = deep.with_first_look(quick);
    check::equal(both.name(), quick.name() + " + " + deep.name(), "names in the order of asking");
    check::equal(both.version(), quick.version() + " + " + deep.version(), "versions likewise");
    check::equal(both.sha256(), quick.sha256() + " + " + deep.sha256(), "digests likewise");
    check::throws<ArgumentError>([&] { both.with_first_look(quick); }, "one file each, got " + both.name());
    check::throws<ArgumentError>([&] { deep.with_first_look(both); }, "one file each, got " + both.name());

    const auto asked = [&](const Model& model, const char* input, auto change) {
        Options options;
        change(options);
        return Filter(model, options)(golden::read_input(golden, input));
    };
    const auto as_it_is = [](Options&) {};
    const auto full = [](Options& o) { o.effort = mgca::Effort::full; };
    const Names first{quick.name()}, all{quick.name(), deep.name()};
    const Result easy = asked(both, "general", as_it_is), settled = asked(both, "wide", as_it_is);
    check::that(easy.ok() && easy.networks.empty() && easy.num_network_matches == 0, "an easy pair asks no network");
    check::that(settled.ok() && settled.networks == first, "a first look that settles the pair is the only one");
    const Result by_quick = asked(quick, "wide", as_it_is);
    check::that(settled.mask == by_quick.mask && settled.E == by_quick.E, "with the geometry of the quick network alone");
    check::equal(settled.ended, std::string("first sources"), "which ended with the first sources");
    const Result faint = asked(both, "faint_13", as_it_is), sought = asked(both, "wide", full);
    check::that(faint.networks == all, "a first look that settles nothing asks the deep network as well");
    check::that(sought.networks == all && asked(both, "general", full).networks == all, "effort is felt");
    check::that(asked(both, "wide", [](Options& o) { o.method = mgca::Method::magsac; }).networks == all, "one method");
    check::that(asked(both, "wide", [](Options& o) { o.method = mgca::Method::none; }).networks == all, "none");
    check::that(asked(both, "wide", [](Options& o) { o.geometry = mgca::Geometry::homography; }).networks == all,
                "a homography");
    check::that(asked(both, "guessed_by_extent", as_it_is).networks == all, "without intrinsics");
    check::that(asked(both, "empty", as_it_is).networks == all, "no matches");

    // A file alone is asked alone; of both the logits are the mean, on what both saw.
    for (const Model& model : {quick, deep}) {
        check::that(asked(model, "wide", full).networks == Names{model.name()}, "one file, one network");
    }
    const Result one = asked(quick, "wide", full), other = asked(deep, "wide", full);
    int means = 0;
    for (std::size_t i = 0; i < sought.scores.size(); ++i) {
        const float low = std::min(one.scores[i], other.scores[i]), high = std::max(one.scores[i], other.scores[i]);
        means += sought.scores[i] >= low && sought.scores[i] <= high ? 1 : 0;
    }
    check::that(means > static_cast<int>(0.9 * static_cast<double>(sought.scores.size())), "scores lie between");
    check::equal(sought.num_network_matches, one.num_network_matches, "matches that the first network saw");
}

/// What mgca.h says of a pair is what filter.hpp says.
void c_agrees(const std::filesystem::path& file, const Model& model, const MatchPair& pair) {
    check::equal(static_cast<int>(Status::ok), static_cast<int>(MGCA_OK), "the first status");
    check::equal(static_cast<int>(Status::suspicious_intrinsics), static_cast<int>(MGCA_SUSPICIOUS_INTRINSICS),
                 "the last status");
    const Result expected = Filter(model)(pair);
    mgca_model* c_model = nullptr;
    mgca_filter* c_filter = nullptr;
    mgca_pair* c_pair = nullptr;
    mgca_result* result = nullptr;
    mgca_model_open(file.string().c_str(), 1, nullptr, &c_model);
    mgca_filter_create(c_model, &c_filter);
    mgca_pair_create(&c_pair);
    int image = 0;
    for (const Keypoints* keypoints : {&pair.keypoints1, &pair.keypoints2}) {
        mgca_pair_set_keypoints(c_pair, ++image, &keypoints->points[0].x, keypoints->sizes.data(),
                                keypoints->angles.data(), keypoints->points.size());
        mgca_pair_set_camera(c_pair, image, pair.camera1.K->val, nullptr, 0, 0.0, 0.0);
    }
    std::vector<std::int32_t> indices;
    for (std::size_t i = 0; i < pair.matches.index1.size(); ++i) {
        indices.insert(indices.end(), {pair.matches.index1[i], pair.matches.index2[i]});
    }
    mgca_pair_set_matches(c_pair, indices.data(), pair.matches.distances.data(), pair.matches.second_distances.data(),
                          pair.matches.index1.size());
    check::equal(mgca_filter_run(c_filter, c_pair, &result), static_cast<int>(MGCA_DONE), "a pair through C");
    const std::size_t count = mgca_result_size(result);
    check::that(std::vector<unsigned char>(mgca_result_mask(result), mgca_result_mask(result) + count) == expected.mask,
                "C: mask");
    check::that(std::vector<float>(mgca_result_scores(result), mgca_result_scores(result) + count) == expected.scores,
                "C: scores");
    check::that(cv::Matx33d(mgca_result_matrix(result, "R")) == *expected.R, "C: R");
    check::equal(mgca_result_number(result, "confidence"), expected.confidence.value_or(-1.0), "C: confidence");
    check::equal(mgca_result_verified(result), expected.verified() ? 1 : 0, "C: verified");
    check::equal(mgca_result_number(result, "focal_doubt"), expected.focal_doubt ? 1.0 : 0.0, "C: focal_doubt");
    check::that(std::isnan(mgca_result_number(result, "focal_sigma_deg")), "C: nothing is open where K is given");
    check::that(std::isnan(mgca_result_number(result, "fitted_confidence")), "C: so that nothing was taken off");
    mgca_result_free(result);
    mgca_pair_free(c_pair);
    mgca_filter_free(c_filter);
    mgca_model_close(c_model);
}

void words_are_read() {
    check::that(mgca::to_method("magsac") == mgca::Method::magsac, "method");
    check::that(mgca::to_effort("full") == mgca::Effort::full, "effort");
    check::that(mgca::to_geometry("homography") == mgca::Geometry::homography, "geometry");
    check::throws<ArgumentError>([] { mgca::to_method("poselib"); }, "expected one of auto, prosac, magsac");
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 4) {
        std::cerr << "usage: test_interface GOLDEN_FOLDER MODEL FIRST_LOOK\n";
        return 2;
    }
    const std::filesystem::path golden = argv[1], file = argv[2];
    const Model deep = Model::from_file(file), quick = Model::from_file(argv[3]);
    const Model model = deep.with_first_look(quick);
    const MatchPair pair = golden::read_input(golden, "wide");
    options_are_checked(model);
    model_files_are_checked(file);
    models_are_named(model);
    sums_are_checked(file, deep);
    inputs_are_checked(model, golden::read_input(golden, "general"));
    data_never_throws(model);
    options_are_felt(model, pair);
    cameras_are_felt(model, pair);
    threads_share_a_filter(model, pair);
    memory_and_file_agree(file, deep, pair);
    a_first_look_may_be_enough(deep, quick, golden);
    embedded_models_are_the_files(MGCA_TEST_EMBEDDED == 1 ? deep : model, pair);
    c_agrees(file, deep, pair);
    two_cameras_have_two_focal_lengths(model, golden::read_input(golden, "two_focal_lengths"));
    a_mirrored_image_is_told(model, golden::read_input(golden, "mirrored_plane"));
    words_are_read();
    return check::result("interface");
}
