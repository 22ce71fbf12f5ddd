// PubSubClient does not tell whether a message was retained. The flag is in the first byte of each packet that is read.
#pragma once
#include <cstdint>

class RetainFlag {
public:
    bool is_set = false;  // of the packet that is being read, or was read last

    void begin() { state = FIRST_BYTE; }

    void see(int byte) {
        if (state == FIRST_BYTE) {
            is_set = byte & 1;
            left = shift = 0;
            state = LENGTH;
        } else if (state == LENGTH) {  // seven bits of it in each byte; the eighth tells that more follow
            left |= (byte & 127) << shift;
            shift += 7;
            if (byte < 128) state = left > 0 ? CONTENT : FIRST_BYTE;
        } else if (--left == 0) {
            state = FIRST_BYTE;
        }
    }

private:
    enum { FIRST_BYTE, LENGTH, CONTENT } state = FIRST_BYTE;
    uint32_t left = 0, shift = 0;
};

// A WiFiClient or WiFiClientSecure that shows all that it reads to the flag.
template <class Link>
class WatchedClient : public Link {
public:
    explicit WatchedClient(RetainFlag &flag_) : flag(flag_) {}

    int read() override {
        int byte = Link::read();
        if (byte >= 0) flag.see(byte);
        return byte;
    }

private:
    RetainFlag &flag;
};
