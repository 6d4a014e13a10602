// Laws of the parts behind the public header.

#include "attributes.hpp"
#include "bayes_estimate.hpp"
#include "calibration.hpp"
#include "check.hpp"
#include "choice.hpp"
#include "degeneracy.hpp"
#include "estimators.hpp"
#include "evidence.hpp"
#include "focal_check.hpp"
#include "focal_estimate.hpp"
#include "focal_pair.hpp"
#include "homography.hpp"
#include "homography_fit.hpp"
#include "json.hpp"
#include "mirror.hpp"
#include "pose_refinement.hpp"
#include "robust_fit.hpp"
#include "scoring.hpp"
#include "sha256.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <random>
#include <stdexcept>

namespace {

using namespace mgca::detail;  // NOLINT: a test of what is in there

constexpr double kFocal = 800.0;

/// Matches of random points at depths of 4 to 11, with noise, all within the view of both cameras.
Correspondences draw_matches(const Pose& pose, int count, double noise_px, unsigned seed) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> x(-0.4, 0.4), depth(4.0, 11.0);
    std::normal_distribution<double> noise(0.0, noise_px / kFocal);
    Correspondences matches;
    for (int i = 0; i < count; ++i) {
        const cv::Vec3d point = depth(random) * cv::Vec3d(x(random), x(random), 1.0);
        const cv::Vec3d second = pose.R * point + pose.t;
        matches.emplace_back(point[0] / point[2] + noise(random), point[1] / point[2] + noise(random),
                             second[0] / second[2] + noise(random), second[1] / second[2] + noise(random));
    }
    return matches;
}

Correspondences draw_wrong(int count, unsigned seed) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> x(-0.4, 0.4);
    Correspondences matches;
    for (int i = 0; i < count; ++i) {
        matches.emplace_back(x(random), x(random), x(random), x(random));
    }
    return matches;
}

const Pose kPose{rotation_from_vector({0.05, -0.12, 0.03}), cv::normalize(cv::Vec3d(1.0, 0.2, 0.1))};

/// The examples of FIPS 180-2, and lengths at which the padding takes a block of its own.
void digests_are_those_of_the_standard() {
    check::equal(mgca::detail::sha256(""),
                 std::string("e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"), "sha256");
    check::equal(mgca::detail::sha256("abc"),
                 std::string("ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"), "sha256");
    check::equal(mgca::detail::sha256("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq"),
                 std::string("248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1"), "sha256");
    check::equal(mgca::detail::sha256(std::string(64, 'a')),
                 std::string("ffe054fe7ae0cb6dc65c3af9b61d5209f439851db43d0ba5997337df154668eb"), "a block");
    check::equal(mgca::detail::sha256(std::string(200, 'a')),
                 std::string("c2a908d98f5df987ade41b5fce213067efbcc21ef2240212a41e54b5e7c28ae5"), "blocks");
}

void json_is_read() {
    const Json value = Json::parse(R"( {"a": [1, -2.5e-3, 1e+2], "b": {"c": "x\u00e9\n\"", "d": null}, "e": true} )");
    check::that(value["a"].numbers() == std::vector<double>{1.0, -2.5e-3, 100.0}, "numbers");
    check::equal(value["b"]["c"].text(), std::string("x\xc3\xa9\n\""), "escapes");
    check::that(!value["b"].has("d") && value["b"]["d"].is_null() && value["e"].boolean(), "null and true");
    for (const char* text : {"", "{", "[1,]", "[1 2]", "{\"a\"}", "nul", "\"\\x\"", "1e999", "[1]x", "\"\\u12\"", "nan",
                             "{\"a\":1,}", "-", "\"abc"}) {
        check::throws<std::invalid_argument>([&] { Json::parse(text); }, "");
    }
    check::throws<std::invalid_argument>([] { Json::parse(std::string(1000, '[')); }, "nested too deeply");
    check::throws<std::invalid_argument>([&] { value["z"].number(); }, "z is missing");
    check::throws<std::invalid_argument>([&] { value["e"].number(); }, "expected a number");
}

