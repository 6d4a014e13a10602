// The model file: its metadata, and the network that runs it.
//
// With ONNX Runtime's headers on the include path ONNX Runtime runs the network; without them, or with
// MGCA_USE_OPENCV_DNN defined, cv::dnn of OpenCV 5 does (the one of OpenCV 4 cannot run this graph).

#pragma once

#include <opencv2/core.hpp>

#if !defined(MGCA_USE_OPENCV_DNN)
#if __has_include(<onnxruntime_cxx_api.h>)
#include <onnxruntime_cxx_api.h>
#else
#define MGCA_USE_OPENCV_DNN
#endif
#endif
#if defined(MGCA_USE_OPENCV_DNN)
#if CV_VERSION_MAJOR < 5
#error "mgca: no ONNX Runtime headers found, and cv::dnn of OpenCV 4 cannot run the model: add ONNX Runtime or OpenCV 5"
#endif
#include <opencv2/dnn.hpp>
#endif

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <locale>
#include <map>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace mgca {

/// Number of values that describe a match beyond its position.
constexpr int kAttributeCount = 8;

/// Attributes of one match, raw physical values: ratio d1 / d2, best of the list (0/1), log2(size2 / size1), cosine and
/// sine of angle2 - angle1, then three flags (0/1): ratio known, best known, size and angle known. Unknown is zero.
using Attributes = std::array<float, kAttributeCount>;

/// The model file is missing, damaged, or of another contract; the message names the file.
class ModelError : public std::runtime_error {
public:
    ModelError(const std::filesystem::path& file, const std::string& what)
        : std::runtime_error(file.string() + ": " + what) {}
};

/// Logit of a match from its attributes alone: weight2 . gelu(weight1 a + bias1) + bias2, hidden units in the rows.
struct AttributePrior {
    std::vector<std::array<double, kAttributeCount>> weight1;
    std::vector<double> bias1;
    std::vector<double> weight2;
    double bias2 = 0.0;

    float logit(const Attributes& attributes) const {
        double sum = bias2;
        for (std::size_t unit = 0; unit < weight1.size(); ++unit) {
            double x = bias1[unit];
            for (int i = 0; i < kAttributeCount; ++i) {
                x += weight1[unit][i] * attributes[i];
            }
            sum += weight2[unit] * 0.5 * x * (1.0 + std::erf(x / std::sqrt(2.0)));
        }
        return static_cast<float>(sum);
    }
};

/// What a caller of the network has to know; read from the model file.
struct ModelMetadata {
    std::string name;
    /// probability = sigmoid(scale * logit + offset)
    double calibration_scale = 1.0;
    double calibration_offset = 0.0;
    /// A match whose logit is above this counts as accepted.
    double decision_threshold = 0.0;
    /// Matches of a ratio from here on do not enter the network, unless fewer than candidate_min_count would.
    double candidate_max_ratio = 1.0;
    int candidate_min_count = 0;
    /// Scores the matches that do not enter the network.
    AttributePrior prior;

    float probability(float logit) const {
        const double x = calibration_scale * logit + calibration_offset;
        const double e = std::exp(-std::abs(x));
        return static_cast<float>((x >= 0 ? 1.0 : e) / (1.0 + e));
    }
};

namespace detail {

/// Fields of a protocol buffer message, in their order.
class MessageReader {
public:
    struct Field {
        std::uint64_t number = 0;
        std::string_view bytes;  // of strings and nested messages, empty for numbers
    };

    explicit MessageReader(std::string_view message) : rest_(message) {}

    bool done() const { return rest_.empty(); }

    /// Throws std::invalid_argument where the message ends inside a field.
    Field next() {
        const std::uint64_t key = varint();
        switch (key & 7) {
            case 0: varint(); return {key >> 3, {}};
            case 1: take(8); return {key >> 3, {}};
            case 2: return {key >> 3, take(varint())};
            case 5: take(4); return {key >> 3, {}};
            default: throw std::invalid_argument("unknown field type");
        }
    }

private:
    std::uint64_t varint() {
        std::uint64_t value = 0;
        for (int shift = 0; shift < 64; shift += 7) {
            const auto byte = static_cast<unsigned char>(take(1)[0]);
            value |= static_cast<std::uint64_t>(byte & 127) << shift;
            if (byte < 128) {
                return value;
            }
        }
        throw std::invalid_argument("number too long");
    }

    std::string_view take(std::uint64_t count) {
        if (count > rest_.size()) {
            throw std::invalid_argument("unexpected end");
        }
        const std::string_view taken = rest_.substr(0, static_cast<std::size_t>(count));
        rest_.remove_prefix(taken.size());
        return taken;
    }

