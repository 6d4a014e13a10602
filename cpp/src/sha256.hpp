// The digest that tells one model file from another.

#pragma once

#include <string>
#include <string_view>

namespace mgca::detail {

/// SHA-256 of some bytes, hexadecimal (FIPS 180-4).
std::string sha256(std::string_view content);

}  // namespace mgca::detail
