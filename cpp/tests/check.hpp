// Checks of the tests: a failed one is printed and counted, and the program goes on.

#pragma once

#include <cmath>
#include <iostream>
#include <string>

namespace check {

inline int failures = 0;

inline bool that(bool holds, const std::string& what) {
    if (!holds) {
        ++failures;
        std::cerr << "FAILED: " << what << "\n";
    }
    return holds;
}

template <typename A, typename B>
bool equal(const A& actual, const B& expected, const std::string& what) {
    const bool holds = actual == expected;
    if (!holds) {
        ++failures;
        std::cerr << "FAILED: " << what << ": " << actual << ", expected " << expected << "\n";
    }
    return holds;
}

inline bool near(double actual, double expected, double tolerance, const std::string& what) {
    const bool holds = std::abs(actual - expected) <= tolerance;
    if (!holds) {
        ++failures;
        std::cerr << "FAILED: " << what << ": " << actual << ", expected " << expected << " within " << tolerance << "\n";
    }
    return holds;
}

/// The call throws the exception, and its message holds the words.
template <typename Exception, typename Call>
void throws(const Call& call, const std::string& words) {
    try {
        call();
    } catch (const Exception& error) {
        that(std::string(error.what()).find(words) != std::string::npos,
             "'" + words + "' in the message '" + error.what() + "'");
        return;
    } catch (const std::exception& error) {
        that(false, "another exception than expected for '" + words + "': " + error.what());
        return;
    }
    that(false, "nothing was thrown for '" + words + "'");
}

inline int result(const char* name) {
    std::cout << name << ": " << (failures == 0 ? "all checks hold" : std::to_string(failures) + " checks failed") << "\n";
    return failures == 0 ? 0 : 1;
}

}  // namespace check