    std::string_view rest_;
};

/// The metadata properties of an ONNX file; throws std::invalid_argument where the bytes are no ONNX model.
inline std::map<std::string, std::string> metadata_properties(std::string_view model) {
    // ModelProto.metadata_props, entries of StringStringEntryProto {1: key, 2: value}
    constexpr std::uint64_t kMetadataProps = 14, kKey = 1;
    std::map<std::string, std::string> properties;
    for (MessageReader fields(model); !fields.done();) {
        const MessageReader::Field field = fields.next();
        if (field.number != kMetadataProps) {
            continue;
        }
        std::string key, value;
        for (MessageReader entry(field.bytes); !entry.done();) {
            const MessageReader::Field part = entry.next();
            (part.number == kKey ? key : value) = part.bytes;
        }
        properties[key] = value;
    }
    return properties;
}

inline double finite(double value) {
    if (!std::isfinite(value)) {
        throw std::invalid_argument("expected a finite number");
    }
    return value;
}

inline double number(const cv::FileNode& node) {
    if (!node.isInt() && !node.isReal()) {
        throw std::invalid_argument("expected a number");
    }
    return finite(static_cast<double>(node));
}

inline std::vector<double> numbers(const cv::FileNode& node) {
    std::vector<double> values;
    for (const cv::FileNode& item : node) {
        values.push_back(number(item));
    }
    return values;
}

inline AttributePrior read_prior(const cv::FileNode& node) {
    AttributePrior prior;
    for (const cv::FileNode& row : node["weight1"]) {
        const std::vector<double> values = numbers(row);
        if (values.size() != kAttributeCount) {
            throw std::invalid_argument("expected rows of 8 weights");
        }
        std::copy(values.begin(), values.end(), prior.weight1.emplace_back().begin());
    }
    prior.bias1 = numbers(node["bias1"]);
    prior.weight2 = numbers(node["weight2"]);
    prior.bias2 = number(node["bias2"]);
    if (prior.bias1.size() != prior.weight1.size() || prior.weight2.size() != prior.weight1.size()) {
        throw std::invalid_argument("the shapes of the weights do not fit together");
    }
    return prior;
}

}  // namespace detail

/// Read and check the metadata of a model file.
///
/// Throws ModelError where the file is missing, truncated, no model of mgca_filter, or of another contract version.
inline ModelMetadata read_metadata(const std::filesystem::path& file) {
    std::ifstream stream(file, std::ios::binary);
    if (!stream) {
        throw ModelError(file, "model file cannot be opened");
    }
    const std::string bytes(std::istreambuf_iterator<char>(stream), {});
    std::map<std::string, std::string> properties;
    try {
        properties = detail::metadata_properties(bytes);
    } catch (const std::invalid_argument& error) {
        throw ModelError(file, std::string("not a readable ONNX model, truncated or damaged (") + error.what() + ")");
    }
    for (const char* key :
         {"contract_version", "name", "calibration", "decision_threshold", "candidate_rule", "prior"}) {
        if (properties.count(key) == 0) {
            throw ModelError(file, std::string("not a model of mgca_filter, metadata missing: ") + key);
        }
    }
    if (properties["contract_version"] != "1") {
        throw ModelError(file, "contract version " + properties["contract_version"] + ", this header reads version 1");
    }
    std::string key;
    const auto json = [&](const char* name) {
        key = name;
        return cv::FileStorage(properties[key],
                               cv::FileStorage::READ | cv::FileStorage::MEMORY | cv::FileStorage::FORMAT_JSON);
    };
    try {
        ModelMetadata metadata;
        metadata.name = properties["name"];
        const cv::FileStorage calibration = json("calibration");
        metadata.calibration_scale = detail::number(calibration["scale"]);
        metadata.calibration_offset = detail::number(calibration["offset"]);
        const cv::FileStorage rule = json("candidate_rule");
        metadata.candidate_max_ratio = detail::number(rule["max_ratio"]);
        metadata.candidate_min_count = static_cast<int>(detail::number(rule["min_count"]));
        metadata.prior = detail::read_prior(json("prior").root());
        key = "decision_threshold";
        std::istringstream text(properties[key]);
        text.imbue(std::locale::classic());
        if (!(text >> metadata.decision_threshold)) {
            throw std::invalid_argument("expected a number");
        }
        detail::finite(metadata.decision_threshold);
        return metadata;
    } catch (const std::exception& error) {
        throw ModelError(file, "metadata '" + key + "' cannot be read (" + error.what() + ")");
    }
}

/// The network: matches of one pair in, one logit for each out. Safe to use from several threads.
class Network {
public:
    /// Throws ModelError where the runtime cannot open the file.
    explicit Network(const std::filesystem::path& file);

