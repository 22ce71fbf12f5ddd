"""Packets of MQTT 3.1.1, as far as a robot needs them: bytes in, bytes out."""

import struct

CONNECT = 0x10
CONNACK = 0x20
PUBLISH = 0x30
PUBACK = 0x40
SUBSCRIBE = 0x82
PINGREQ = 0xC0
LONGEST = 1024  # bytes of a packet that are stored: memory is small


def text(value):
    """Return a text as MQTT has it, behind its length."""
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("!H", len(data)) + data


def packet(first, content):
    """Return a packet. Each byte of its length has seven bits, and one that is set if more follow."""
    size = len(content)
    length = bytes((size,)) if size < 128 else bytes((size & 127 | 128, size >> 7))
    return bytes((first,)) + length + content


def message(first, content):
    """Return the topic, the number and the payload in a PUBLISH packet; the number is empty with QoS 0."""
    start = 2 + struct.unpack("!H", content)[0]
    try:
        topic = content[2:start].decode()
    except UnicodeError:
        topic = ""  # it is cut inside a letter: none of ours is so long
    end = start + 2 if first & 6 else start
    return topic, content[start:end], content[end:]


class Reader:
    """The bytes that have arrived, and the packets in them."""

    def __init__(self):
        self.data = b""
        self.skipped = 0  # bytes of a long packet that are still to come

    def add(self, data):
        self.data += data

    def packets(self):
        """Yield the first byte and the content of each packet that is there; content that is too long is cut."""
        while True:
            gone = min(self.skipped, len(self.data))
            self.skipped -= gone
            self.data = self.data[gone:]
            size, start = self.length()
            end = start + min(size, LONGEST)
            if start == 0 or len(self.data) < end:
                return
            first, content = self.data[0], self.data[start:end]
            self.data = self.data[end:]
            self.skipped = start + size - end
            yield first, content

    def length(self):
        """Return the size of the next packet's content, and where it begins: 0 if that is not there yet."""
        size = 0
        for index in range(1, len(self.data)):
            size |= (self.data[index] & 127) << 7 * (index - 1)
            if self.data[index] < 128:
                return size, index + 1
        return 0, 0