void exact_matches_have_no_residual() {
    const cv::Matx33d E = essential_from_pose(kPose);
    check::near(cv::norm(E), 1.0, 1e-12, "unit norm");
    for (const Correspondence& match : draw_matches(kPose, 50, 0.0, 1)) {
        check::near(sampson_distance(match, E), 0.0, 1e-12, "Sampson distance of an exact match");
        const Correspondence swapped(match[2], match[3], match[0], match[1]);
        check::near(sampson_distance(swapped, E.t()), 0.0, 1e-12, "swapped images transpose E");
    }
    const auto pose = pose_from_essential(E, draw_matches(kPose, 50, 0.1, 2), kFocal);
    check::near(pose_angle_deg(*pose, kPose), 0.0, 1e-5, "the pose comes back from E");
    check::near(cv::norm(pose->t - kPose.t), 0.0, 1e-9, "with the sign of t");
    check::that(!pose_from_essential(cv::Matx33d::zeros(), draw_matches(kPose, 50, 0.1, 2), kFocal), "zero is no E");
}

void refinement_finds_the_pose_and_never_raises_the_cost() {
    for (unsigned seed = 0; seed < 5; ++seed) {
        Correspondences matches = draw_matches(kPose, 200, 0.3, seed);
        const Correspondences wrong = draw_wrong(100, seed + 50);
        matches.insert(matches.end(), wrong.begin(), wrong.end());
        std::mt19937 random(seed);
        std::normal_distribution<double> small(0.0, 0.002);
        const Pose start{rotation_from_vector({small(random), small(random), small(random)}) * kPose.R,
                         cv::normalize(kPose.t + cv::Vec3d(small(random), small(random), small(random)))};
        const double threshold = 2.0 / kFocal;
        const Pose refined = refine_pose(matches, start, threshold);
        check::that(truncated_cost(matches, refined, threshold) <= truncated_cost(matches, start, threshold), "cost");
        check::near(pose_angle_deg(refined, kPose), 0.0, 0.5, "refined pose");
        check::near(cv::norm(refined.R * refined.R.t() - cv::Matx33d::eye()), 0.0, 1e-9, "a rotation");
    }
    const Pose untouched = refine_pose(draw_matches(kPose, 5, 0.3, 0), kPose, 1.0 / kFocal);
    check::near(cv::norm(untouched.R - kPose.R), 0.0, 0.0, "five matches refine nothing");
    const double firm = pose_uncertainty_deg(draw_matches(kPose, 400, 0.3, 3), kPose, 0.5 / kFocal);
    const double loose = pose_uncertainty_deg(draw_matches(kPose, 100, 0.3, 3), kPose, 0.5 / kFocal);
    check::that(firm < loose && loose < 10.0, "more matches hold the pose more firmly");
    check::near(pose_uncertainty_deg({}, kPose, 1e-3), 90.0, 0.0, "nothing holds a pose of no matches");
}

void firm_matches_hold_the_pose() {
    double by_noise = 0.0, alike = 0.0;
    for (unsigned seed = 0; seed < 8; ++seed) {
        Correspondences matches = draw_matches(kPose, 60, 0.1, seed);
        const Correspondences coarse = draw_matches(kPose, 120, 0.8, seed + 20);
        matches.insert(matches.end(), coarse.begin(), coarse.end());
        std::vector<double> scale(180, 0.5 / kFocal), weights(180, 1.0);
        const double reach = 6.0 / kFocal;
        alike += pose_angle_deg(refine_pose_by_weights(matches, kPose, scale, weights, reach), kPose);
        std::fill(scale.begin(), scale.begin() + 60, 0.1 / kFocal);
        std::fill(scale.begin() + 60, scale.end(), 0.8 / kFocal);
        by_noise += pose_angle_deg(refine_pose_by_weights(matches, kPose, scale, weights, reach), kPose);
        std::fill(weights.begin() + 60, weights.end(), 1e-9);
        const Pose firm = refine_pose_by_weights(matches, kPose, scale, weights, reach);
        const std::vector<double> of_firm(scale.begin(), scale.begin() + 60), ones(60, 1.0);
        const Correspondences firm_matches(matches.begin(), matches.begin() + 60);
        const Pose alone = refine_pose_by_weights(firm_matches, kPose, of_firm, ones, reach);
        check::near(pose_angle_deg(firm, alone), 0.0, 1e-3, "what weighs nothing is not felt");
    }
    check::that(by_noise < 0.7 * alike, "matches count by their noise");
    const Correspondences few = draw_matches(kPose, 5, 0.3, 0);
    const std::vector<double> ones(5, 1.0);
    check::near(cv::norm(refine_pose_by_weights(few, kPose, ones, ones, 1.0).R - kPose.R), 0.0, 0.0,
                "five matches refine nothing");
}

