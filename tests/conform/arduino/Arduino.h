// As much of Arduino's core for the ESP32 as the samples use, on Linux.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <poll.h>
#include <unistd.h>

#define constrain(value, least, most) ((value) < (least) ? (least) : (value) > (most) ? (most) : (value))

void setup();
void loop();

inline void delay(uint32_t ms) { usleep(1000 * ms); }
inline int64_t clock_us(clockid_t of) { timespec t; clock_gettime(of, &t); return 1000000LL * t.tv_sec + t.tv_nsec / 1000; }
inline int64_t esp_timer_get_time() { return clock_us(CLOCK_MONOTONIC); }
inline uint32_t esp_random() { uint32_t n; if (getentropy(&n, sizeof n)) abort(); return n; }
inline void configTime(long, int, const char *) {}  // this machine's clock is set

struct {  // the console: at its end a person types "end"
    void begin(long) {}
    int available() { return end_ ? *end_ : poll_() > 0; }
    int read() {
        uint8_t one;
        if (!end_ && ::read(0, &one, 1) == 1) return one;
        if (!end_) end_ = "end\n";
        return *end_++;
    }
    template <class... Of> void printf(const char *format, Of... of) { ::printf(format, of...), fflush(stdout); }

private:
    int poll_() { pollfd in{0, POLLIN, 0}; return ::poll(&in, 1, 0); }
    const char *end_ = nullptr;
} inline Serial;
