// The network of this machine in place of WiFi, with the interface of Arduino's Client.
#pragma once
#include "Arduino.h"
#include <netdb.h>
#include <string>
#include <sys/ioctl.h>
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
    int available() override { int n = 0; return fd_ >= 0 && ioctl(fd_, FIONREAD, &n) == 0 ? n : 0; }
    int read() override { uint8_t one; return fd_ >= 0 && recv(fd_, &one, 1, MSG_DONTWAIT) == 1 ? one : -1; }
    void stop() override { if (fd_ >= 0) close(fd_); fd_ = -1; }
    uint8_t connected() override {
        uint8_t one;
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
};