void noise_follows_the_size_of_keypoints() {
    const float unknown = std::numeric_limits<float>::quiet_NaN();
    mgca::Attributes known;
    known.size1 = {2, 2, 2, 4, 100, unknown, 0, 900};
    known.size2 = {2, 2, 2, 4, 100, 2, 2, 900};
    const std::vector<double> noise = relative_noise(known, {1, 1, 1, 1, 1, 1, 1, 0});
    const std::vector<double> expected{1, 1, 1, std::pow(2.0, 0.75), 3, 1, 1, 3};
    for (std::size_t i = 0; i < noise.size(); ++i) {
        check::near(noise[i], expected[i], 1e-12, "noise by size, between its limits");
    }
    known.size2.clear();
    check::that(relative_noise(known, Mask(8, 1)) == std::vector<double>(8, 1.0), "unknown sizes");
}

void repetitions_count_once() {
    const Correspondences matches{{3, 0, 0, 0}, {1, 2, 3, 4}, {3, 0, 0, 0}, {1, 2, 9, 9}, {5, 5, 3, 4}, {7, 7, 8, 8}};
    check::that(distinct_rows(matches) == Rows{0, 1, 3, 4, 5}, "distinct rows, the first of equals");
    const Correspondences distinct{{1, 2, 3, 4}, {1, 2, 9, 9}, {5, 5, 3, 4}, {7, 7, 8, 8}};
    check::that(one_to_one(distinct) == Mask{1, 0, 0, 1}, "a keypoint counts in its best match");
}

void raw_lists_are_told_from_filtered_ones() {
    std::vector<EncodedAttributes> attributes(20, EncodedAttributes{0.5F, 1.0F, 0, 0, 0, 1.0F, 1.0F, 0});
    attributes[3][kRatio] = 0.95F;
    const Mask valid(20, 1);
    check::that(listed_rows(attributes, valid) == valid, "all of a filtered list counts");
    attributes[7][kBest] = 0.0F;
    Mask expected = valid;
    expected[3] = expected[7] = 0;
    check::that(listed_rows(attributes, valid) == expected, "of a raw list the best with a clear ratio");
}

void evidence_is_taken_from_above_a_margin() {
    Evidence evidence;
    evidence.correspondences = draw_wrong(60, 1);
    evidence.rows.resize(60);
    std::iota(evidence.rows.begin(), evidence.rows.end(), std::size_t{0});
    evidence.once.assign(60, 1);
    evidence.listed.assign(60, 0);
    evidence.listed[4] = evidence.listed[2] = 1;
    evidence.order.assign(60, std::numeric_limits<double>::quiet_NaN());
    evidence.order[4] = 0.1;
    check::that(evidence.accepted() == Rows{2, 4}, "before the network the listed ones are accepted");
    check::that(evidence.by_list_order()[0] == evidence.correspondences[4], "what is known comes first");
    evidence.network.emplace();
    for (int i = 0; i < 60; ++i) {
        evidence.network->scores.push_back(i < 40 ? 0.9 : 0.1);
        evidence.network->margins.push_back(2.0 - 0.1 * i);
    }
    check::equal(evidence.accepted().size(), std::size_t{40}, "accepted by score");
    check::equal(evidence.above(-1.05).size(), std::size_t{31 + 1}, "fewer than 32 give way to the best 32");
    check::equal(evidence.above(-2.05).size(), std::size_t{41}, "above a margin");
}

