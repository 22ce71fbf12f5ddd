"""The board's side of goob_base_v1 and of pebble_serial_v1."""

from common.frames import Decoder, Sender, crc16
from common.lines import Lines, clamp, number


class Recorder:
    """Records the commands to the robot and the lines to the host."""

    def __init__(self):
        self.commands = []
        self.lines = Lines(self.act)

    def act(self, letter, numbers):
        self.commands.append((chr(letter), list(numbers)))

    def give(self, data):
        for byte in data:
            self.lines.take(byte)
        return self.received()

    def received(self):
        lines = self.lines
        size = len(lines.ring)
        output = bytes([lines.ring[(lines.first + index) % size] for index in range(lines.used)])
        lines.first = (lines.first + lines.used) % size
        lines.used = 0
        return output


def obeyed(data):
    calls = Recorder()
    answer = calls.give(data)
    return answer, [(letter, numbers[: {"M": 2, "L": 3, "F": 4}[letter]]) for letter, numbers in calls.commands]


M_ONE = [("M", [1.0, 1.0])]
#: What a line is answered, and what it does.
OBEYED = (
    (b"M 0.5 -0.25\n", b"OK M", [("M", [0.5, -0.25])]),
    (b"L 1 0.5 0\n", b"OK L", [("L", [1.0, 0.5, 0.0])]),
    (b"F 0.25 0.5 1 1.5\n", b"OK F", [("F", [0.25, 0.5, 1.0, 1.5])]),
    (b" \tM\t 1   1  \r\n", b"OK M", M_ONE),
    (b"\n\r\n \n\t\n", b"", []),
    (b"m\n", b"ERR M needs 2 values", []),
    (b"\x03M 1 1\n", b"ERR unknown command", []),
    (b"M 1 1 " + b"x" * 250 + b"\n", b"OK M", M_ONE),  # 256 bytes
    (b"M 1 1 " + b"x" * 251 + b"\n", b"WARN line too long", []),
)


def test_what_a_line_does():
    for line, answer, commands in OBEYED:
        assert obeyed(line) == (answer + b"\r\n" * bool(answer), commands), line


def test_an_unfinished_line_is_dropped_after_200_ms_of_silence():
    calls = Recorder()
    calls.give(b"M 0.9")
    calls.lines.rest(1000)
    calls.lines.rest(1199)
    assert calls.lines.length == 5
    calls.lines.rest(1200)
    assert calls.lines.length == 0
    assert calls.give(b"M 0 0\n") == b"OK M\r\n"
    assert calls.commands == [("M", [0.0, 0.0, 0.0, 0.0, 0.0])]


def test_a_line_too_long_is_discarded_and_reported_once():
    calls = Recorder()
    assert calls.give(b"M 1 1 " + b"x" * 1000) == b"WARN line too long\r\n"
    assert calls.give(b"M 1 1\nM 0.5 0.5\n") == b"OK M\r\n"
    assert calls.commands == [("M", [0.5, 0.5, 0.0, 0.0, 0.0])]


#: Texts and the numbers that they are; those of many digits nearly so.
NUMBERS = (
    (b"0.5", 0.5), (b"-.25", -0.25), (b"+1.", 1.0), (b"0.930", 0.93), (b"12.125", 12.125),
    (b"0." + b"3" * 200, 1 / 3), (b"0" * 200 + b"1", 1.0), (b"0." + b"0" * 200 + b"1", 0.0),
)  # fmt: skip


def test_numbers():
    for text, expected in NUMBERS:
        assert abs(number(text, 0, len(text)) - expected) < 1e-6, text
    for sign, limit in ((b"", 1.0), (b"-", -1.0)):
        text = sign + b"9" * 200
        assert clamp(number(text, 0, len(text)), -1.0) == limit
    assert clamp(-2.0, 0.0) == 0.0
    assert clamp(0.25, 0.0) == 0.25


def test_a_host_that_does_not_read_loses_whole_lines():
    calls = Recorder()
    lines = calls.lines
    for _ in range(20):
        lines.put(b"T a0=512 a1=512 a2=512")
    assert calls.received() == b"T a0=512 a1=512 a2=512\r\n" * 5
    calls.give(b"M 1 1\n")
    assert calls.commands, "it is obeyed all the same"


def test_noise_among_lines():
    calls = Recorder()
    value = 1
    known = 0
    for _ in range(5_000):
        for _ in range(8):
            value = (value * 1103515245 + 12345) & 0x3FFFFFFF
            calls.lines.take(value >> 16 & 0xFF)
        calls.lines.first = calls.lines.used = 0
        for letter, numbers in calls.commands:
            known += letter in "MLF"
            assert all(-1e9 <= one <= 1e9 for one in numbers)
        calls.commands = []
    assert calls.give(b"\nM 0.5 0.5\n")[-6:] == b"OK M\r\n"
    assert known < 5_000


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


def test_known_vectors():
    assert crc16(b"123456789 and more", 9) == 0x29B1
    assert received(b"\0\0" + DESCRIBE_REQ + b"\0" + CMD) == [(0x02, 0, 0), (0x20, 3, 1)]
    sender = Sender(512)
    assert sender.send(0x02, 0, 0, 0, b"")
    assert taken(sender) == DESCRIBE_REQ
    assert sender.send(0x20, 3, 1, 0, b"\x01")
    assert taken(sender) == CMD


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
    for sequence in range(3):
        assert sender.send(0x10, 1, sequence, 0, b"")
    assert [plain(frame + b"\0")[5] for frame in taken(sender).split(b"\0")[:-1]] == [0, 1, 2], "several wait"


def test_what_is_refused():
    assert received(host_frame(0x31, version=2)) == []
    assert received(host_frame(0x31)[:-2] + b"\x55\0") == []
    assert received(stuffed(b"")) == []
    assert received(stuffed(b"\xff\xff")) == []
    assert received(stuffed(b"\x01" * 14)) == []
    assert received(b"\xff\x01\0") == []
    assert received(b"\x05\x01\0") == []


def test_frames_of_every_length_up_to_160_bytes():
    decoder = Decoder()
    for count in range(140):
        frame = host_frame(0x20, count, 7 * count, b"x" * count if count % 2 else bytes(count))
        assert received(frame, decoder) == [(0x20, count, 7 * count)]
    assert len(host_frame(0x20, payload=b"x" * 144)) == 161
    assert received(host_frame(0x20, payload=b"x" * 144), decoder) == [(0x20, 0, 0)]
    assert received(host_frame(0x20, payload=b"x" * 145), decoder) == []
    assert received(b"x" * 5000 + b"\0" + DESCRIBE_REQ, decoder) == [(0x02, 0, 0)]


def test_noise_among_frames():
    noise = Noise(3)
    decoder = Decoder()
    sound = 0
    for _ in range(5_000):
        sound += len(received(noise.bytes(noise.next(24)) + b"\0", decoder))
    assert sound < 5, "a CRC of 16 bits lets one of 65,536 pass"
    assert received(CMD, decoder) == [(0x20, 3, 1)]
