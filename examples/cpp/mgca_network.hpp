// The network of the model file.
//
// With ONNX Runtime's headers on the include path ONNX Runtime runs it; without them, or with MGCA_USE_OPENCV_DNN
// defined, cv::dnn of OpenCV 5 does (the one of OpenCV 4 cannot run this graph).

#pragma once

#include "mgca_model.hpp"

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

#include <array>
#include <cstdint>
#include <filesystem>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

namespace mgca {

/// What the network says of a pair; not finite where its input is degenerate (all points equal, say).
struct NetworkOutput {
    std::vector<float> logits;  ///< One for each match.
    cv::Matx33d E;              ///< Essential matrix, normalised image planes, of any sign.
};

/// The network: matches of one pair in, one logit for each and an essential matrix out. Safe to use from several
/// threads.
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
    ///
    /// Throws the runtime's exception (Ort::Exception or cv::Exception) where it fails, for lack of memory, say.
    NetworkOutput infer(std::vector<float> correspondences, std::vector<float> attributes) const;

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

inline NetworkOutput Network::infer(std::vector<float> correspondences, std::vector<float> attributes) const {
    const int count = static_cast<int>(attributes.size() / kAttributeCount);
    const std::array<int, 3> shape1{1, count, 4}, shape2{1, count, static_cast<int>(kAttributeCount)};
    const std::lock_guard<std::mutex> lock(mutex_);
    net_.setInput(cv::Mat(3, shape1.data(), CV_32F, correspondences.data()), "correspondences");
    net_.setInput(cv::Mat(3, shape2.data(), CV_32F, attributes.data()), "attributes");
    std::vector<cv::Mat> outputs;
    net_.forward(outputs, std::vector<cv::String>{"logits", "essential"});
    const float* logits = outputs[0].ptr<float>();
    return {{logits, logits + count}, cv::Matx33f(outputs[1].ptr<float>())};
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

inline NetworkOutput Network::infer(std::vector<float> correspondences, std::vector<float> attributes) const {
    const auto count = static_cast<std::int64_t>(attributes.size() / kAttributeCount);
    const std::array<std::int64_t, 3> shape1{1, count, 4}, shape2{1, count, kAttributeCount};
    const Ort::MemoryInfo memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const std::array<Ort::Value, 2> inputs{
        Ort::Value::CreateTensor<float>(memory, correspondences.data(), correspondences.size(), shape1.data(), 3),
        Ort::Value::CreateTensor<float>(memory, attributes.data(), attributes.size(), shape2.data(), 3)};
    constexpr std::array<const char*, 2> input_names{"correspondences", "attributes"};
    constexpr std::array<const char*, 2> output_names{"logits", "essential"};
    const std::vector<Ort::Value> outputs = session_.Run(Ort::RunOptions(), input_names.data(), inputs.data(),
                                                         inputs.size(), output_names.data(), output_names.size());
    const float* logits = outputs[0].GetTensorData<float>();
    return {{logits, logits + count}, cv::Matx33f(outputs[1].GetTensorData<float>())};
}

inline std::string Network::runtime() {
    return std::string("ONNX Runtime ") + OrtGetApiBase()->GetVersionString();
}

#endif

}  // namespace mgca
