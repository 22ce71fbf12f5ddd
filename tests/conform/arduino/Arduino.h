// As much of Arduino's core for the ESP32 as examples/your-robot/robot.cpp uses, on Linux.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <unistd.h>

#define constrain(value, least, most) ((value) < (least) ? (least) : (value) > (most) ? (most) : (value))

void setup();
void loop();

inline void delay(uint32_t ms) { usleep(1000 * ms); }
inline int64_t clock_us(clockid_t of) { timespec t; clock_gettime(of, &t); return 1000000LL * t.tv_sec + t.tv_nsec / 1000; }
inline int64_t esp_timer_get_time() { return clock_us(CLOCK_MONOTONIC); }
inline uint32_t esp_random() { uint32_t n; if (getentropy(&n, sizeof n)) abort(); return n; }
inline void configTime(long, int, const char *) {}  // this machine's clock is set
