// The model file: what a caller of its network has to know, read from its metadata.

#pragma once

#include <opencv2/core.hpp>

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
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace mgca {

/// Number of values that describe a match beyond its position.
constexpr std::size_t kAttributeCount = 8;

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
            for (std::size_t i = 0; i < kAttributeCount; ++i) {
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

}  // namespace mgca
