// The network in cv::dnn of OpenCV 5; mgca_filter/inference/opencv_.py.

#include "attributes.hpp"
#include "network.hpp"

#include <opencv2/dnn.hpp>

#include <array>
#include <mutex>

namespace mgca::detail {
namespace {

class OpenCvNetwork : public Network {
public:
    OpenCvNetwork(std::string_view content, const std::string& source, const std::filesystem::path& file) {
        try {
            // From the path where there is one: the overload that reads a buffer does not heed the engine.
            net_ = file.empty() ? cv::dnn::readNetFromONNX(content.data(), content.size(), cv::dnn::ENGINE_NEW)
                                : cv::dnn::readNetFromONNX(file.string(), cv::dnn::ENGINE_NEW);
        } catch (const cv::Exception& error) {
            throw ModelError(source + ": OpenCV cannot open the model (" + error.what() + ")");
        }
    }

    NetworkOutput infer(std::vector<float>& correspondences, std::vector<float>& attributes) const override {
        const int count = static_cast<int>(attributes.size() / kAttributeCount);
        const std::array<int, 3> shape1{1, count, 4}, shape2{1, count, static_cast<int>(kAttributeCount)};
        try {
            const std::lock_guard<std::mutex> lock(mutex_);
            net_.setInput(cv::Mat(3, shape1.data(), CV_32F, correspondences.data()), "correspondences");
            net_.setInput(cv::Mat(3, shape2.data(), CV_32F, attributes.data()), "attributes");
            std::vector<cv::Mat> outputs;
            net_.forward(outputs, std::vector<cv::String>{"logits", "essential"});
            const float* logits = outputs[0].ptr<float>();
            return {{logits, logits + count}, cv::Matx33d(cv::Matx33f(outputs[1].ptr<float>()))};
        } catch (const cv::Exception& error) {
            throw RuntimeError(std::string("cv::dnn failed (") + error.what() + ")");
        }
    }

private:
    mutable std::mutex mutex_;  // a cv::dnn::Net keeps its blobs between calls
    mutable cv::dnn::Net net_;
};

}  // namespace

std::unique_ptr<Network> open_network(std::string_view content, const std::string& source,
                                      const std::filesystem::path& file, const RuntimeOptions& options) {
    if (!options.providers.empty()) {
        throw ArgumentError("providers: this library was built on cv::dnn, which has none");
    }
    return std::make_unique<OpenCvNetwork>(content, source, file);
}

std::string runtime_name() { return std::string("cv::dnn ") + CV_VERSION; }

}  // namespace mgca::detail
