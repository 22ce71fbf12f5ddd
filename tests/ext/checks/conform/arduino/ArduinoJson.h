// The part of ArduinoJson 7 that the sample uses, by cJSON.
#pragma once
#include "Arduino.h"
#include <cjson/cJSON.h>

struct JsonArray {};
struct JsonObjectConst {};

class JsonVariantConst {
public:
    JsonVariantConst(const cJSON *item = nullptr) : item_(item) {}
    JsonVariantConst operator[](const char *name) const { return cJSON_GetObjectItemCaseSensitive(item_, name); }
    JsonVariantConst operator[](int index) const { return cJSON_GetArrayItem(item_, index); }
    bool isUnbound() const { return item_ == nullptr; }
    template <class T> bool is() const;
    template <class T> T as() const;
    const char *operator|(const char *none) const { return cJSON_IsString(item_) ? item_->valuestring : none; }
    bool operator|(bool none) const { return cJSON_IsBool(item_) ? cJSON_IsTrue(item_) : none; }
    int64_t operator|(int64_t none) const { return cJSON_IsNumber(item_) ? static_cast<int64_t>(item_->valuedouble) : none; }

private:
    const cJSON *item_;
};
template <> inline bool JsonVariantConst::is<double>() const { return cJSON_IsNumber(item_); }
template <> inline bool JsonVariantConst::is<JsonObjectConst>() const { return cJSON_IsObject(item_); }
template <> inline double JsonVariantConst::as<double>() const { return item_->valuedouble; }

class Member {  // one that is made when something is assigned to it
public:
    Member(cJSON *of, const char *name) : of_(of), name_(name) {}
    Member operator[](const char *name) { return {made(cJSON_CreateObject), name}; }
    JsonVariantConst operator[](int index) const { return JsonVariantConst(item())[index]; }
    template <class T> void to() { made(cJSON_CreateArray); }
    template <class T> void add(const T &value) { cJSON_AddItemToArray(made(cJSON_CreateArray), of_value(value)); }
    template <class T> void operator=(const T &value) { put(of_value(value)); }
    operator JsonVariantConst() const { return item(); }
    template <class T> auto operator|(const T &none) const { return JsonVariantConst(item()) | none; }

private:
    static cJSON *of_value(bool value) { return cJSON_CreateBool(value); }
    static cJSON *of_value(int value) { return cJSON_CreateNumber(value); }
    static cJSON *of_value(int64_t value) { return cJSON_CreateNumber(static_cast<double>(value)); }
    static cJSON *of_value(double value) { return cJSON_CreateNumber(value); }
    static cJSON *of_value(const char *value) { return value ? cJSON_CreateString(value) : cJSON_CreateNull(); }
    static cJSON *of_value(const String &value) { return cJSON_CreateString(value.c_str()); }
    cJSON *item() const { return cJSON_GetObjectItemCaseSensitive(of_, name_); }
    cJSON *made(cJSON *(*make)()) { return item() ? item() : put(make()); }
    cJSON *put(cJSON *item) { cJSON_DeleteItemFromObjectCaseSensitive(of_, name_), cJSON_AddItemToObject(of_, name_, item); return item; }
    cJSON *of_;
    const char *name_;
};

class JsonDocument {
public:
    JsonDocument() = default;
    JsonDocument(const JsonDocument &) = delete;
    ~JsonDocument() { cJSON_Delete(item_); }
    template <class T> T as() const { return T(item_); }
    Member operator[](const char *name) {
        if (!item_) item_ = cJSON_CreateObject();
        return {item_, name};
    }

private:
    template <class Bytes> friend bool deserializeJson(JsonDocument &to, const Bytes *from, size_t size);
    friend void serializeJson(const JsonDocument &from, String &to);
    cJSON *item_ = nullptr;
};
template <class Bytes> bool deserializeJson(JsonDocument &to, const Bytes *from, size_t size) {  // true: an error
    cJSON_Delete(to.item_);
    return !(to.item_ = cJSON_ParseWithLength(reinterpret_cast<const char *>(from), size));
}
inline void serializeJson(const JsonDocument &from, String &to) {
    char *text = cJSON_PrintUnformatted(from.item_);
    to = text;
    free(text);
}
