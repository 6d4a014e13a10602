#include "golden_files.hpp"

#include <fstream>
#include <iterator>
#include <limits>
#include <stdexcept>

namespace golden {
namespace {

using mgca::detail::Json;

Json read(const std::filesystem::path& file) {
    std::ifstream stream(file, std::ios::binary);
    if (!stream) {
        throw std::runtime_error(file.string() + " cannot be read");
    }
    return Json::parse(std::string{std::istreambuf_iterator<char>(stream), {}});
}

double coordinate(const Json& value) {
    return value.is_null() ? std::numeric_limits<double>::quiet_NaN() : value.number();
}

mgca::Keypoints read_keypoints(const Json& rows) {
    std::vector<cv::KeyPoint> keypoints;
    std::vector<cv::Point2d> points;
    for (const Json& row : rows.items()) {
        const double x = coordinate(row.items()[0]), y = coordinate(row.items()[1]);
        if (row.items().size() == 2) {
            points.emplace_back(x, y);
        } else {
            keypoints.emplace_back(static_cast<float>(x), static_cast<float>(y),
                                   static_cast<float>(row.items()[2].number()),
                                   static_cast<float>(row.items()[3].number()));
        }
    }
    return keypoints.empty() ? mgca::Keypoints(points) : mgca::Keypoints(keypoints);
}

mgca::Matches read_matches(const Json& rows, std::size_t count) {
    if (rows.is_null()) {
        return mgca::Matches::same_rows(count);
    }
    std::size_t longest = 0;
    std::vector<std::vector<cv::DMatch>> knn;
    std::vector<cv::DMatch> nearest;
    for (const Json& row : rows.items()) {
        const std::vector<double> values = row.numbers();
        longest = std::max(longest, values.size());
        std::vector<cv::DMatch>& candidates = knn.emplace_back();
        if (!values.empty()) {
            const int query = static_cast<int>(values[0]);
            cv::DMatch match;  // its distance is the largest float: not set
            match.queryIdx = query;
            match.trainIdx = static_cast<int>(values[1]);
            if (values.size() > 2) {
                match.distance = static_cast<float>(values[2]);
            }
            candidates.push_back(match);
            nearest.push_back(match);
            if (values.size() == 4) {
                candidates.emplace_back(query, 0, static_cast<float>(values[3]));
            }
        }
    }
    return longest < 4 ? mgca::Matches(nearest) : mgca::Matches(knn);
}

mgca::Camera read_camera(const Json& input, const std::string& image) {
    mgca::Camera camera;
    if (input.has("K" + image)) {
        cv::Matx33d K;
        for (std::size_t i = 0; i < 9; ++i) {
            K.val[i] = input["K" + image].items()[i / 3].items()[i % 3].number();
        }
        camera.K = K;
    }
    if (input.has("dist" + image)) {
        camera.distortion = input["dist" + image].numbers();
    }
    if (input.has("size" + image)) {
        const std::vector<double> size = input["size" + image].numbers();
        camera.size = {size[0], size[1]};
    }
    return camera;
}

mgca::Attributes read_attributes(const Json& values) {
    mgca::Attributes attributes;
    if (values.is_null()) {
        return attributes;
    }
    for (const Json& value : values["ratio"].items()) {
        attributes.ratio.push_back(static_cast<float>(value.number()));
    }
    for (const Json& value : values["best"].items()) {
        attributes.best.push_back(value.boolean() ? 1 : 0);
    }
    return attributes;
}

mgca::Options read_options(const Json& values) {
    mgca::Options options;
    for (const auto& [name, value] : values.members()) {
        if (name == "effort") {
            options.effort = mgca::to_effort(value.text());
        } else if (name == "method") {
            options.method = mgca::to_method(value.text());
        } else if (name == "geometry") {
            options.geometry = mgca::to_geometry(value.text());
        } else if (name == "threshold") {
            options.threshold = value.number();
        } else if (name == "confidence") {
            options.confidence = value.number();
        } else if (name == "keep_precision") {
            options.keep_precision = value.number();
        } else if (name == "max_iterations") {
            options.max_iterations = static_cast<int>(value.number());
        } else if (name == "seed") {
            options.seed = static_cast<int>(value.number());
        } else {
            throw std::runtime_error("option " + name + " is unknown to the tests");
        }
    }
    return options;
}

}  // namespace

cv::Matx33d matrix(const Json& values) {
    const std::vector<double> numbers = values.numbers();
    return cv::Matx33d(numbers.data());
}

mgca::MatchPair read_input(const std::filesystem::path& folder, const std::string& name) {
    const Json input = read(folder / "inputs" / (name + ".json"));
    mgca::MatchPair pair;
    pair.keypoints1 = read_keypoints(input["keypoints1"]);
    pair.keypoints2 = read_keypoints(input["keypoints2"]);
    pair.matches = read_matches(input["matches"], pair.keypoints1.points.size());
    pair.camera1 = read_camera(input, "1");
    pair.camera2 = read_camera(input, "2");
    pair.attributes = read_attributes(input["attributes"]);
    pair.resolution = input["resolution"].number();
    if (input.has("fisheye1")) {
        const std::vector<double> k = input["fisheye1"].numbers();
        pair.camera1.fisheye = mgca::Fisheye{k[0], k[1], k[2], k[3]};
    }
    return pair;
}

std::vector<Case> read_cases(const std::filesystem::path& folder) {
    std::vector<Case> cases;
    const Json listed = read(folder / "cases.json");
    for (const Json& item : listed.items()) {
        const std::string name = item["name"].text();
        cases.push_back({name, read_input(folder, item["input"].text()), read_options(item["options"]),
                         read(folder / "expected" / (name + ".json"))});
    }
    return cases;
}

}  // namespace golden
