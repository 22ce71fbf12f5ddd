"""What Goob's IMU tells about itself."""

import struct

from common.frames import Sender, crc16
from goob_imu.manifest import MANIFEST


class Reader:
    def __init__(self, data):
        self.data, self.at = data, 0

    def take(self, layout):
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def text(self):
        (size,) = self.take("<B")
        self.at += size
        return self.data[self.at - size : self.at].decode()


def interfaces(reader, count):
    for _ in range(count):
        numbers = reader.take("<HBBBH")
        names = reader.text(), reader.text(), reader.text()
        encoding, size = reader.take("<BB")
        fields = []
        for _ in range(size):
            name = reader.text()
            kind, scale, offset = reader.take("<Bff")
            fields.append((name, kind, round(1 / scale), offset, reader.text()))
        yield numbers, names, encoding, fields


def test_it_is_that_of_the_original_but_for_the_board():
    reader = Reader(MANIFEST)
    assert reader.take("<BB") == (1, 2)
    schema, uid, firmware, model = reader.text(), reader.text(), reader.text(), reader.text()
    assert (uid, model) == ("goob-imu", "seeed-xiao-samd21")
    assert firmware.count(".") == 2
    assert reader.at == 49, "so long is HELLO, see robot.py"
    rest = MANIFEST[reader.at :]
    assert schema == f"goob-imu-{crc16(rest, len(rest)):04x}", "it changes with the interfaces"
    fast, slow = interfaces(reader, 2)
    assert reader.at == len(MANIFEST)
    centi = [(name, 5, 100, 0.0) for name in ("gx", "gy", "gz", "temp_c", "roll_deg", "pitch_deg")]
    assert fast[:3] == ((1, 2, 1, 2, 100), ("imu_fast", "sensors/imu-fast", "imu.motion.v1"), 1)
    assert [field[:4] for field in fast[3]] == [(name, 5, 1000, 0.0) for name in ("ax", "ay", "az")] + centi
    assert [field[4] for field in fast[3]] == ["mps2"] * 3 + ["dps"] * 3 + ["c"] + ["deg"] * 2
    assert slow[:3] == ((2, 2, 2, 0, 5), ("imu", "sensors/imu", "imu.summary.v1"), 1)
    biases = [(f"gyro_bias_{axis}_dps", 5, 100, 0.0) for axis in "xyz"]
    counts = [("samples_ok", 6, 1, 0.0), ("samples_error", 6, 1, 0.0), ("calibration_samples", 4, 1, 0.0)]
    assert slow[3][0] == ("accel_norm_g", 4, 1000, 0.0, "g")
    assert [field[:4] for field in slow[3][1:]] == biases + counts


def test_it_fits_the_ring_of_the_board():
    sender = Sender(512)  # as in robot.py
    assert sender.send(3, 0, 0xFFFFFFFF, 0x3FFFFFFF, MANIFEST)
