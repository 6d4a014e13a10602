// Matches two images, filters the matches and prints the answer, in words or as JSON.

#include <mgca/filter.hpp>

#include <opencv2/core.hpp>
#if CV_VERSION_MAJOR >= 5
#include <opencv2/features.hpp>
#else
#include <opencv2/features2d.hpp>
#endif
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <exception>
#include <iostream>
#include <limits>
#include <locale>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

constexpr int kFound = 0, kNothingFound = 1, kError = 2;

constexpr const char* kHelp =
    "usage: mgca_match IMAGE1 IMAGE2 [--model FILE [--first-look FILE]] [options]\n"
    "  --model FILE            ONNX file of mgca_filter (default: both models within the library, where it has them)\n"
    "  --first-look FILE       a quicker one, asked before it: mgca_fast.onnx before mgca_small.onnx is the default\n"
    "  --K, --K2 fx,fy,cx,cy   intrinsics in pixels; without --K2 both images share them, without both they are guessed\n"
    "  --dist, --dist2 k1,k2,p1,p2[,...]  distortion coefficients of OpenCV\n"
    "  --threshold PX          inlier threshold of the mask (default 1)\n"
    "  --keep-precision P      mask of this expected precision instead of a threshold\n"
    "  --method NAME           auto, prosac, magsac, ransac or none\n"
    "  --effort NAME           auto or full\n"
    "  --geometry NAME         auto, essential, fundamental or homography\n"
    "  --max-iterations N, --confidence P, --seed N\n"
    "  --max-keypoints N       default 2000\n"
    "  --threads N             of the network (default 1, 0 = all cores)\n"
    "  --json                  the whole answer as JSON\n"
    "Exit status: 0 = geometry found, 1 = none, 2 = usage or error.\n";

struct Arguments {
    std::vector<std::string> images;
    std::string model, first_look;
    mgca::Camera camera1, camera2;
    mgca::Options options;
    mgca::RuntimeOptions runtime;
    int max_keypoints = 2000;
    bool json = false;
};

std::vector<double> numbers(const std::string& text, const std::string& option) {
    std::vector<double> values;
    std::istringstream stream(text);
    for (std::string part; std::getline(stream, part, ',');) {
        std::istringstream number(part);
        number.imbue(std::locale::classic());
        double value = 0.0;
        if (!(number >> value) || !number.eof()) {
            throw std::invalid_argument(option + ": not a number: '" + part + "'");
        }
        values.push_back(value);
    }
    return values;
}

double number(const std::string& text, const std::string& option) {
    const std::vector<double> values = numbers(text, option);
    if (values.size() != 1) {
        throw std::invalid_argument(option + ": expected a number, got '" + text + "'");
    }
    return values[0];
}

int integer(const std::string& text, const std::string& option) {
    const double value = number(text, option);
    if (value != std::floor(value) || std::abs(value) > std::numeric_limits<int>::max()) {
        throw std::invalid_argument(option + ": expected an integer, got '" + text + "'");
    }
    return static_cast<int>(value);
}

cv::Matx33d intrinsics(const std::string& text, const std::string& option) {
    const std::vector<double> k = numbers(text, option);
    if (k.size() != 4) {
        throw std::invalid_argument(option + ": expected fx,fy,cx,cy, got '" + text + "'");
    }
    return {k[0], 0.0, k[2], 0.0, k[1], k[3], 0.0, 0.0, 1.0};
}

void set_option(Arguments& arguments, const std::string& name, const std::string& value) {
    if (name == "--model") {
        arguments.model = value;
    } else if (name == "--first-look") {
        arguments.first_look = value;
    } else if (name == "--K") {
        arguments.camera1.K = intrinsics(value, name);
    } else if (name == "--K2") {
        arguments.camera2.K = intrinsics(value, name);
    } else if (name == "--dist") {
        arguments.camera1.distortion = numbers(value, name);
    } else if (name == "--dist2") {
        arguments.camera2.distortion = numbers(value, name);
    } else if (name == "--threshold") {
        arguments.options.threshold = number(value, name);
    } else if (name == "--keep-precision") {
        arguments.options.keep_precision = number(value, name);
    } else if (name == "--confidence") {
        arguments.options.confidence = number(value, name);
    } else if (name == "--max-iterations") {
        arguments.options.max_iterations = integer(value, name);
    } else if (name == "--seed") {
        arguments.options.seed = integer(value, name);
    } else if (name == "--max-keypoints") {
        arguments.max_keypoints = integer(value, name);
    } else if (name == "--threads") {
        arguments.runtime.threads = integer(value, name);
    } else if (name == "--method") {
        arguments.options.method = mgca::to_method(value);
    } else if (name == "--effort") {
        arguments.options.effort = mgca::to_effort(value);
    } else if (name == "--geometry") {
        arguments.options.geometry = mgca::to_geometry(value);
    } else {
        throw std::invalid_argument(name + ": unknown");
    }
}

