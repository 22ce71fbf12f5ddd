// The flash of the board: one value, in a file.
#pragma once
#include "Arduino.h"
#include "settings.h"
#include <string>

class Preferences {
public:
    bool begin(const char *) { return true; }
    bool isKey(const char *) { return access(STOP_FILE, F_OK) == 0; }
    size_t getBytes(const char *, void *to, size_t size) {
        FILE *file = fopen(STOP_FILE, "r");
        size_t found = file ? fread(to, 1, size, file) : 0;
        if (file) fclose(file);
        return found;
    }
    size_t putBytes(const char *, const void *from, size_t size) {
        std::string fresh = std::string(STOP_FILE) + ".new";
        FILE *file = fopen(fresh.c_str(), "w");
        if (!file) return 0;
        bool saved = fwrite(from, 1, size, file) == size && fflush(file) == 0 && fsync(fileno(file)) == 0;
        return fclose(file) == 0 && saved && rename(fresh.c_str(), STOP_FILE) == 0 ? size : 0;
    }
};