void a_line_a_rotation_and_a_plane_are_recognised() {
    std::vector<cv::Point2d> points;
    for (int i = 0; i < 50; ++i) {
        points.emplace_back(0.01 * i, 0.005 * i + (i % 10 == 0 ? 0.2 : 0.0));
    }
    const std::vector<double> distances = line_distances(points, 1e-3);
    check::that(std::count_if(distances.begin(), distances.end(), [](double d) { return d < 1e-3; }) == 45, "a line");
    const Pose turn{kPose.R, {0.0, 0.0, 0.0}};
    const Correspondences turned = draw_matches(turn, 100, 0.0, 4);
    check::near(cv::norm(fit_rotation(turned, 1e-3) - kPose.R), 0.0, 1e-9, "a rotation");
    Correspondences plane;
    for (const Correspondence& match : draw_matches(kPose, 100, 0.0, 5)) {
        const cv::Vec3d second = kPose.R * (5.0 * ray1(match)) + kPose.t;
        plane.emplace_back(match[0], match[1], second[0] / second[2], second[1] / second[2]);
    }
    const auto H = fit_homography(plane, 2.0 / kFocal, 0);
    if (check::that(H.has_value(), "a homography of a plane")) {
        const std::vector<double> errors = homography_distances(plane, *H);
        check::near(*std::max_element(errors.begin(), errors.end()), 0.0, 1e-6, "which explains all of it");
        double closest = 180.0;
        for (const Pose& pose : poses_from_homography(*H)) {
            closest = std::min(closest, pose_angle_deg(pose, kPose));
        }
        check::near(closest, 0.0, 0.01, "and allows the true pose");
    }
}

void chance_is_told_from_support() {
    const cv::Matx33d E = essential_from_pose(kPose);
    Correspondences matches = draw_matches(kPose, 60, 0.3, 6);
    const Correspondences wrong = draw_wrong(200, 7);
    const Support chance = measure_support(wrong, E, 1.0 / kFocal);
    matches.insert(matches.end(), wrong.begin(), wrong.end());
    const Support support = measure_support(matches, E, 1.0 / kFocal);
    check::that(support.log10_nfa < -20.0 && chance.log10_nfa > kUnrelatedLog10Nfa, "number of false alarms");
    check::that(std::isinf(log10_false_alarms(100, 5, 0.01)), "five matches prove nothing");
}

void a_wrong_focal_length_is_noticed() {
    const Pose skew{rotation_from_vector({0.05, -0.3, 0.03}), cv::normalize(cv::Vec3d(1.0, 0.6, 0.5))};
    const Correspondences right = draw_matches(skew, 300, 0.2, 8);
    check::that(!better_focal_factor(right, skew, 1.0 / kFocal).has_value(), "the right focal length will do");
    Correspondences zoomed;
    for (const Correspondence& match : right) {
        zoomed.push_back(match * 1.5);  // as if the focal length were two thirds of what it is
    }
    const double focal = kFocal / 1.5;
    EstimatorOptions options;
    options.threshold_px = 1.0;
    const auto E = fit_epipolar(zoomed, focal, options, true);
    const Pose pose = refine_pose(zoomed, *pose_from_essential(*E, zoomed, focal), 1.0 / focal);
    const auto factor = better_focal_factor(zoomed, pose, 1.0 / focal);
    check::that(factor.has_value(), "two thirds of it will not");
    check::near(factor.value_or(0.0), 1.5, 0.3, "and the factor is about one and a half");
}

/// Matches as they look under a guess of which the true focal lengths are these factors.
Correspondences seen_under(const Correspondences& matches, double factor1, double factor2) {
    Correspondences seen;
    for (const Correspondence& match : matches) {
        seen.emplace_back(match[0] * factor1, match[1] * factor1, match[2] * factor2, match[3] * factor2);
    }
    return seen;
}

