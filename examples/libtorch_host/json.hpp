// A minimal reader for the JSON metadata in an artefact.
#pragma once

#include <cstdlib>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

struct Json {
    enum Kind { Nothing, Number, Text, List, Object } kind = Nothing;
    double number = 0.0;
    std::string text;
    std::vector<Json> list;
    std::map<std::string, Json> object;

    const Json &operator[](const std::string &name) const {
        const auto found = object.find(name);
        if (found == object.end()) throw std::runtime_error("metadata lack \"" + name + "\"");
        return found->second;
    }

    // Numbers that JSON does not support are written as "nan", "inf" and "-inf".
    double value() const {
        if (kind == Number) return number;
        if (text == "nan") return std::numeric_limits<double>::quiet_NaN();
        if (text == "inf") return std::numeric_limits<double>::infinity();
        if (text == "-inf") return -std::numeric_limits<double>::infinity();
        throw std::runtime_error("a number is expected in the metadata, not \"" + text + "\"");
    }
};

class JsonReader {
public:
    explicit JsonReader(const std::string &source) : source_(source) {}

    Json read() {
        Json json = value(0);
        if (next() != '\0') fail();
        return json;
    }

private:
    const std::string &source_;
    std::size_t at_ = 0;

    [[noreturn]] void fail() const {
        throw std::runtime_error("the metadata are damaged at byte " + std::to_string(at_));
    }

    char next() {
        while (at_ < source_.size() && std::string(" \n\r\t").find(source_[at_]) != std::string::npos)
            ++at_;
        return at_ < source_.size() ? source_[at_] : '\0';
    }

    void expect(char c) {
        if (next() != c) fail();
        ++at_;
    }

    bool take(char c) {
        if (next() != c) return false;
        ++at_;
        return true;
    }

    Json value(int depth) {
        if (depth > 32) fail();
        Json json;
        switch (next()) {
        case '{':
            json.kind = Json::Object;
            ++at_;
            if (take('}')) return json;
            do {
                const std::string name = string();
                expect(':');
                json.object[name] = value(depth + 1);
            } while (take(','));
            expect('}');
            return json;
        case '[':
            json.kind = Json::List;
            ++at_;
            if (take(']')) return json;
            do json.list.push_back(value(depth + 1));
            while (take(','));
            expect(']');
            return json;
        case '"':
            json.kind = Json::Text;
            json.text = string();
            return json;
        case 'n': return word("null", 0.0, Json::Nothing);
        case 't': return word("true", 1.0, Json::Number);
        case 'f': return word("false", 0.0, Json::Number);
        default: return number();
        }
    }

    Json word(const std::string &spelling, double number, Json::Kind kind) {
        if (source_.compare(at_, spelling.size(), spelling) != 0) fail();
        at_ += spelling.size();
        Json json;
        json.kind = kind;
        json.number = number;
        return json;
    }

    Json number() {
        const char *start = source_.c_str() + at_;
        char *end = nullptr;
        Json json;
        json.kind = Json::Number;
        json.number = std::strtod(start, &end);
        if (end == start) fail();
        at_ += static_cast<std::size_t>(end - start);
        return json;
    }

    // Escapes are kept unchanged: no relevant name contains one.
    std::string string() {
        expect('"');
        const std::size_t start = at_;
        while (at_ < source_.size() && source_[at_] != '"') at_ += source_[at_] == '\\' ? 2 : 1;
        if (at_ >= source_.size()) fail();
        return source_.substr(start, at_++ - start);
    }
};
