// As much of Arduino's core for the ESP32 as the sample uses, on Linux.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <string>
#include <unistd.h>

#define constrain(value, least, most) ((value) < (least) ? (least) : (value) > (most) ? (most) : (value))
using std::max;

void setup();
void loop();

inline void delay(uint32_t ms) { usleep(1000 * ms); }
inline int64_t esp_timer_get_time() { timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return 1000000LL * t.tv_sec + t.tv_nsec / 1000; }
inline uint32_t esp_random() { uint32_t n; if (getentropy(&n, sizeof n)) abort(); return n; }
inline void configTime(long, int, const char *) {}  // this machine's clock is set

inline struct HardwareSerial { void begin(int) {} void println(const char *) {} } Serial;

class String : public std::string {
public:
    using std::string::string;
    String(const std::string &text) : std::string(text) {}
    bool startsWith(const char *text) const { return rfind(text, 0) == 0; }
    int indexOf(char letter, size_t from) const { return static_cast<int>(find(letter, from)); }
    String substring(size_t from, size_t to = npos) const { return from < size() ? substr(from, to - from) : String(); }
};
