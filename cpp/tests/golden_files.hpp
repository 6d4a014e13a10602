// The golden files of tests/golden: what goes into the filter and what Python answers.

#pragma once

#include "json.hpp"

#include <mgca/filter.hpp>

#include <filesystem>
#include <string>
#include <vector>

namespace golden {

/// One pair with options, and the answer of Python.
struct Case {
    std::string name;
    mgca::MatchPair pair;
    mgca::Options options;
    mgca::detail::Json expected;
};

std::vector<Case> read_cases(const std::filesystem::path& folder);
mgca::MatchPair read_input(const std::filesystem::path& folder, const std::string& name);

/// A matrix of nine numbers.
cv::Matx33d matrix(const mgca::detail::Json& values);

}  // namespace golden
