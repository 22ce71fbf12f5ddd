// The network of this machine in place of WiFi, with the interface of Arduino's Client.
#pragma once
#include "Arduino.h"
#include <algorithm>
#include <netdb.h>
#include <string>
#include <sys/socket.h>

enum { WL_CONNECTED = 3 };
struct { void begin(const char *, const char *) {} int status() { return WL_CONNECTED; } } inline WiFi;

class Client {
public:
    virtual ~Client() = default;
    virtual int connect(const char *host, uint16_t port) = 0;
    virtual size_t write(const uint8_t *bytes, size_t size) = 0;
    virtual int available() = 0;
    virtual int read() = 0;
    virtual void stop() = 0;
    virtual uint8_t connected() = 0;
};

class WiFiClient : public Client {
public:
    int connect(const char *host, uint16_t port) override { stop(), fd_ = dial(host, port); return fd_ >= 0; }
    size_t write(const uint8_t *bytes, size_t size) override {
        ssize_t sent = send(fd_, bytes, size, MSG_NOSIGNAL);
        return sent < 0 ? 0 : sent;
    }
    int available() override {
        if (at_ == end_ && fd_ >= 0) at_ = 0, end_ = std::max<ssize_t>(0, recv(fd_, in_, sizeof in_, MSG_DONTWAIT));
        return end_ - at_;
    }
    int read() override { return available() ? in_[at_++] : -1; }
    void stop() override { if (fd_ >= 0) close(fd_); fd_ = -1, at_ = end_ = 0; }
    uint8_t connected() override {
        uint8_t one;
        if (at_ < end_) return true;
        ssize_t found = fd_ < 0 ? 0 : recv(fd_, &one, 1, MSG_PEEK | MSG_DONTWAIT);
        return found > 0 || (found < 0 && errno == EAGAIN);
    }

protected:
    virtual int dial(const char *host, uint16_t port) {
        addrinfo hints{}, *found = nullptr;
        hints.ai_socktype = SOCK_STREAM;
        if (getaddrinfo(host, std::to_string(port).c_str(), &hints, &found) != 0) return -1;
        int fd = socket(found->ai_family, SOCK_STREAM | SOCK_CLOEXEC, 0);
        if (::connect(fd, found->ai_addr, found->ai_addrlen) != 0) close(fd), fd = -1;
        freeaddrinfo(found);
        return fd;
    }

private:
    int fd_ = -1;
    uint8_t in_[1436];  // as in that of the ESP32: a system call for each byte would be slow
    ssize_t at_ = 0, end_ = 0;
};
