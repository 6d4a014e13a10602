// The model file within the library.

#pragma once

#include <string_view>

namespace mgca::detail {

/// Its bytes; empty where the library was built without one.
std::string_view embedded_model();

}  // namespace mgca::detail