void a_pose_is_no_surer_than_its_focal_lengths() {
    for (const double fitted : {0.0, 0.3, 0.9, 1.0}) {
        double before = fitted;
        for (const double sigma_deg : {0.05, 1.0, 5.0, 30.0, 180.0}) {
            const double confidence = confidence_under_estimate(fitted, sigma_deg);
            check::that(0.0 <= confidence && confidence <= before, "never above the fit's, and falling");
            before = confidence;
        }
    }
    check::that(confidence_under_estimate(0.95, 1.0) > 0.85 && confidence_under_estimate(0.95, 10.0) < 0.6,
                "a degree does no harm, ten do");
    const Pose skew{rotation_from_vector({0.05, -0.12, 0.03}), cv::normalize(cv::Vec3d(1.0, 0.6, 0.5))};
    const Correspondences rows = draw_matches(skew, 300, 0.0, 21);
    const cv::Matx<double, 5, 2> derivative = FocalPairFit(rows, 1e9, 1.0, {0.0, 1.0}).pose_derivative(skew);
    constexpr double kStep = 1e-3;
    const Pose refined = refine_pose(seen_under(rows, 1.0, std::exp(-kStep)), skew, 0.1);
    const cv::Matx33d turn = refined.R * skew.R.t();
    const cv::Vec3d turned(turn(2, 1) - turn(1, 2), turn(0, 2) - turn(2, 0), turn(1, 0) - turn(0, 1));
    for (int i = 0; i < 3; ++i) {
        check::near(0.5 * turned[i] / kStep, derivative(i, 1), 0.05, "the pose moves as the derivative says");
    }
}

void two_focal_lengths_are_found_where_they_differ() {
    const Pose skew{rotation_from_vector({0.05, -0.12, 0.03}), cv::normalize(cv::Vec3d(1.0, 0.6, 0.5))};
    const FocalBelief belief{-0.3, 0.35};
    const auto found = [&](const Correspondences& rows, const Pose& pose, double start, double noise_px) {
        return FocalPairFit(rows, 2.0 / kFocal, noise_px / kFocal, belief).differing(pose, start).first;
    };
    for (const double zoom : {0.5, 0.75, 1.3, 2.0}) {
        const double start = std::log(0.8 * std::sqrt(zoom));
        const Correspondences rows = seen_under(draw_matches(skew, 300, 0.02, 21), 0.8, 0.8 * zoom);
        Correspondences swapped;
        for (const Correspondence& row : rows) {
            swapped.emplace_back(row[2], row[3], row[0], row[1]);
        }
        const auto both = found(rows, skew, start, 0.1);
        const auto other = found(swapped, {skew.R.t(), -(skew.R.t() * skew.t)}, start, 0.1);
        if (check::that(both && other, "two focal lengths, whichever image comes first")) {
            check::near(both->logs[0], std::log(0.8), 0.05, "that of image 1");
            check::near(both->logs[1], std::log(0.8 * zoom), 0.05, "that of image 2");
            check::near(both->logs[1] - both->logs[0], std::log(zoom), 0.02, "their ratio");
            check::that(both->ratio_sigma < both->sigmas[0] + both->sigmas[1], "which is known better");
            check::near(other->logs[0], both->logs[1], 0.02, "swapped images swap them");
        }
    }
    const auto spread = [&](double noise_px) {
        const Correspondences rows = seen_under(draw_matches(skew, 300, noise_px, 21), 0.8, 1.6);
        const auto both = found(rows, skew, std::log(0.8 * std::sqrt(2.0)), noise_px);
        return check::that(both.has_value(), "two focal lengths in spite of noise") ? both->sigmas : cv::Vec2d();
    };
    check::that(spread(0.1)[0] > 0.0 && 1.5 * spread(0.1)[0] < spread(0.3)[0], "their spread grows with the noise");
    for (unsigned seed = 0; seed < 3; ++seed) {
        check::that(!found(seen_under(draw_matches(skew, 300, 0.3, seed), 0.8, 0.8), skew, std::log(0.8), 0.3),
                    "one camera has one focal length");
    }
    const Correspondences turned = draw_matches({skew.R, {0.0, 0.0, 0.0}}, 200, 0.3, 22);
    check::that(!found(turned, {skew.R, {1.0, 0.0, 0.0}}, 0.0, 0.3), "a rotation tells no zoom");
    check::that(!found({}, skew, 0.0, 0.3), "nothing tells nothing");
}

