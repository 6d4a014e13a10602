// The network of a model file, in one inference runtime, chosen when the library is built;
// mgca_filter/inference/backend.py.

#pragma once

#include <mgca/filter.hpp>

#include <opencv2/core.hpp>

#include <memory>
#include <string>
#include <string_view>
#include <vector>

namespace mgca::detail {

/// What the network says of a pair; not finite where its input is degenerate (all points equal, say).
struct NetworkOutput {
    std::vector<float> logits;  // one for each match
    cv::Matx33d essential;      // of any sign
};

/// Matches of one pair in, one logit for each and an essential matrix out. Safe to use from several threads.
class Network {
public:
    Network() = default;
    Network(const Network&) = delete;
    Network& operator=(const Network&) = delete;
    virtual ~Network() = default;

    /// One forward pass over N >= 1 matches: N rows of 4 coordinates, finite, and of 8 attributes. Throws RuntimeError.
    virtual NetworkOutput infer(std::vector<float>& correspondences, std::vector<float>& attributes) const = 0;

    /// What turned out otherwise than asked for.
    const std::vector<std::string>& notes() const { return notes_; }

protected:
    std::vector<std::string> notes_;
};

/// Open a model from its bytes; throws ModelError or RuntimeError.
///
/// @param source what messages call it. file: where the bytes were read, or empty.
std::unique_ptr<Network> open_network(std::string_view content, const std::string& source,
                                      const std::filesystem::path& file, const RuntimeOptions& options);

/// Name and version of the runtime.
std::string runtime_name();

}  // namespace mgca::detail
