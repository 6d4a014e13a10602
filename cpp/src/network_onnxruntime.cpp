// The network in ONNX Runtime; mgca_filter/inference/onnxruntime_.py.

#include "attributes.hpp"
#include "network.hpp"

#include <onnxruntime_cxx_api.h>

#include <array>
#include <cstdint>
#include <exception>
#include <unordered_map>

namespace mgca::detail {
namespace {

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

void append_provider(Ort::SessionOptions& session, const std::string& name, const RuntimeOptions& options) {
    constexpr const char* kCpu = "CPUExecutionProvider";
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

class OnnxNetwork : public Network {
public:
    OnnxNetwork(std::string_view content, const std::string& source, const RuntimeOptions& options)
        : environment_(make_environment()), session_(nullptr) {
        Ort::SessionOptions session;
        for (const std::string& name : options.providers) {
            try {
                append_provider(session, name, options);
            } catch (const Ort::Exception& error) {
                throw RuntimeError("providers: " + name + " cannot start (" + error.what() + ")");
            }
        }
        try {
            session.SetIntraOpNumThreads(options.threads);
            session.SetInterOpNumThreads(1);
            // Threads that wait for the next pass would take the processor from the robust fit.
            session.AddConfigEntry("session.force_spinning_stop", "1");
            // The product that this fusion makes rounds by the number of threads, and a rounding may move logits by
            // tenths; Python leaves it out as well.
            session.AddConfigEntry("optimization.disable_specified_optimizers", "MatMulScaleFusion");
            session_ = Ort::Session(environment_, content.data(), content.size(), session);
        } catch (const Ort::Exception& error) {
            const std::string what = "ONNX Runtime cannot open the model (" + std::string(error.what()) + ")";
            if (!options.providers.empty()) {
                throw RuntimeError(source + ": " + what);
            }
            throw ModelError(source + ": " + what);
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