void mirrors_are_told_and_mapped_where_that_is_allowed() {
    Correspondences matches, mirrored;
    for (const Correspondence& match : draw_matches({kPose.R, {0.0, 0.0, 0.0}}, 100, 0.0, 23)) {
        const Correspondence pixels = kFocal * match;
        matches.push_back(pixels);
        mirrored.emplace_back(pixels[0], pixels[1], -pixels[2], pixels[3]);
    }
    check::near(share_of_turned_triangles(matches), 0.0, 0.0, "no triangle turns");
    check::near(share_of_turned_triangles(mirrored), 1.0, 0.0, "in a mirror all do");
    check::near(share_of_turned_triangles({{1, 2, 3, 4}}), 0.0, 0.0, "one match is no triangle");
    HomographyOptions options;
    const auto within = [&](const std::optional<cv::Matx33d>& H) {
        const std::vector<double> distances = H ? sampson_distances_to_homography(mirrored, *H) : std::vector<double>{};
        return std::count_if(distances.begin(), distances.end(), [](double distance) { return distance < 0.1; });
    };
    check::that(within(estimate_homography(mirrored, options, {})) < 20, "a plane does not mirror");
    options.reflection = true;
    const auto H = estimate_homography(mirrored, options, {});
    check::equal(within(H), std::ptrdiff_t{100}, "where it may, all agree");
    check::that(H && cv::determinant(*H) < 0.0, "with a map that mirrors");
    check::equal(within(estimate_homography(matches, options, {})), std::ptrdiff_t{0}, "and nothing is made to mirror");
}

void a_loose_direction_has_a_wide_spread() {
    const auto spread = [](double baseline, double noise_px) {
        const Pose pose{kPose.R, baseline * kPose.t};
        return direction_uncertainty_deg(draw_matches(pose, 300, 0.0, 24), kPose, noise_px / kFocal);
    };
    check::that(spread(1.0, 0.05) < 0.1, "a long baseline holds the direction");
    check::near(spread(1.0, 0.05) / spread(1.0, 0.025), 2.0, 1e-6, "in proportion to the noise");
    double before = 0.0;
    for (const double baseline : {1.0, 0.3, 0.1, 0.03, 0.01, 0.001}) {
        const double now = spread(baseline, 0.5);
        check::that(before < now && now < 90.0, "the shorter the baseline, the wider");
        before = now;
    }
    check::that(before > 30.0, "next to no baseline says next to nothing");
    check::near(direction_uncertainty_deg({}, kPose, 1e-3), 90.0, 0.0, "nothing says nothing");
}

Coefficients coefficients() {
    return Coefficients::read(Json::parse(R"({
        "score_trust": [0.8, 0.5, 0.05], "noise_px": [0.25, 0.6, 1.5], "noise_weights": [0.4, 0.4, 0.2],
        "noise_scales": [1.0, 1.7], "outlier_width_px": [300], "seen_behind": [0.02],
        "support_weight": [0.1], "crowding": [0.15, 0.5], "early_end": [0.5, 50, 0.03, 0.5, 20],
        "settled": [1, 0.95, 0.05], "verdict": [0.1, 0.5],
        "confidence": [1,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0], "early_confidence": [0,0,0,0,0,0,1]})"));
}

void the_likelier_hypothesis_is_chosen() {
    Correspondences matches = draw_matches(kPose, 80, 0.3, 9);
    const Correspondences wrong = draw_wrong(80, 10);
    matches.insert(matches.end(), wrong.begin(), wrong.end());
    std::vector<double> scores(160, 0.1);
    std::fill(scores.begin(), scores.begin() + 80, 0.9);
    const Pose other{rotation_from_vector({0.3, 0.0, 0.1}), {0.0, 0.0, 1.0}};
    const std::vector<Hypothesis> hypotheses{{other, Family::network}, {kPose, Family::accepted}};
    Coefficients c = coefficients();
    const Judgement judged = judge_hypotheses(matches, scores, hypotheses, kFocal, {}, c);
    check::equal(judged.chosen, std::size_t{1}, "the true pose");
    check::that(judged[Feature::likelihood_to_alternative] > 3.0, "far from its alternative");
    check::near(judged[Feature::no_network], 1.0, 0.0, "no network E");
    check::equal(judge_hypotheses(matches, std::nullopt, hypotheses, kFocal, {}, c).chosen, std::size_t{1},
                 "without scores as well");
    // Confidence is the logistic function of the weighted features.
    check::near(confidence(judged, c), 1.0 / (1.0 + std::exp(-judged[Feature::log_count])), 1e-12, "confidence");
    check::near(early_confidence(judged, c), 1.0 / (1.0 + std::exp(-1.0)), 1e-12, "early confidence");
    c.support_weight = {-1e3};  // relative support against itself: the worst supported one wins
    check::equal(judge_hypotheses(matches, scores, hypotheses, kFocal, {}, c).chosen, std::size_t{0},
                 "support_weight is felt");
    check::throws<std::invalid_argument>([] { Coefficients::read(Json::parse("{}")); }, "score_trust is missing");
    check::throws<std::invalid_argument>([] { Coefficients::read(Json::parse(R"({"score_trust": [1]})")); },
                                         "score_trust: expected 3");
}

