// The network in ONNX Runtime; mgca_filter/inference/onnxruntime_.py.

#include "attributes.hpp"
#include "network.hpp"

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <exception>
#include <unordered_map>

namespace mgca::detail {
namespace {

constexpr const char* kCpu = "CPUExecutionProvider";
// Squaring a matrix twenty times, the heart of the eight-point algorithm, is beyond half precision and TF32: providers
// that would use them by default are told not to. What the caller sets stays.
struct FullPrecision {
    const char *provider, *option, *value;
};
constexpr std::array<FullPrecision, 2> kFullPrecision{{{"CUDAExecutionProvider", "use_tf32", "0"},
                                                       {"TensorrtExecutionProvider", "trt_fp16_enable", "0"}}};
// Does not find what the graph's loops take from outside them; by itself OpenVINO does: docs/how_to/runtimes.md.
constexpr const char* kRefused = "OpenVINOExecutionProvider";
constexpr std::array<const char*, 2> kInputNames{"correspondences", "attributes"};
constexpr std::array<const char*, 2> kOutputNames{"logits", "essential"};

/// Throws where the library is older than the headers, which ONNX Runtime answers with a crash.
Ort::Env make_environment() {
    if (OrtGetApiBase()->GetApi(ORT_API_VERSION) == nullptr) {
        throw RuntimeError(std::string("ONNX Runtime's library (") + OrtGetApiBase()->GetVersionString() +
                           ") is older than its headers (1." + std::to_string(ORT_API_VERSION) + ")");
    }
    Ort::Env environment(ORT_LOGGING_LEVEL_ERROR, "mgca");
    environment.DisableTelemetryEvents();
    return environment;
}

/// Options with those that keep the providers in float32 beside the caller's.
RuntimeOptions in_full_precision(RuntimeOptions options) {
    for (const FullPrecision& wish : kFullPrecision) {
        options.provider_options[wish.provider].emplace(wish.option, wish.value);
    }
    return options;
}

void append_provider(Ort::SessionOptions& session, const std::string& name, const RuntimeOptions& options) {
    if (name == kCpu) {
        return;
    }
    std::unordered_map<std::string, std::string> settings;
    const auto given = options.provider_options.find(name);
    if (given != options.provider_options.end()) {
        settings.insert(given->second.begin(), given->second.end());
    }
    if (name == "CUDAExecutionProvider") {
        OrtCUDAProviderOptionsV2* cuda = nullptr;
        Ort::ThrowOnError(Ort::GetApi().CreateCUDAProviderOptions(&cuda));
        const std::unique_ptr<OrtCUDAProviderOptionsV2, void (*)(OrtCUDAProviderOptionsV2*)> owner(
            cuda, Ort::GetApi().ReleaseCUDAProviderOptions);
        std::vector<const char*> keys, values;
        for (const auto& [key, value] : settings) {
            keys.push_back(key.c_str());
            values.push_back(value.c_str());
        }
        Ort::ThrowOnError(
            Ort::GetApi().UpdateCUDAProviderOptions(cuda, keys.data(), values.data(), keys.size()));
        session.AppendExecutionProvider_CUDA_V2(*cuda);
        return;
    }
    // ONNX Runtime's generic call wants the short name ("XNNPACK", "OpenVINO", "CoreML").
    const std::string suffix = "ExecutionProvider";
    const bool is_long = name.size() > suffix.size() && name.substr(name.size() - suffix.size()) == suffix;
    session.AppendExecutionProvider(is_long ? name.substr(0, name.size() - suffix.size()) : name, settings);
}

/// Throws ModelError where the graph lacks one of the names.
template <typename Name>
void check_names(const char* what, const std::array<const char*, 2>& expected, std::size_t count,
                 const std::string& source, const Name& name_of) {
    std::string names;
    std::size_t found = 0;
    for (std::size_t i = 0; i < count; ++i) {
        const auto name = name_of(i);
        found += std::count(expected.begin(), expected.end(), std::string_view(name.get())) > 0 ? 1 : 0;
        names += (names.empty() ? "" : ", ") + std::string(name.get());
    }
    if (found != expected.size()) {
        throw ModelError(source + ": " + what + " " + names + ", expected " + expected[0] + ", " + expected[1]);
    }
}

class OnnxNetwork : public Network {
public:
    OnnxNetwork(std::string_view content, const std::string& source, const RuntimeOptions& options)
        : environment_(make_environment()), session_(nullptr) {
        std::vector<std::string> usable;
        std::string missing, reason;
        const std::vector<std::string> available = Ort::GetAvailableProviders();
        for (const std::string& name : options.providers) {
            if (std::find(available.begin(), available.end(), name) == available.end()) {
                missing += (missing.empty() ? "" : ", ") + name;
            } else if (name == kRefused) {
                reason = name + " does not run the network's loops";
            } else {
                usable.push_back(name);
            }
        }
        if (!missing.empty()) {
            reason = "this ONNX Runtime has no " + missing + (reason.empty() ? "" : "; ") + reason;
        }
        if (!reason.empty()) {
            refuse(options, reason);
        }
        if (!usable.empty() && usable != std::vector<std::string>{kCpu}) {
            try {
                session_ = open_in_full_precision(content, usable, options);
            } catch (const Ort::Exception& error) {
                reason = usable[0] + " failed (" + error.what() + ")";
                refuse(options, reason);
            }
        }
        if (!reason.empty()) {
            notes_.push_back("mgca runs on another provider than asked for: " + reason);
        }
        try {
            if (static_cast<OrtSession*>(session_) == nullptr) {
                session_ = open(content, {}, options);
            }
            check_names("inputs", kInputNames, session_.GetInputCount(), source, [this](std::size_t i) {
                return session_.GetInputNameAllocated(i, Ort::AllocatorWithDefaultOptions());
            });
            check_names("outputs", kOutputNames, session_.GetOutputCount(), source, [this](std::size_t i) {
                return session_.GetOutputNameAllocated(i, Ort::AllocatorWithDefaultOptions());
            });
        } catch (const Ort::Exception& error) {
            throw ModelError(source + ": ONNX Runtime cannot open the model (" + error.what() + ")");
        }
    }

