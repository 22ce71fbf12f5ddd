// What arrives may be anything: here it becomes finite numbers and short texts, or nothing.
#pragma once
#include <Arduino.h>
#include <ArduinoJson.h>
#include <sys/time.h>
#include <cmath>

static const unsigned LONGEST = 512;  // bytes of a command; a longer one is not read
static const char *const HEX_DIGITS = "0123456789abcdefABCDEF";
static const char *const NAME = "abcdefghijklmnopqrstuvwxyz0123456789_/-";  // letters of a person or a device

// Milliseconds since the start, of a clock that is never set.
inline int64_t now_ms() {
    return esp_timer_get_time() / 1000;
}

inline int64_t epoch_ms() {
    timeval now;
    gettimeofday(&now, nullptr);
    return 1000LL * now.tv_sec + now.tv_usec / 1000;
}

// Read a payload into a message, and return the command in it: {"value": {...}} means the same as {...}.
inline JsonVariantConst command_of(JsonDocument &message, const uint8_t *payload, unsigned size) {
    if (deserializeJson(message, payload, size <= LONGEST ? size : 0)) return JsonVariantConst();  // not JSON, or cut
    JsonVariantConst inner = message["value"];
    return inner.is<JsonObjectConst>() ? inner : message.as<JsonVariantConst>();
}

// The number in a command, or what it means if it is left out; NaN if it is none.
inline double number_of(JsonVariantConst item, double usual) {
    if (item.isUnbound()) return usual;
    return item.is<double>() ? item.as<double>() : NAN;
}

inline String text_of(JsonVariantConst item) {
    return String(item | "");
}

// Is it a text of so many hexadecimal digits?
inline bool is_hex(const String &text, unsigned size) {
    return text.length() == size && strspn(text.c_str(), HEX_DIGITS) == size;
}

// So many random hexadecimal digits, in steps of eight.
inline String new_hex(unsigned size) {
    String digits;
    while (digits.length() < size) {
        char eight[9];
        snprintf(eight, sizeof eight, "%08x", (unsigned)esp_random());
        digits += eight;
    }
    return digits;
}

// A name of a stranger as it may be published: cut, and with _ for each letter that is not allowed.
inline String name_of(JsonVariantConst item, unsigned size) {
    String name = text_of(item).substring(0, size);
    for (unsigned i = 0; i < name.length(); i++) {
        if (strchr(NAME, name[i]) == nullptr) name[i] = '_';
    }
    return name;
}

// The same for a text in which all that is printable is allowed, but for what JSON escapes.
inline String printable(JsonVariantConst item, unsigned size) {
    String text = text_of(item).substring(0, size);
    for (unsigned i = 0; i < text.length(); i++) {
        if (text[i] < ' ' || text[i] > '~' || text[i] == '"' || text[i] == '\\') text[i] = '_';
    }
    return text;
}
