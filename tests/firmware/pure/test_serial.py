"""The board's side of goob_base_v1 and of pebble_serial_v1."""

import random
import struct

from common.frames import Decoder, Sender, crc16
from common.lines import Lines, clamp, number
from goob_imu.imu import Imu


def taken(sender):
    """Return what is on its way, and forget it."""
    size = len(sender.ring)
    data = bytes([sender.ring[(sender.first + index) % size] for index in range(sender.used)])
    sender.first = (sender.first + sender.used) % size
    sender.used = 0
    return data


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
        return taken(self.lines)


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
    (b"m 9 -9 spare\n", b"OK M", [("M", [9.0, -9.0])]),
    (b"M nan inf\n", b"OK M", [("M", [0.0, 0.0])]),
    (b"M x 0.5y\n", b"OK M", [("M", [0.0, 0.5])]),
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
    assert taken(lines) == b"T a0=512 a1=512 a2=512\r\n" * 5
    calls.give(b"M 1 1\n")
    assert calls.commands, "it is obeyed all the same"


def noise(count):
    return bytes([random.getrandbits(8) for _ in range(count)])


DESCRIBE_REQ = bytes([3, 1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 3, 0x85, 0x6B, 0])
CMD = bytes([3, 1, 0x20, 2, 3, 2, 1, 1, 1, 1, 1, 1, 1, 4, 1, 0x9B, 0x7C, 0])


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


def test_known_vectors():
    assert crc16(b"123456789 and more", 9) == 0x29B1
    assert received(b"\0\0" + DESCRIBE_REQ + b"\0" + CMD) == [(0x02, 0, 0), (0x20, 3, 1)]
    sender = Sender(512)
    assert sender.send(0x02, 0, 0, 0, b"")
    assert taken(sender) == DESCRIBE_REQ
    assert sender.send(0x20, 3, 1, 0, b"\x01")
    assert taken(sender) == CMD


def test_sent_frames_decode_to_their_content():
    random.seed(7)
    sender = Sender(512)
    for count in range(400):
        sequence, now = random.getrandbits(16), random.getrandbits(16)
        data = noise(count) if count % 3 else bytes([1 + count % 255]) * count
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


# -- from the MPU-6050's raw numbers to what goes to the host


G = 8192  # LSB
DPS = 65.5  # LSB


class Device:
    """Lies flat and at rest by default; fails ``failures`` times."""

    def __init__(self):
        self.raw = [0, 0, G, 0, 0, 0, 0]
        self.failures = 0
        self.starts = 0
        self.right = True

    def start(self):
        self.starts += 1
        self._maybe_fail()
        return self.right

    def read(self, data):
        self._maybe_fail()
        struct.pack_into(">7h", data, 0, *self.raw)

    def _maybe_fail(self):
        if self.failures:
            self.failures -= 1
            raise OSError(5)


class Bench:
    def __init__(self):
        self.device = Device()
        self.messages = []
        self.now = 0
        self.imu = Imu(self.device, self.messages.append)

    def sample(self, count=1):
        """How many of ``count`` samples, 10 ms apart, brought something."""
        good = 0
        for _ in range(count):
            good += self.imu.read(self.now)
            self.now = (self.now + 10) & (1 << 30) - 1
        return good


def near(value, wanted, off):
    return abs(value - wanted) <= off


def test_units():
    bench = Bench()
    bench.device.raw = [G // 2, -G, G, 0, 655, -1310, 131]
    bench.sample(2)
    ax, ay, az, gx, gy, gz, celsius, _, _ = bench.imu.values
    assert near(ax, 4903, 1)
    assert near(ay, -9807, 1)
    assert near(az, 9807, 1)
    assert near(gx, 1000, 1)
    assert near(gy, -2000, 1)
    assert near(gz, 200, 1)
    assert celsius == 3653
    bench.device.raw[3] = -340 * 50
    bench.sample()
    assert bench.imu.values[6] == -1347


def test_what_the_wire_cannot_hold_is_cut_off():
    bench = Bench()
    bench.device.raw = [32767, -32768, 32767, 0, 32767, -32768, 32767]
    bench.sample(300)
    assert bench.imu.calibrated == 0, "nothing at rest turns like this"
    assert bench.imu.values[:6] == [32767, -32768, 32767, 32767, -32768, 32767]
    struct.pack("<9h", *bench.imu.values)


def test_it_learns_the_bias_of_the_gyroscope_at_rest():
    bench = Bench()
    bench.device.raw = [0, 0, G, 0, 79, -52, 29]
    bench.sample(210)
    assert bench.imu.calibrated == 200 - 1  # one turn set it up, ten samples came first
    assert near(bench.imu.values[3], 121, 1), "until then it is as measured"
    bench.sample(2)
    assert bench.imu.calibrated == 200
    assert near(bench.imu.bias[0], 121, 1)
    assert near(bench.imu.bias[1], -79, 1)
    assert near(bench.imu.bias[2], 44, 1)
    assert bench.imu.values[3:6] == [0, 0, 0]
    assert bench.messages == [b"imu_ready"]
    bench.device.raw[4] += 655
    bench.sample()
    assert near(bench.imu.values[3], 1000, 1)


def test_it_does_not_learn_while_it_is_moved():
    bench = Bench()
    bench.sample(150)
    bench.device.raw[6] = 6550
    bench.sample(5)
    bench.device.raw[6] = 0
    bench.sample(100)
    assert bench.imu.calibrated < 200
    bench.sample(110)
    assert bench.imu.calibrated == 200
    assert bench.imu.bias == [0, 0, 0]


def test_free_fall_keeps_the_attitude():
    bench = Bench()
    bench.device.raw = [0, 1000, 1000, 0, 0, 0, 0]
    bench.sample(5)
    bench.device.raw = [0, 0, 0, 1, 0, 0, 0]
    bench.sample(5)
    assert near(bench.imu.values[7], 4500, 5)


def test_a_failure_is_logged_and_a_device_that_fell_asleep_or_is_another_is_set_up_anew():
    bench = Bench()
    bench.sample(10)
    bench.device.failures = 1
    assert bench.sample(10) == 9
    assert (bench.imu.failed, bench.device.starts) == (1, 1)
    bench.device.raw = [0] * 7  # all its registers are 0 then, and it answers
    assert bench.sample(104) == 0
    bench.device.raw = [0, 0, G, 0, 0, 0, 0]
    assert bench.sample(11) == 10
    assert bench.messages == [b"imu_ready"] + [b"imu_read_failed"] * 2 + [b"imu_reinit"]
    bench = Bench()
    bench.device.right = False
    assert bench.sample(101) == 0
    assert bench.messages == [b"imu_init_failed"] * 2


def test_the_ticks_may_wrap():
    bench = Bench()
    bench.now = (1 << 30) - 500
    bench.device.failures = 1
    assert bench.sample(101) == 0
    assert bench.sample(212) == 212
    bench.device.raw[4] = int(100 * DPS)
    bench.sample(1)
    assert 90 < bench.imu.values[7] <= 100


def test_pitch_ends_upright_however_it_turns():
    bench = Bench()
    bench.device.raw = [0, 0, G, 0, 0, 30_000, 0]
    bench.imu.calibrated = 200
    for gap in (10, 490):
        for _ in range(100):
            bench.now += gap
            bench.imu.read(bench.now)
        assert -9000 <= bench.imu.values[8] <= 9000
