// The part of ArduinoJson 7 that reads, by cJSON.
#pragma once
#include "Arduino.h"
#include <cjson/cJSON.h>

struct JsonObjectConst;
class JsonArrayConst;

class JsonVariantConst {
public:
    JsonVariantConst(const cJSON *item = nullptr) : item_(item) {}
    JsonVariantConst operator[](const char *name) const { return cJSON_GetObjectItemCaseSensitive(item_, name); }
    bool isUnbound() const { return item_ == nullptr; }
    template <class T> bool is() const;
    template <class T> T as() const;
    const char *operator|(const char *none) const { return cJSON_IsString(item_) ? item_->valuestring : none; }

private:
    const cJSON *item_;
};
template <> inline bool JsonVariantConst::is<double>() const { return cJSON_IsNumber(item_); }
template <> inline bool JsonVariantConst::is<bool>() const { return cJSON_IsBool(item_); }
template <> inline bool JsonVariantConst::is<const char *>() const { return cJSON_IsString(item_); }
template <> inline bool JsonVariantConst::is<JsonObjectConst>() const { return cJSON_IsObject(item_); }
template <> inline double JsonVariantConst::as<double>() const { return item_->valuedouble; }
template <> inline bool JsonVariantConst::as<bool>() const { return cJSON_IsTrue(item_); }

class JsonArrayConst {
public:
    struct iterator {
        const cJSON *item;
        JsonVariantConst operator*() const { return item; }
        void operator++() { item = item->next; }
        bool operator!=(iterator other) const { return item != other.item; }
    };
    iterator begin() const { return {first_}; }
    iterator end() const { return {nullptr}; }
    const cJSON *first_;
};
template <> inline JsonArrayConst JsonVariantConst::as<JsonArrayConst>() const { return {cJSON_IsArray(item_) ? item_->child : nullptr}; }

class JsonDocument {
public:
    JsonDocument() = default;
    JsonDocument(const JsonDocument &) = delete;
    ~JsonDocument() { cJSON_Delete(item_); }
    operator JsonVariantConst() const { return item_; }
    JsonVariantConst operator[](const char *name) const { return JsonVariantConst(item_)[name]; }

private:
    friend bool deserializeJson(JsonDocument &to, const uint8_t *from, size_t size);
    cJSON *item_ = nullptr;
};
inline bool deserializeJson(JsonDocument &to, const uint8_t *from, size_t size) {  // true: an error
    cJSON_Delete(to.item_);
    return !(to.item_ = cJSON_ParseWithLength(reinterpret_cast<const char *>(from), size));
}