Arguments parse_arguments(const std::vector<std::string>& words) {
    Arguments arguments;
    for (std::size_t i = 0; i < words.size(); ++i) {
        if (words[i].rfind("--", 0) != 0) {
            arguments.images.push_back(words[i]);
        } else if (words[i] == "--json") {
            arguments.json = true;
        } else if (i + 1 == words.size()) {
            throw std::invalid_argument(words[i] + ": unknown, or its value is missing");
        } else {
            set_option(arguments, words[i], words[i + 1]);
            ++i;
        }
    }
    if (arguments.images.size() != 2) {
        throw std::invalid_argument("expected two images");
    }
    if (arguments.model.empty() && !arguments.first_look.empty()) {
        throw std::invalid_argument("--first-look: needs --model");
    }
    if (arguments.model.empty() && !mgca::has_embedded_model()) {
        throw std::invalid_argument("expected --model: the library was built without a model in it");
    }
    return arguments;
}

/// SIFT on a grey copy of at most 1200 px; keypoints in pixels of the image. The settings of the training data.
cv::Mat detect(const std::string& file, int max_keypoints, std::vector<cv::KeyPoint>& keypoints, cv::Size2d& size) {
    constexpr int kMaxSide = 1200;
    const cv::Mat image = cv::imread(file, cv::IMREAD_COLOR);
    if (image.empty()) {
        throw std::runtime_error(file + ": not a readable image");
    }
    size = image.size();
    cv::Mat grey;
    cv::cvtColor(image, grey, cv::COLOR_BGR2GRAY);
    const double scale = std::min(1.0, static_cast<double>(kMaxSide) / std::max(grey.cols, grey.rows));
    if (scale < 1.0) {
        const cv::Size smaller(std::max(1, cvRound(grey.cols * scale)), std::max(1, cvRound(grey.rows * scale)));
        cv::resize(grey, grey, smaller, 0.0, 0.0, cv::INTER_AREA);
    }
    cv::Mat descriptors;
    cv::SIFT::create(max_keypoints, 3, 1e-5)->detectAndCompute(grey, cv::noArray(), keypoints, descriptors);
    if (scale < 1.0) {
        // Pixels are areas, so the half pixel at the border scales as well.
        const double scale_x = static_cast<double>(grey.cols) / image.cols;
        const double scale_y = static_cast<double>(grey.rows) / image.rows;
        for (cv::KeyPoint& keypoint : keypoints) {
            keypoint.pt.x = static_cast<float>((keypoint.pt.x + 0.5) / scale_x - 0.5);
            keypoint.pt.y = static_cast<float>((keypoint.pt.y + 0.5) / scale_y - 0.5);
            keypoint.size = static_cast<float>(keypoint.size / std::sqrt(scale_x * scale_y));
        }
    }
    return descriptors;
}

/// `null` stands for what JSON cannot write: NaN and infinity.
template <typename T>
std::string json(T value) {
    if (!std::isfinite(static_cast<double>(value))) {
        return "null";
    }
    std::ostringstream text;
    text.imbue(std::locale::classic());
    text.precision(std::numeric_limits<T>::max_digits10);
    text << +value;
    return text.str();
}

template <typename Iterator>
std::string json_array(Iterator begin, Iterator end) {
    std::string text = "[";
    for (Iterator item = begin; item != end; ++item) {
        text += (item == begin ? "" : ", ") + json(*item);
    }
    return text + "]";
}

std::string json_matrix(const std::optional<cv::Matx33d>& matrix) {
    if (!matrix) {
        return "null";
    }
    std::string text = "[";
    for (int row = 0; row < 3; ++row) {
        text += (row == 0 ? "" : ", ") + json_array(matrix->val + 3 * row, matrix->val + 3 * row + 3);
    }
    return text + "]";
}

