// A reader of JSON (RFC 8259): the metadata of a model file, and what the tests compare with.

#pragma once

#include <map>
#include <string>
#include <string_view>
#include <vector>

namespace mgca::detail {

/// One value. Reading it as another type than it has, or a member that is not there, throws std::invalid_argument.
class Json {
public:
    /// Throws std::invalid_argument where the text is no JSON.
    static Json parse(std::string_view text);

    bool is_null() const { return kind_ == Kind::null; }
    bool boolean() const;
    double number() const;           ///< Finite.
    const std::string& text() const;
    const std::vector<Json>& items() const;
    const std::map<std::string, Json>& members() const;
    std::vector<double> numbers() const;

    bool has(const std::string& name) const;           ///< A member of that name that is not null.
    const Json& operator[](const std::string& name) const;

private:
    enum class Kind { null, boolean, number, text, array, object };
    friend class JsonParser;

    Kind kind_ = Kind::null;
    double number_ = 0.0;
    std::string text_;
    std::vector<Json> items_;
    std::map<std::string, Json> members_;
};

/// A finite number, whatever the locale; throws std::invalid_argument.
double parse_number(std::string_view text);

}  // namespace mgca::detail