void the_expected_best_lies_among_what_the_matches_hold() {
    const Coefficients c = coefficients();
    Correspondences matches = draw_matches(kPose, 60, 0.3, 9);
    const Correspondences wrong = draw_wrong(30, 10);
    matches.insert(matches.end(), wrong.begin(), wrong.end());
    std::vector<double> scores(90, 0.05);
    std::fill(scores.begin(), scores.begin() + 60, 0.9);
    const Pose refined = refine_pose(matches, kPose, 1.0 / kFocal);
    const Pose other{rotation_from_vector({0.3, 0.0, 0.1}), {0.0, 0.0, 1.0}};
    const auto answer = expected_best(matches, scores, {other, refined}, 1.0, kFocal, c);
    if (check::that(answer.has_value(), "an expected best")) {
        check::near(pose_angle_deg(*answer, refined), 0.0, 0.5, "the one that the matches hold");
        check::near(cv::norm(answer->R * answer->R.t() - cv::Matx33d::eye()), 0.0, 1e-9, "a rotation");
        check::near(cv::norm(answer->t), 1.0, 1e-12, "a direction");
        const auto again = expected_best(matches, scores, {refined, other}, 1.0, kFocal, c);
        check::near(pose_angle_deg(*answer, again.value_or(other)), 0.0, 1e-6, "whatever the order");
    }
    check::that(!expected_best(draw_wrong(40, 1), std::vector<double>(40, 0.5), {other}, 1.0, kFocal, c),
                "nothing where the matches hold nothing");
}

void residuals_become_scores() {
    const Correspondences matches = draw_matches(kPose, 60, 0.3, 11);
    Correspondences all = matches;
    const Correspondences wrong = draw_wrong(60, 12);
    all.insert(all.end(), wrong.begin(), wrong.end());
    const Residuals residuals = measure_residuals(all, kPose, kFocal);
    const std::vector<double> scores = posterior(residuals, {Mask(120, 1)}, 1.0, coefficients());
    const double right = std::accumulate(scores.begin(), scores.begin() + 60, 0.0) / 60.0;
    const double mistaken = std::accumulate(scores.begin() + 60, scores.end(), 0.0) / 60.0;
    check::that(right > 0.9 && mistaken < 0.1, "right matches score high, wrong ones low");
}

void probabilities_and_logits_are_inverse() {
    const Calibration calibration{0.934, -1.33};
    for (const float logit : {-8.0F, -1.0F, 0.0F, 2.5F, 7.0F}) {
        check::near(calibration.logit(calibration.probability(logit)), logit, 1e-2, "logit of a probability");
    }
    check::that(largest_set_of_precision({0.9F, 0.2F, 0.8F, 0.8F, 0.99F}, {1, 1, 1, 1, 0}, 0.83) ==
                    std::vector<unsigned char>{1, 0, 1, 1, 0},
                "the largest set of a precision, equals together, the invalid left out");
    check::that(largest_set_of_precision({0.1F}, {1}, 0.5) == std::vector<unsigned char>{0}, "none reaches it");
    check::near(distance_ratio(1.0, 0.0), 1.0, 0.0, "two candidates at distance zero");
    check::that(!best_of_list({0, 1}, {1.0, 1.0}).has_value(), "equal distances say nothing");
    check::that(best_of_list({0, 0, 1, -1}, {1.0, 2.0, 3.0, NAN}) == std::vector<unsigned char>{1, 0, 1, 0},
                "best of the list");
}

