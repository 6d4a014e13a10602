// The library gives the answers of Python on the golden pairs.
//
// With the OpenCV version that the goldens were written with: the same mask. Versions draw other samples, and the choice
// and the refinement bring the answers together again: then the intersection over union of the masks is at least 0.98 and
// the pose within 0.1 degrees.

#include "check.hpp"
#include "golden_files.hpp"

#include <algorithm>
#include <iomanip>

namespace {

using mgca::detail::Json;

constexpr double kPoseDeg = 0.1, kIou = 0.98;

double degrees(double radians) { return radians * 180.0 / CV_PI; }

double rotation_error_deg(const cv::Matx33d& a, const cv::Matx33d& b) {
    return degrees(2.0 * std::asin(std::min(1.0, cv::norm(a - b) / (2.0 * std::sqrt(2.0)))));
}

double direction_error_deg(const cv::Vec3d& a, const cv::Vec3d& b) {
    return degrees(std::atan2(cv::norm(a.cross(b)), a.dot(b)));
}

/// Matrices without a sign: E and F.
double matrix_error(const cv::Matx33d& a, const cv::Matx33d& b) { return std::min(cv::norm(a - b), cv::norm(a + b)); }

void compare_scores(const golden::Case& golden, const mgca::Result& result, bool same) {
    const std::vector<double> scores = golden.expected["scores"].numbers(), logits = golden.expected["logits"].numbers();
    if (!check::equal(result.scores.size(), scores.size(), golden.name + ": number of scores")) {
        return;
    }
    const bool by_network = golden.expected["num_network_matches"].number() > 0.0;
    double worst = 0.0, sum = 0.0, worst_logit = 0.0;
    for (std::size_t i = 0; i < scores.size(); ++i) {
        const double difference = std::abs(static_cast<double>(result.scores[i]) - scores[i]);
        worst = std::max(worst, difference);
        sum += difference;
        worst_logit = std::max(worst_logit, std::abs(static_cast<double>(result.logits[i]) - logits[i]));
    }
    if (by_network || same) {
        check::near(worst, 0.0, 1e-3, golden.name + ": scores");
        check::near(worst_logit, 0.0, by_network ? 5e-3 : 5e-2, golden.name + ": logits");
    } else if (!scores.empty()) {
        // From the residuals of a pose that another version of OpenCV moved a little.
        check::near(sum / static_cast<double>(scores.size()), 0.0, 0.02, golden.name + ": mean difference of scores");
    }
}

void compare_mask(const golden::Case& golden, const mgca::Result& result, bool same) {
    const std::string& mask = golden.expected["mask"].text();
    if (!check::equal(result.mask.size(), mask.size(), golden.name + ": length of the mask")) {
        return;
    }
    int both = 0, either = 0;
    for (std::size_t i = 0; i < mask.size(); ++i) {
        both += result.mask[i] != 0 && mask[i] == '1' ? 1 : 0;
        either += result.mask[i] != 0 || mask[i] == '1' ? 1 : 0;
    }
    const double iou = either == 0 ? 1.0 : static_cast<double>(both) / either;
    // One match of a small mask may stand on the very threshold.
    const double least = same ? 1.0 : std::min(kIou, 1.0 - 1.5 / std::max(either, 1));
    check::that(iou >= least, golden.name + ": intersection over union of the masks is " + std::to_string(iou));
    check::equal(result.num_inliers, static_cast<int>(std::count(result.mask.begin(), result.mask.end(), 1)),
                 golden.name + ": num_inliers");
}

void compare_geometry(const golden::Case& golden, const mgca::Result& result) {
    const Json& expected = golden.expected;
    const auto there = [&](const char* name, bool given) {
        return check::equal(given, expected.has(name), golden.name + ": " + name + " is given") && given;
    };
    const double radians = kPoseDeg * CV_PI / 180.0;
    if (there("R", result.R.has_value())) {
        check::near(rotation_error_deg(*result.R, golden::matrix(expected["R"])), 0.0, kPoseDeg, golden.name + ": R");
    }
    if (there("t", result.t.has_value())) {
        const std::vector<double> t = expected["t"].numbers();
        const double error = direction_error_deg(*result.t, {t[0], t[1], t[2]});
        // A guessed focal length has no pose to speak of.
        check::near(error, 0.0, result.intrinsics_guessed ? 3.0 : kPoseDeg, golden.name + ": t");
    }
    if (there("E", result.E.has_value())) {
        check::near(matrix_error(*result.E, golden::matrix(expected["E"])), 0.0,
                    result.intrinsics_guessed ? 0.05 : radians, golden.name + ": E");
    }
    if (there("F", result.F.has_value())) {
        check::near(matrix_error(*result.F, golden::matrix(expected["F"])), 0.0, 0.02, golden.name + ": F");
    }
    if (there("H", result.H.has_value())) {
        const cv::Matx33d H = golden::matrix(expected["H"]);
        check::near(cv::norm(*result.H - H) / cv::norm(H), 0.0, 0.01, golden.name + ": H");
    }
}

void compare(const golden::Case& golden, const mgca::Result& result) {
    const Json& expected = golden.expected;
    const bool same = expected["opencv"].text() == CV_VERSION;
    check::equal(std::string(mgca::to_string(result.status)), expected["status"].text(), golden.name + ": status");
    check::equal(result.num_network_matches, static_cast<int>(expected["num_network_matches"].number()),
                 golden.name + ": num_network_matches");
    check::equal(result.intrinsics_guessed, expected["intrinsics"].text() == "guessed", golden.name + ": intrinsics");
    check::equal(result.assumptions.size(), expected["assumptions"].items().size(), golden.name + ": assumptions");
    for (std::size_t i = 0; i < std::min(result.assumptions.size(), expected["assumptions"].items().size()); ++i) {
        check::equal(result.assumptions[i], expected["assumptions"].items()[i].text(), golden.name + ": assumption");
    }
    if (check::equal(result.confidence.has_value(), expected.has("confidence"), golden.name + ": has a confidence") &&
        result.confidence) {
        check::near(*result.confidence, expected["confidence"].number(), same ? 2e-3 : 0.1,
                    golden.name + ": confidence");
    }
    check::equal(result.focal_factor.has_value(), expected.has("focal_factor"), golden.name + ": has a focal factor");
    if (result.focal_factor && expected.has("focal_factor")) {
        check::near(*result.focal_factor, expected["focal_factor"].number(), 1e-6, golden.name + ": focal factor");
    }
    if (expected.has("origin") && same) {
        check::equal(result.origin, expected["origin"].text(), golden.name + ": origin");
        check::equal(result.ended, expected["ended"].text(), golden.name + ": ended");
    }
    compare_scores(golden, result, same);
    compare_mask(golden, result, same);
    compare_geometry(golden, result);
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 3) {
        std::cerr << "usage: test_golden FOLDER MODEL\n";
        return 2;
    }
    const mgca::Model model = mgca::Model::from_file(argv[2]);
    const std::vector<golden::Case> cases = golden::read_cases(argv[1]);
    check::that(cases.size() > 30, "several dozen cases");
    std::cout << mgca::Model::runtime() << ", OpenCV " << CV_VERSION << "\n";
    for (const golden::Case& golden : cases) {
        const mgca::Result result = mgca::Filter(model, golden.options)(golden.pair);
        compare(golden, result);
        std::cout << std::left << std::setw(24) << golden.name << " " << std::setw(22) << mgca::to_string(result.status)
                  << " " << result.num_inliers << " of " << result.mask.size() << " " << result.ended << " "
                  << result.confidence.value_or(0.0) << "\n";
    }
    return check::result("golden");
}
