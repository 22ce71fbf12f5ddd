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
    """Return a text in MQTT's form: its length, then its bytes."""
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("!H", len(data)) + data


def header(first, size):
    """Return the first bytes of a packet: ``first``, then its size, seven bits a byte and a bit that means "more"."""
    data = bytes((first,))
    while size > 127:
        data += bytes((size & 127 | 128,))
        size >>= 7
    return data + bytes((size,))


def packet(first, content):
    return header(first, len(content)) + content


def message(first, content):
    """Return topic, number and payload of a PUBLISH packet; the number is empty with QoS 0."""
    start = 2 + struct.unpack_from("!H", content)[0]
    topic = content[2:start].decode()
    end = start + 2 if first & 6 else start
    return topic, content[start:end], content[end:]


class Reader:
    """The bytes that have arrived, with the packets in them."""

    def __init__(self):
        self.data = b""
        self.skipped = 0  # bytes of a long packet that are still to come
        self.head = b""  # what comes before the rest of the data, once those bytes are gone

    def add(self, data):
        self.data += data

    def packets(self):
        """Yield the first byte and the content of each complete packet; content that is too long is cut."""
        while self.skip():  # False: more of what is to be skipped has still to come
            size, start = self.length()
            end = start + min(size, LONGEST)
            if start == 0 or len(self.data) < end:  # its length, or its content, has not arrived completely
                return
            first, content = self.data[0], self.data[start:end]
            if first & 0xF0 == PUBLISH and self.skip_long_topic(start, size):
                continue
            self.data = self.data[end:]
            self.skipped = start + size - end
            yield first, content

    def skip(self):
        """Drop bytes that are to be skipped, as far as they have arrived; return True if all were dropped."""
        gone = min(self.skipped, len(self.data))
        self.skipped -= gone
        self.data = self.data[gone:]
        if self.skipped == 0:
            self.data = self.head + self.data  # a head is there only after skip_long_topic
            self.head = b""
        return self.skipped == 0

    def skip_long_topic(self, start, size):
        """Skip a topic so long that the packet's number behind it would be cut off; return True if it is skipped.

        The number must be acknowledged. So the packet goes on as one with an empty topic: no topic of ours is so long.
        """
        topic_size = struct.unpack_from("!H", self.data, start)[0]
        if 2 + topic_size + 2 <= LONGEST:
            return False
        self.head = header(self.data[0], size - topic_size) + text("")
        self.data = self.data[start + 2 :]
        self.skipped = topic_size
        return True

    def length(self):
        """Return the size of the next packet's content, and where it begins: 0 if that is not known yet."""
        size = 0
        for index in range(1, len(self.data)):
            size |= (self.data[index] & 127) << 7 * (index - 1)
            if self.data[index] < 128:
                return size, index + 1
        return 0, 0