    NetworkOutput infer(std::vector<float>& correspondences, std::vector<float>& attributes) const override {
        const auto count = static_cast<std::int64_t>(attributes.size() / kAttributeCount);
        const std::array<std::int64_t, 3> shape1{1, count, 4}, shape2{1, count, kAttributeCount};
        try {
            const Ort::MemoryInfo memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
            const std::array<Ort::Value, 2> inputs{
                Ort::Value::CreateTensor<float>(memory, correspondences.data(), correspondences.size(), shape1.data(),
                                                shape1.size()),
                Ort::Value::CreateTensor<float>(memory, attributes.data(), attributes.size(), shape2.data(),
                                                shape2.size())};
            const std::vector<Ort::Value> outputs =
                session_.Run(Ort::RunOptions(), kInputNames.data(), inputs.data(), inputs.size(), kOutputNames.data(),
                             kOutputNames.size());
            const float* logits = outputs[0].GetTensorData<float>();
            return {{logits, logits + count}, cv::Matx33d(cv::Matx33f(outputs[1].GetTensorData<float>()))};
        } catch (const Ort::Exception& error) {
            throw RuntimeError(std::string("ONNX Runtime failed (") + error.what() + ")");
        }
    }

private:
    static void refuse(const RuntimeOptions& options, const std::string& reason) {
        if (!options.cpu_fallback) {
            throw RuntimeError("providers: " + reason);
        }
    }

    /// As the caller has it where a provider does not know that option yet.
    Ort::Session open_in_full_precision(std::string_view content, const std::vector<std::string>& providers,
                                        const RuntimeOptions& options) {
        try {
            return open(content, providers, in_full_precision(options));
        } catch (const Ort::Exception&) {
            return open(content, providers, options);
        }
    }

    Ort::Session open(std::string_view content, const std::vector<std::string>& providers,
                      const RuntimeOptions& options) {
        Ort::SessionOptions session;
        for (const std::string& name : providers) {
            append_provider(session, name, options);
        }
        session.SetIntraOpNumThreads(options.threads);
        session.SetInterOpNumThreads(1);
        // Threads that wait for the next pass would take the processor from the robust fit.
        session.AddConfigEntry("session.force_spinning_stop", "1");
        // The product that this fusion makes rounds by the number of threads, and a rounding may move logits by tenths;
        // Python leaves it out as well.
        session.AddConfigEntry("optimization.disable_specified_optimizers", "MatMulScaleFusion");
        return Ort::Session(environment_, content.data(), content.size(), session);
    }

    // The session must not outlive the environment: members are destroyed in reverse order.
    Ort::Env environment_;
    mutable Ort::Session session_;  // its Run is thread-safe, but not declared const
};

}  // namespace

std::unique_ptr<Network> open_network(std::string_view content, const std::string& source,
                                      const std::filesystem::path& /*file*/, const RuntimeOptions& options) {
    return std::make_unique<OnnxNetwork>(content, source, options);
}

std::string runtime_name() { return std::string("ONNX Runtime ") + OrtGetApiBase()->GetVersionString(); }

}  // namespace mgca::detail