    Network(const Network&) = delete;
    Network& operator=(const Network&) = delete;

    /// One forward pass over the N >= 1 matches of a pair.
    ///
    /// @param correspondences N rows of x1, y1, x2, y2 on the normalised image planes, finite.
    /// @param attributes N rows of Attributes.
    /// @return N logits; not finite where the input is degenerate (all points equal, say).
    ///
    /// Throws the runtime's exception (Ort::Exception or cv::Exception) where it fails, for lack of memory, say.
    std::vector<float> infer(std::vector<float> correspondences, std::vector<float> attributes) const;

    /// Name and version of the runtime.
    static std::string runtime();

private:
#if defined(MGCA_USE_OPENCV_DNN)
    mutable std::mutex mutex_;  // a cv::dnn::Net keeps its blobs between calls
    mutable cv::dnn::Net net_;
#else
    // The session must not outlive the environment: members are destroyed in reverse order.
    Ort::Env environment_;
    mutable Ort::Session session_;  // its Run is thread-safe, but not declared const
#endif
};

#if defined(MGCA_USE_OPENCV_DNN)

inline Network::Network(const std::filesystem::path& file) {
    try {
        net_ = cv::dnn::readNetFromONNX(file.string(), cv::dnn::ENGINE_NEW);
    } catch (const cv::Exception& error) {
        throw ModelError(file, std::string("OpenCV cannot open the model (") + error.what() + ")");
    }
}

inline std::vector<float> Network::infer(std::vector<float> correspondences, std::vector<float> attributes) const {
    const int count = static_cast<int>(attributes.size()) / kAttributeCount;
    const std::array<int, 3> shape1{1, count, 4}, shape2{1, count, kAttributeCount};
    const std::lock_guard<std::mutex> lock(mutex_);
    net_.setInput(cv::Mat(3, shape1.data(), CV_32F, correspondences.data()), "correspondences");
    net_.setInput(cv::Mat(3, shape2.data(), CV_32F, attributes.data()), "attributes");
    const cv::Mat logits = net_.forward("logits");
    return {logits.ptr<float>(), logits.ptr<float>() + count};
}

inline std::string Network::runtime() { return std::string("cv::dnn ") + CV_VERSION; }

#else

namespace detail {

/// Throws std::runtime_error where the library is older than the headers, which ONNX Runtime answers with a crash.
inline Ort::Env make_environment() {
    if (OrtGetApiBase()->GetApi(ORT_API_VERSION) == nullptr) {
        throw std::runtime_error(std::string("ONNX Runtime's library (") + OrtGetApiBase()->GetVersionString() +
                                 ") is older than its headers (1." + std::to_string(ORT_API_VERSION) + ")");
    }
    return Ort::Env(ORT_LOGGING_LEVEL_ERROR, "mgca");
}

}  // namespace detail

inline Network::Network(const std::filesystem::path& file)
    : environment_(detail::make_environment()), session_(nullptr) {
    try {
        // The place for execution providers and thread counts. The product that this fusion makes rounds by the
        // number of threads, and a rounding may move logits by tenths; Python leaves it out as well.
        Ort::SessionOptions options;
        options.AddConfigEntry("optimization.disable_specified_optimizers", "MatMulScaleFusion");
        session_ = Ort::Session(environment_, file.c_str(), options);
    } catch (const Ort::Exception& error) {
        throw ModelError(file, std::string("ONNX Runtime cannot open the model (") + error.what() + ")");
    }
}

inline std::vector<float> Network::infer(std::vector<float> correspondences, std::vector<float> attributes) const {
    const auto count = static_cast<std::int64_t>(attributes.size()) / kAttributeCount;
    const std::array<std::int64_t, 3> shape1{1, count, 4}, shape2{1, count, kAttributeCount};
    const Ort::MemoryInfo memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const std::array<Ort::Value, 2> inputs{
        Ort::Value::CreateTensor<float>(memory, correspondences.data(), correspondences.size(), shape1.data(), 3),
        Ort::Value::CreateTensor<float>(memory, attributes.data(), attributes.size(), shape2.data(), 3)};
    constexpr std::array<const char*, 2> input_names{"correspondences", "attributes"};
    constexpr std::array<const char*, 1> output_names{"logits"};
    const std::vector<Ort::Value> outputs =
        session_.Run(Ort::RunOptions(), input_names.data(), inputs.data(), inputs.size(), output_names.data(), 1);
    const float* logits = outputs.front().GetTensorData<float>();
    return {logits, logits + count};
}

inline std::string Network::runtime() {
    return std::string("ONNX Runtime ") + OrtGetApiBase()->GetVersionString();
}

#endif

}  // namespace mgca
