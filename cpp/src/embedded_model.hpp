// The model files within the library.

#pragma once

#include <string_view>

namespace mgca::detail {

/// Bytes of the model; empty where the library was built without one.
std::string_view embedded_model();

/// Bytes of the model that is asked first; empty where the library was built without one.
std::string_view embedded_first_look();

}  // namespace mgca::detail
