#include "json.hpp"

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <locale>
#include <sstream>
#include <stdexcept>
#include <utility>

namespace mgca::detail {

double parse_number(std::string_view text) {
    std::istringstream stream{std::string(text)};
    stream.imbue(std::locale::classic());
    double value = 0.0;
    if (!(stream >> value) || !(stream >> std::ws).eof() || !std::isfinite(value)) {
        throw std::invalid_argument("expected a finite number, got '" + std::string(text.substr(0, 40)) + "'");
    }
    return value;
}

class JsonParser {
public:
    explicit JsonParser(std::string_view text) : text_(text) {}

    Json parse() {
        Json value = parse_value(0);
        skip_space();
        if (position_ != text_.size()) {
            fail("text behind the value");
        }
        return value;
    }

private:
    static constexpr int kMaxDepth = 64;

    [[noreturn]] void fail(const char* what) const {
        throw std::invalid_argument(std::string("no JSON at character ") + std::to_string(position_) + ": " + what);
    }

    void skip_space() {
        while (position_ < text_.size() && std::string_view(" \t\r\n").find(text_[position_]) != std::string_view::npos) {
            ++position_;
        }
    }

    char peek() {
        skip_space();
        if (position_ == text_.size()) {
            fail("unexpected end");
        }
        return text_[position_];
    }

    void expect(char character) {
        if (peek() != character) {
            fail("another character expected");
        }
        ++position_;
    }

    bool take(std::string_view word) {
        if (text_.substr(position_, word.size()) != word) {
            return false;
        }
        position_ += word.size();
        return true;
    }

    Json parse_value(int depth) {
        if (depth > kMaxDepth) {
            fail("nested too deeply");
        }
        Json value;
        switch (peek()) {
            case '{': parse_object(value, depth); break;
            case '[': parse_array(value, depth); break;
            case '"':
                value.kind_ = Json::Kind::text;
                value.text_ = parse_text();
                break;
            default: parse_word(value);
        }
        return value;
    }

    void parse_word(Json& value) {
        if (take("null")) {
            return;
        }
        if (take("true") || take("false")) {
            value.kind_ = Json::Kind::boolean;
            value.number_ = text_[position_ - 2] == 'u' ? 1.0 : 0.0;
            return;
        }
        const std::size_t end = std::min(text_.find_first_not_of("+-.0123456789eE", position_), text_.size());
        value.kind_ = Json::Kind::number;
        value.number_ = parse_number(text_.substr(position_, end - position_));
        position_ = end;
    }

    void parse_array(Json& value, int depth) {
        value.kind_ = Json::Kind::array;
        expect('[');
        if (peek() == ']') {
            ++position_;
            return;
        }
        for (;;) {
            value.items_.push_back(parse_value(depth + 1));
            if (peek() != ',') {
                break;
            }
            ++position_;
        }
        expect(']');
    }

    void parse_object(Json& value, int depth) {
        value.kind_ = Json::Kind::object;
        expect('{');
        if (peek() == '}') {
            ++position_;
            return;
        }
        for (;;) {
            peek();
            std::string name = parse_text();
            expect(':');
            value.members_[std::move(name)] = parse_value(depth + 1);
            if (peek() != ',') {
                break;
            }
            ++position_;
        }
        expect('}');
    }

    std::string parse_text() {
        expect('"');
        std::string text;
        for (;;) {
            if (position_ == text_.size()) {
                fail("unexpected end of a string");
            }
            const char character = text_[position_++];
            if (character == '"') {
                return text;
            }
            if (character == '\\') {
                append_escaped(text);
            } else {
                text += character;
            }
        }
    }

    void append_escaped(std::string& text) {
        constexpr std::string_view kFrom = "\"\\/bfnrt", kTo = "\"\\/\b\f\n\r\t";
        if (position_ == text_.size()) {
            fail("unexpected end of a string");
        }
        const char character = text_[position_++];
        if (character == 'u') {
            append_utf8(text, hexadecimal());
            return;
        }
        const std::size_t known = kFrom.find(character);
        if (known == std::string_view::npos) {
            fail("unknown escape");
        }
        text += kTo[known];
    }

    std::uint32_t hexadecimal() {
        std::uint32_t code = 0;
        for (int i = 0; i < 4; ++i) {
            const std::size_t digit =
                position_ < text_.size() ? std::string_view("0123456789abcdefABCDEF").find(text_[position_])
                                         : std::string_view::npos;
            if (digit == std::string_view::npos) {
                fail("four hexadecimal digits expected");
            }
            ++position_;
            code = 16 * code + static_cast<std::uint32_t>(digit < 16 ? digit : digit - 6);
        }
        return code;
    }

    /// Surrogates stay as they are: nothing that is read here has any.
    static void append_utf8(std::string& text, std::uint32_t code) {
        const auto append = [&](std::uint32_t byte) { text += static_cast<char>(static_cast<unsigned char>(byte)); };
        if (code < 0x80) {
            append(code);
        } else if (code < 0x800) {
            append(0xC0 | (code >> 6));
            append(0x80 | (code & 63));
        } else {
            append(0xE0 | (code >> 12));
            append(0x80 | ((code >> 6) & 63));
            append(0x80 | (code & 63));
        }
    }

    std::string_view text_;
    std::size_t position_ = 0;
};

Json Json::parse(std::string_view text) { return JsonParser(text).parse(); }

bool Json::boolean() const {
    if (kind_ != Kind::boolean) {
        throw std::invalid_argument("expected true or false");
    }
    return number_ != 0.0;
}

double Json::number() const {
    if (kind_ != Kind::number) {
        throw std::invalid_argument("expected a number");
    }
    return number_;
}

const std::string& Json::text() const {
    if (kind_ != Kind::text) {
        throw std::invalid_argument("expected a string");
    }
    return text_;
}

const std::vector<Json>& Json::items() const {
    if (kind_ != Kind::array) {
        throw std::invalid_argument("expected an array");
    }
    return items_;
}

const std::map<std::string, Json>& Json::members() const {
    if (kind_ != Kind::object) {
        throw std::invalid_argument("expected an object");
    }
    return members_;
}

std::vector<double> Json::numbers() const {
    std::vector<double> values;
    values.reserve(items().size());
    for (const Json& item : items()) {
        values.push_back(item.number());
    }
    return values;
}

bool Json::has(const std::string& name) const {
    const auto member = members().find(name);
    return member != members().end() && !member->second.is_null();
}

const Json& Json::operator[](const std::string& name) const {
    const auto member = members().find(name);
    if (member == members().end()) {
        throw std::invalid_argument(name + " is missing");
    }
    return member->second;
}

}  // namespace mgca::detail
