// The flash of the board: one value, in a file.
#pragma once
#include "Arduino.h"
#include "settings.h"
#include <fstream>
#include <iterator>

class Preferences {
public:
    bool begin(const char *) { return true; }
    bool isKey(const char *) { return access(STOP_FILE, F_OK) == 0; }
    String getString(const char *) {
        std::ifstream file(STOP_FILE);
        return std::string(std::istreambuf_iterator<char>(file), {});
    }
    size_t putString(const char *, const String &text) {
        String fresh = String(STOP_FILE) + ".new";
        FILE *file = fopen(fresh.c_str(), "w");
        if (!file) return 0;
        bool saved = fwrite(text.data(), 1, text.size(), file) == text.size() && fflush(file) == 0 && fsync(fileno(file)) == 0;
        return fclose(file) == 0 && saved && rename(fresh.c_str(), STOP_FILE) == 0 ? text.size() : 0;
    }
};
