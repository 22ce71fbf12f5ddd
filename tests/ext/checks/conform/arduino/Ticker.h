// A timer that calls from another thread, as that of the ESP32 does.
#pragma once
#include "Arduino.h"
#include <condition_variable>
#include <mutex>
#include <thread>

class Ticker {
public:
    using Callback = void (*)();
    Ticker() { std::thread([this] { run(); }).detach(); }
    void once_ms(uint32_t ms, Callback callback) {
        std::lock_guard hold(mutex_);
        callback_ = callback, at_ = std::chrono::steady_clock::now() + std::chrono::milliseconds(ms);
        changed_.notify_all();
    }

private:
    void run() {
        for (std::unique_lock hold(mutex_);;) {
            if (!callback_) changed_.wait(hold);
            else if (std::chrono::steady_clock::now() < at_) changed_.wait_until(hold, at_);
            else callback_(), callback_ = nullptr;
        }
    }
    std::mutex mutex_;
    std::condition_variable changed_;
    std::chrono::steady_clock::time_point at_;
    Callback callback_ = nullptr;
};
