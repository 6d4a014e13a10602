// The networks of an open model.

#pragma once

#include "model_file.hpp"
#include "network.hpp"

#include <mgca/filter.hpp>

#include <memory>
#include <string>
#include <vector>

namespace mgca {
namespace detail {

/// One open model file.
struct OpenNetwork {
    ModelMetadata metadata;
    std::string sha256;
    std::unique_ptr<Network> network;
};

}  // namespace detail

struct Model::State {
    std::vector<std::shared_ptr<const detail::OpenNetwork>> networks;  // in the order in which they are asked
    std::string name, version, sha256;                                 // of all of them
    std::vector<std::string> notes;
};

}  // namespace mgca
