"""pebble_serial_v1 on the board's side."""

from common.frames import Decoder, Sender, crc16

DESCRIBE_REQ = bytes([3, 1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 3, 0x85, 0x6B, 0])
CMD = bytes([3, 1, 0x20, 2, 3, 2, 1, 1, 1, 1, 1, 1, 1, 4, 1, 0x9B, 0x7C, 0])


def taken(sender):
    """What is on its way, and it is gone."""
    size = len(sender.ring)
    data = bytes([sender.ring[(sender.first + index) % size] for index in range(sender.used)])
    sender.first = (sender.first + sender.used) % size
    sender.used = 0
    return data


def plain(frame):
    """COBS undone, by the book; ``frame`` with its zero."""
    assert frame[-1] == 0
    assert 0 not in frame[:-1]
    data, at = b"", 0
    while at < len(frame) - 1:
        code = frame[at]
        data += frame[at + 1 : at + code] + (b"\0" if code < 255 else b"")
        at += code
    assert at == len(frame) - 1
    return data[:-1] if frame[0] else data


def stuffed(data):
    """COBS by the book."""
    out, run = b"", b""
    for byte in data:
        if byte:
            run += bytes([byte])
            if len(run) == 254:
                out, run = out + b"\xff" + run, b""
        else:
            out, run = out + bytes([len(run) + 1]) + run, b""
    return out + bytes([len(run) + 1]) + run + b"\0"


def host_frame(kind, interface=0, sequence=0, payload=b"", version=1):
    body = bytes([version, kind, 0]) + interface.to_bytes(2, "little") + sequence.to_bytes(4, "little")
    body += bytes(4) + payload
    return stuffed(body + crc16(body, len(body)).to_bytes(2, "little"))


def received(data, decoder=None):
    decoder = decoder or Decoder()
    return [(decoder.kind, decoder.interface, decoder.sequence) for byte in data if decoder.take(byte)]


class Noise:
    def __init__(self, seed):
        self.value = seed

    def next(self, limit):
        self.value = (self.value * 1103515245 + 12345) & 0x3FFFFFFF
        return (self.value >> 14) % limit

    def bytes(self, count):
        return bytes([self.next(256) for _ in range(count)])


def test_crc():
    assert crc16(b"123456789", 9) == 0x29B1
    assert crc16(b"", 0) == 0xFFFF
    assert crc16(b"123456789 and more", 9) == 0x29B1


def test_known_vectors_out():
    sender = Sender(512)
    assert sender.send(0x02, 0, 0, 0, b"")
    assert taken(sender) == DESCRIBE_REQ
    assert sender.send(0x20, 3, 1, 0, b"\x01")
    assert taken(sender) == CMD


def test_known_vectors_in():
    assert received(DESCRIBE_REQ) == [(0x02, 0, 0)]
    assert received(CMD) == [(0x20, 3, 1)]
    assert received(b"\0\0" + DESCRIBE_REQ + b"\0" + CMD) == [(0x02, 0, 0), (0x20, 3, 1)]


def test_sent_frames_decode_to_their_content():
    noise = Noise(7)
    sender = Sender(512)
    for count in range(400):
        sequence, now = noise.next(1 << 16), noise.next(1 << 16)
        data = noise.bytes(count) if count % 3 else bytes([1 + count % 255]) * count
        assert sender.send(0x10, 300, sequence, now, data)
        body = plain(taken(sender))
        head = b"\x01\x10\x00\x2c\x01" + sequence.to_bytes(4, "little") + now.to_bytes(4, "little")
        assert body[:13] == head
        assert body[13:-2] == data
        assert body[-2:] == crc16(body, len(body) - 2).to_bytes(2, "little")


def test_there_is_room_or_nothing_is_taken():
    sender = Sender(64)
    assert not sender.send(0x10, 1, 1, 1, bytes(45))
    assert sender.send(0x10, 1, 1, 1, bytes(44))
    assert not sender.send(0x10, 1, 1, 1, b"")
    assert len(plain(taken(sender))) == 13 + 44 + 2


def test_several_wait():
    sender = Sender(256)
    for number in range(5):
        assert sender.send(0x10, 1, number, 0, b"abc")
    frames = taken(sender).split(b"\0")[:-1]
    assert [plain(frame + b"\0")[5] for frame in frames] == [0, 1, 2, 3, 4]


def test_frames_in():
    noise = Noise(9)
    decoder = Decoder()
    for count in range(140):
        sequence = noise.next(1 << 16)
        frame = host_frame(0x20, count, sequence, noise.bytes(count) if count % 2 else b"x" * count)
        assert received(frame, decoder) == [(0x20, count, sequence)]


def test_what_is_refused():
    assert received(host_frame(0x31, version=2)) == []
    assert received(host_frame(0x31)[:-2] + b"\x55\0") == []
    assert received(stuffed(b"")) == []
    assert received(stuffed(b"\xff\xff")) == []
    assert received(stuffed(b"\x01" * 14)) == []
    assert received(b"\xff\x01\0") == []
    assert received(b"\x05\x01\0") == []


def test_the_longest_frame_has_160_bytes():
    decoder = Decoder()
    assert len(host_frame(0x20, payload=b"x" * 144)) == 161
    assert received(host_frame(0x20, payload=b"x" * 144), decoder) == [(0x20, 0, 0)]
    assert received(host_frame(0x20, payload=b"x" * 145), decoder) == []
    assert received(b"x" * 5000 + b"\0" + DESCRIBE_REQ, decoder) == [(0x02, 0, 0)]


def test_noise():
    noise = Noise(3)
    decoder = Decoder()
    sound = 0
    for _ in range(5_000):
        sound += len(received(noise.bytes(noise.next(24)) + b"\0", decoder))
    assert sound < 5, "a CRC of 16 bits lets one of 65,536 pass"
    assert received(CMD, decoder) == [(0x20, 3, 1)]
