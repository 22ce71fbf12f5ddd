// MQTT 3.1.1 as PubSubClient does it: QoS 0 out, one buffer for what comes and goes, and no retain flag for the callback.
#pragma once
#include "WiFi.h"
#include <vector>

class PubSubClient {
public:
    using Callback = void (*)(char *topic, uint8_t *payload, unsigned int length);
    void setClient(Client &client) { client_ = &client; }
    void setServer(const char *host, uint16_t port) { host_ = host, port_ = port; }
    void setCallback(Callback callback) { callback_ = callback; }
    void setKeepAlive(uint16_t seconds) { alive_s_ = seconds; }
    void setSocketTimeout(uint16_t seconds) { timeout_s_ = seconds; }
    bool setBufferSize(uint16_t size) { return buffer_.resize(size), true; }
    bool connected() { return up_ && client_->connected(); }

    bool connect(const char *id, const char *user, const char *password, const char *will, uint8_t qos, bool retain, const char *message) {
        up_ = false;
        if (!client_->connect(host_, port_)) return false;
        begin(0x10), text("MQTT"), byte(4), byte(0x02 | (will ? 0x04 | qos << 3 | retain << 5 : 0) | (user ? 0xc0 : 0)), number(alive_s_), text(id);
        if (will) text(will), text(message);
        if (user) text(user), text(password);
        up_ = finish() && read() == 4 && buffer_[0] == 0x20 && buffer_[3] == 0;
        if (!up_) client_->stop();
        pinged_ = false, heard_ = sent_;
        return up_;
    }
    bool subscribe(const char *topic, uint8_t qos) { return begin(0x82), number(1), text(topic), byte(qos), finish(); }
    bool publish(const char *topic, const char *payload, bool retain) {
        begin(0x30 | retain), text(topic);
        while (*payload) byte(*payload++);
        return connected() && finish();
    }
    bool loop() {  // one packet, at most
        if (!connected()) return up_ = false;
        int64_t now = esp_timer_get_time(), quiet_us = 1000000LL * alive_s_;
        if (now > heard_ + quiet_us || now > sent_ + quiet_us) {
            if (pinged_) return client_->stop(), up_ = false;
            begin(0xc0), finish(), heard_ = sent_, pinged_ = true;
        }
        size_t size = client_->available() ? read() : 0;
        if (size == 0) return connected();
        heard_ = esp_timer_get_time();
        if (buffer_[0] == 0xd0) pinged_ = false;
        if (buffer_[0] >> 4 == 3) take(size);
        return true;
    }

private:
    void take(size_t size) {
        size_t at = start_, length = buffer_[at] << 8 | buffer_[at + 1], rest = at + 2 + length, named = buffer_[0] & 6 ? 2 : 0;
        uint8_t high = buffer_[rest], low = buffer_[rest + 1];
        memmove(&buffer_[at + 1], &buffer_[at + 2], length), buffer_[at + 1 + length] = 0;  // it ends the topic
        callback_(reinterpret_cast<char *>(&buffer_[at + 1]), &buffer_[rest + named], size - rest - named);
        if (named) begin(0x40), byte(high), byte(low), finish();
    }
    int next() {  // -1: not in time
        for (int64_t end = esp_timer_get_time() + 1000000LL * timeout_s_; !client_->available(); delay(1))
            if (!client_->connected() || esp_timer_get_time() > end) return -1;
        return client_->read();
    }
    size_t read() {  // 0: it is larger than the buffer, or the connection has ended
        size_t size = 0, left = 0, whole = 0;
        int one = 0, shift = 0;
        auto keep = [&] { whole++; if (one >= 0 && size < buffer_.size()) buffer_[size++] = one; };
        one = next(), keep();
        do one = next(), left |= (one & 127) << shift, shift += 7, keep();
        while (one >= 128 && shift < 28);
        for (start_ = size; left > 0 && one >= 0; left--) one = next(), keep();
        if (one < 0) client_->stop();
        return one >= 0 && whole == size ? size : 0;
    }
    void byte(uint8_t one) { if (end_++ < buffer_.size()) buffer_[end_ - 1] = one; }
    void number(uint16_t n) { byte(n >> 8), byte(n & 255); }
    void text(const char *of) { for (number(strlen(of)); *of; of++) byte(*of); }
    void begin(uint8_t kind) { kind_ = kind, end_ = 5; }  // room for the header
    bool finish() {
        if (end_ > buffer_.size()) return false;
        size_t left = end_ - 5, first = left < 128 ? 3 : 2;
        buffer_[first] = kind_, buffer_[4] = left < 128 ? left : left >> 7;
        if (left >= 128) buffer_[3] = left | 128;
        sent_ = esp_timer_get_time();
        return client_->write(&buffer_[first], end_ - first) == end_ - first;
    }
    Client *client_ = nullptr;
    Callback callback_ = nullptr;
    const char *host_ = "";
    uint16_t port_ = 0, alive_s_ = 15, timeout_s_ = 15;
    std::vector<uint8_t> buffer_ = std::vector<uint8_t>(256);
    size_t start_ = 0, end_ = 0;
    int64_t heard_ = 0, sent_ = 0;
    bool up_ = false, pinged_ = false;
    uint8_t kind_ = 0;
};
