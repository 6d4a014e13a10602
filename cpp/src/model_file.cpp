#include "model_file.hpp"

#include "json.hpp"
#include "sha256.hpp"

#include <mgca/filter.hpp>

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <stdexcept>
#include <system_error>

namespace mgca::detail {
namespace {

constexpr const char* kContractVersion = "2";
constexpr const char* kSumsName = "SHA256SUMS";
// The largest preset takes 20 MB; more than this is another file, and is not read into memory.
constexpr std::uintmax_t kMaxModelBytes = std::uintmax_t{1} << 29U;

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
        switch (key & 7U) {
            case 0: varint(); return {key >> 3U, {}};
            case 1: take(8); return {key >> 3U, {}};
            case 2: return {key >> 3U, take(varint())};
            case 5: take(4); return {key >> 3U, {}};
            default: throw std::invalid_argument("unknown field type");
        }
    }

private:
    std::uint64_t varint() {
        std::uint64_t value = 0;
        for (unsigned shift = 0; shift < 64; shift += 7) {
            const auto byte = static_cast<unsigned char>(take(1)[0]);
            value |= static_cast<std::uint64_t>(byte & 127U) << shift;
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

/// Metadata of an ONNX file; std::invalid_argument where the bytes are no ONNX model.
std::map<std::string, std::string> metadata_properties(std::string_view model) {
    // ModelProto.graph and .metadata_props, entries of StringStringEntryProto {1: key, 2: value}
    constexpr std::uint64_t kGraph = 7, kMetadataProps = 14, kKey = 1;
    std::map<std::string, std::string> properties;
    int graphs = 0;
    for (MessageReader fields(model); !fields.done();) {
        const MessageReader::Field field = fields.next();
        graphs += field.number == kGraph ? 1 : 0;
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
    if (graphs != 1) {
        throw std::invalid_argument(std::to_string(graphs) + " graphs");
    }
    return properties;
}

AttributePrior read_prior(const Json& values) {
    AttributePrior prior;
    for (const Json& row : values["weight1"].items()) {
        const std::vector<double> weights = row.numbers();
        if (weights.size() != kAttributeCount) {
            throw std::invalid_argument("expected rows of 8 weights");
        }
        std::copy(weights.begin(), weights.end(), prior.weight1.emplace_back().begin());
    }
    prior.bias1 = values["bias1"].numbers();
    prior.weight2 = values["weight2"].numbers();
    prior.bias2 = values["bias2"].number();
    if (prior.bias1.size() != prior.weight1.size() || prior.weight2.size() != prior.weight1.size()) {
        throw std::invalid_argument("the shapes of the weights do not fit together");
    }
    return prior;
}

/// The digest of a file that SHA256SUMS in its folder lists; empty without one.
std::string listed_sum(const std::filesystem::path& file) {
    std::ifstream sums(file.parent_path() / kSumsName);
    const std::string name = file.filename().string();
    for (std::string digest, listed; sums >> digest >> std::ws && std::getline(sums, listed);) {
        if (listed == name) {
            return digest;
        }
    }
    return "";
}

}  // namespace

ModelMetadata read_metadata(std::string_view content, const std::string& source) {
    std::map<std::string, std::string> properties;
    try {
        properties = metadata_properties(content);
    } catch (const std::invalid_argument& error) {
        throw ModelError(source + ": not a readable ONNX model, truncated or damaged (" + error.what() + ")");
    }
    std::string missing;
    for (const char* key : {"contract_version", "name", "version", "calibration", "decision_threshold",
                            "candidate_rule", "prior", "choice"}) {
        if (properties.count(key) == 0) {
            missing += (missing.empty() ? "" : ", ") + std::string(key);
        }
    }
    if (!missing.empty()) {
        throw ModelError(source + ": not a model of mgca_filter, metadata missing: " + missing);
    }
    if (properties["contract_version"] != kContractVersion) {
        throw ModelError(source + ": contract version " + properties["contract_version"] +
                         ", this library reads version " + kContractVersion);
    }
    const char* key = "";
    try {
        ModelMetadata metadata;
        metadata.name = properties["name"];
        metadata.version = properties["version"];
        key = "calibration";
        const Json calibration = Json::parse(properties[key]);
        metadata.calibration = {calibration["scale"].number(), calibration["offset"].number()};
        key = "decision_threshold";
        metadata.decision_threshold = parse_number(properties[key]);
        key = "candidate_rule";
        const Json rule = Json::parse(properties[key]);
        metadata.candidate_max_ratio = rule["max_ratio"].number();
        metadata.candidate_min_count = static_cast<int>(std::clamp(rule["min_count"].number(), 0.0, 1e9));
        key = "prior";
        metadata.prior = read_prior(Json::parse(properties[key]));
        key = "choice";
        metadata.choice = Coefficients::read(Json::parse(properties[key]));
        return metadata;
    } catch (const std::invalid_argument& error) {
        throw ModelError(source + ": metadata '" + key + "' cannot be read (" + error.what() + ")");
    }
}

std::string read_model_file(const std::filesystem::path& file) {
    std::error_code code;
    if (!std::filesystem::is_regular_file(file, code)) {
        throw ModelError(file.string() + ": model file not found");
    }
    const std::uintmax_t size = std::filesystem::file_size(file, code);
    if (code || size == 0) {
        throw ModelError(file.string() + ": model file is empty");
    }
    if (size > kMaxModelBytes) {
        throw ModelError(file.string() + ": " + std::to_string(size) + " bytes is no model of mgca_filter");
    }
    std::ifstream stream(file, std::ios::binary);
    std::string content{std::istreambuf_iterator<char>(stream), {}};
    if (content.size() != size) {
        throw ModelError(file.string() + ": model file cannot be read");
    }
    const std::string sum = listed_sum(file);
    if (!sum.empty() && sum != sha256(content)) {
        throw ModelError(file.string() + ": damaged or replaced, its SHA-256 is not the one in " +
                         (file.parent_path() / kSumsName).string());
    }
    return content;
}

}  // namespace mgca::detail
