// What a model file says of itself, checked; mgca_filter/inference/model_file.py.

#pragma once

#include "calibration.hpp"
#include "choice.hpp"

#include <string>
#include <string_view>

namespace mgca::detail {

/// What a caller of the network has to know.
struct ModelMetadata {
    std::string name, version;
    Calibration calibration;
    double decision_threshold = 0.0;   // a match above this logit counts as accepted
    double candidate_max_ratio = 1.0;  // which matches enter the network
    int candidate_min_count = 0;
    AttributePrior prior;  // scores of the matches that do not
    Coefficients choice;
};

/// Read the metadata of an ONNX file.
///
/// @param source what messages call it. Throws ModelError where it is truncated, no model of mgca_filter, or of another
///     contract.
ModelMetadata read_metadata(std::string_view content, const std::string& source);

/// The bytes of a model file; throws ModelError, also where the SHA256SUMS beside it lists another file of this name. A file
/// that is not listed, a user's own model, is not compared.
std::string read_model_file(const std::filesystem::path& file);

}  // namespace mgca::detail