void networks_are_heard_alike() {
    ModelMetadata metadata;
    metadata.calibration = {2.0, 1.0};
    metadata.decision_threshold = 0.5;
    const Opinion first = Opinion::of({4.0F, -2.0F, -8.0F}, metadata);
    check::that(first.margins == std::vector<float>{3.5F, -2.5F, -8.5F}, "margins");
    check::that(first.log_odds == std::vector<float>{9.0F, -3.0F, -15.0F}, "log-odds");
    check::near(sigmoid(first.log_odds[1]), metadata.calibration.probability(-2.0F), 0.0, "scores are the odds'");
    const Opinion before = Opinion::mean({first, Opinion::of({0.0F, 0.0F, 0.0F}, metadata)});
    check::near(before.margins[0], 0.5 * (first.margins[0] - metadata.decision_threshold), 1e-6, "the mean of the priors");
    check::equal(before.networks, 0, "of which none was asked");
    check::near(before.joined(first, {0}).margins[0], first.margins[0], 0.0, "and counts no more where one was");
    const Opinion second = Opinion::of({1.0F, 1.0F}, metadata), third = Opinion::of({4.0F, 7.0F}, metadata);
    const Opinion two = first.joined(second, {0, 1}), three = two.joined(third, {0, 1});
    check::that(two.log_odds == std::vector<float>{6.0F, 0.0F, -15.0F}, "the mean, where both saw the match");
    check::that(two.margins == std::vector<float>{2.0F, -1.0F, -8.5F} && two.networks == 2, "of the margins likewise");
    check::that(three.log_odds == std::vector<float>{7.0F, 5.0F, -15.0F}, "a third counts a third");

    Opinion opinion;
    Rows rows;
    for (std::size_t i = 0; i < 300; ++i) {
        opinion.log_odds.push_back(i < 200 && i % 2 == 0 ? 1.0F : -9.0F - static_cast<float>(i) * 1e-2F);
        rows.push_back(i);
    }
    const Rows likely = opinion.undecided(rows), few = opinion.undecided(Rows(rows.begin() + 150, rows.end()));
    check::that(likely.size() == 100 && std::all_of(likely.begin(), likely.end(),
                                                    [](std::size_t i) { return i < 200 && i % 2 == 0; }),
                "what is hopeless is left out");
    check::that(few.size() == kFewestUndecided && few.front() == 150 && std::is_sorted(few.begin(), few.end()),
                "of few likely ones the best are taken in any case");
    check::that(opinion.undecided({7, 9}) == Rows({7, 9}) && opinion.undecided({}).empty(), "or all");
}

void guessed_and_seeded_estimators_answer() {
    Correspondences matches = draw_matches(kPose, 120, 0.2, 13);
    for (const Estimator method : {Estimator::prosac, Estimator::magsac, Estimator::ransac}) {
        for (const bool calibrated : {true, false}) {
            EstimatorOptions options;
            options.method = method;
            options.seed = 3;
            const auto M = fit_epipolar(matches, kFocal, options, calibrated);
            if (check::that(M.has_value(), "an estimator finds the model")) {
                check::near(cv::norm(*M), 1.0, 1e-12, "of unit norm");
                const std::vector<double> distances = sampson_distances(matches, *M);
                const auto near = std::count_if(distances.begin(), distances.end(),
                                                [](double distance) { return distance < 1.0 / kFocal; });
                check::that(near > 100, "that nearly all agree with");
            }
        }
    }
}

}  // namespace

int main() {
    digests_are_those_of_the_standard();
    json_is_read();
    exact_matches_have_no_residual();
    refinement_finds_the_pose_and_never_raises_the_cost();
    firm_matches_hold_the_pose();
    noise_follows_the_size_of_keypoints();
    repetitions_count_once();
    raw_lists_are_told_from_filtered_ones();
    evidence_is_taken_from_above_a_margin();
    a_line_a_rotation_and_a_plane_are_recognised();
    chance_is_told_from_support();
    a_wrong_focal_length_is_noticed();
    a_pose_is_no_surer_than_its_focal_lengths();
    two_focal_lengths_are_found_where_they_differ();
    mirrors_are_told_and_mapped_where_that_is_allowed();
    a_loose_direction_has_a_wide_spread();
    the_likelier_hypothesis_is_chosen();
    the_expected_best_lies_among_what_the_matches_hold();
    residuals_become_scores();
    probabilities_and_logits_are_inverse();
    networks_are_heard_alike();
    guessed_and_seeded_estimators_answer();
    return check::result("parts");
}
