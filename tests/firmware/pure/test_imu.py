"""From the MPU-6050's raw numbers to what goes to the host."""

import struct
from math import cos, pi, sin

from goob_imu.imu import Imu

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


def test_attitude_at_once_after_the_start():
    for degrees in (-170, -80, 0, 45, 80, 120):
        bench = Bench()
        angle = degrees * pi / 180
        bench.device.raw[1], bench.device.raw[2] = int(G * sin(angle)), int(G * cos(angle))
        bench.sample(2)
        assert near(bench.imu.values[7], degrees * 100, 5)
        assert near(bench.imu.values[8], 0, 5)
        if abs(degrees) < 90:
            bench = Bench()
            bench.device.raw[0], bench.device.raw[2] = int(-G * sin(angle)), int(G * cos(angle))
            bench.sample(2)
            assert near(bench.imu.values[8], degrees * 100, 5)


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