void print_json(std::ostream& out, const mgca::Result& result) {
    out << "{\n \"opencv\": \"" << CV_VERSION << "\",\n \"runtime\": \"" << mgca::Model::runtime()
        << "\",\n \"status\": \"" << mgca::to_string(result.status) << "\",\n \"num_inliers\": " << result.num_inliers
        << ",\n \"confidence\": " << (result.confidence ? json(*result.confidence) : "null")
        << ",\n \"verified\": " << (result.verified() ? "true" : "false")
        << ",\n \"E\": " << json_matrix(result.E) << ",\n \"F\": " << json_matrix(result.F)
        << ",\n \"R\": " << json_matrix(result.R)
        << ",\n \"t\": " << (result.t ? json_array(result.t->val, result.t->val + 3) : "null")
        << ",\n \"H\": " << json_matrix(result.H)
        << ",\n \"mask\": " << json_array(result.mask.begin(), result.mask.end())
        << ",\n \"scores\": " << json_array(result.scores.begin(), result.scores.end()) << "\n}\n";
}

void print_words(std::ostream& out, const mgca::Result& result, double milliseconds) {
    out.precision(3);
    out << "status      " << mgca::to_string(result.status) << "\n"
        << "kept        " << result.num_inliers << " of " << result.mask.size() << " matches\n";
    if (result.confidence) {
        out << "confidence  " << *result.confidence << "\n";
    }
    if (result.R) {
        const double cosine = std::clamp((cv::trace(*result.R) - 1.0) / 2.0, -1.0, 1.0);
        out << "rotation    " << std::acos(cosine) * 180.0 / CV_PI << " degrees\n";
    }
    if (result.t) {
        out << "direction   " << (*result.t)[0] << ", " << (*result.t)[1] << ", " << (*result.t)[2] << "\n";
    }
    for (const std::string& assumption : result.assumptions) {
        out << "assumed     " << assumption << "\n";
    }
    out << "filter      " << milliseconds << " ms\n";
}

mgca::Model open_model(const Arguments& arguments) {
    if (arguments.model.empty()) {
        return mgca::embedded_model(arguments.runtime);
    }
    const mgca::Model model = mgca::Model::from_file(arguments.model, arguments.runtime);
    return arguments.first_look.empty()
               ? model
               : model.with_first_look(mgca::Model::from_file(arguments.first_look, arguments.runtime));
}

int run(Arguments arguments) {
    const mgca::Filter filter(open_model(arguments), arguments.options);
    std::vector<cv::KeyPoint> keypoints1, keypoints2;
    const cv::Mat descriptors1 =
        detect(arguments.images[0], arguments.max_keypoints, keypoints1, arguments.camera1.size);
    const cv::Mat descriptors2 =
        detect(arguments.images[1], arguments.max_keypoints, keypoints2, arguments.camera2.size);
    std::vector<std::vector<cv::DMatch>> matches;
    if (!descriptors1.empty() && !descriptors2.empty()) {
        cv::BFMatcher(cv::NORM_L2).knnMatch(descriptors1, descriptors2, matches, 2);
    }
    const auto started = std::chrono::steady_clock::now();
    const mgca::Result result = filter(keypoints1, keypoints2, matches, arguments.camera1, arguments.camera2);
    const std::chrono::duration<double, std::milli> elapsed = std::chrono::steady_clock::now() - started;
    if (arguments.json) {
        print_json(std::cout, result);
    } else {
        print_words(std::cout, result, elapsed.count());
    }
    return result.verified() ? kFound : kNothingFound;
}

}  // namespace

int main(int argc, char** argv) {
    const std::vector<std::string> words(argv + 1, argv + argc);
    if (words.size() == 1 && words[0] == "--help") {
        std::cout << kHelp;
        return kFound;
    }
    Arguments arguments;
    try {
        arguments = parse_arguments(words);
    } catch (const std::exception& error) {
        std::cerr << "mgca_match: " << error.what() << "\n" << kHelp;
        return kError;
    }
    try {
        return run(std::move(arguments));
    } catch (const std::exception& error) {
        std::cerr << "mgca_match: " << error.what() << "\n";
        return kError;
    }
}
