"""Boards that send lines of text: what each line reports, which are not believed, and that no line raises anything.

goob_base_v1 is as in the firmware and host of the original Pebble, without two defects of that host: it uses only the
first report of a line, so it loses a voltage after a charging status; and it drives at full speed on NaN.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from itertools import product
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pebble.errors import PayloadError
from pebble.services.serial_mcu_bridge.imu import mpu6050 as imu_mpu6050
from pebble.services.serial_mcu_bridge.imu.mpu6050 import Motion, Summary
from pebble.services.serial_mcu_bridge.text import goob_base
from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine, is_known
from pebble.services.serial_mcu_bridge.text.goob_base import Charging, Level, Touch
from tests.support import cases

FAST = b"I n=17 ms=1234 ax=0.123 ay=-0.5 az=9.807 gx=1.25 gy=-2 gz=0.0001 t=25.5 r=1.5 p=-3.25"
SLOW = b"S n=18 ms=1300 r=1.5 p=-3.25 t=25.5 an=1.001 gbx=0.1 gby=-0.2 gbz=0.3 ok=1000 err=2 cal=200"
MOTION = {
    "ax": 0.123, "ay": -0.5, "az": 9.807, "gx": 1.25, "gy": -2.0, "gz": 0.0001,
    "temp_c": 25.5, "roll_deg": 1.5, "pitch_deg": -3.25,
}  # fmt: skip
SUMMARY = {
    "roll_deg": 1.5, "pitch_deg": -3.25, "temp_c": 25.5,
    "accel_norm_g": 1.001, "gyro_bias_x_dps": 0.1, "gyro_bias_y_dps": -0.2, "gyro_bias_z_dps": 0.3,
    "samples_ok": 1000, "samples_error": 2, "calibration_samples": 200,
}  # fmt: skip


def info(text: str) -> list[Any]:
    return [DeviceLogLine(logging.INFO, text)]


REPORTS: dict[ModuleType, dict[bytes, list[Any]]] = {
    goob_base: {
        b"T a0=-1 a1=4095 a2=0\r": [Touch(-1, 4095, 0)],
        b"T t0=1 t1=2 t2=3 chg=-1 v=7.1": [Touch(1, 2, 3), Charging(None), Level(7.1)],
        b"T  chg=1   t2=3 t1=2 t0=1": [Touch(1, 2, 3), Charging(True)],
        b"C chg=0 v=7.412": [Charging(False), Level(7.412)],
        b"C chg=0 v=nan": [Charging(False)],
        b"C chg=x v=8.": [Level(8.0)],
        b"T a0=1 a1=2 chg=1": [Charging(True)],
        b"OK M": [DeviceLogLine(logging.DEBUG, "OK M")],
        b"WARN odd": [DeviceLogLine(logging.WARNING, "WARN odd")],
        b"ERR unknown": [DeviceLogLine(logging.ERROR, "ERR unknown")],
        b"Done!\r": info("Done!"),
        b"t a0=1 a1=2 a2=3": info("t a0=1 a1=2 a2=3"),
        b" \r": [],
    },
    imu_mpu6050: {
        FAST + b"\r": [Motion(17, 1234, MOTION)],
        SLOW: [Summary(18, 1300, SUMMARY)],
        b"IMU n=1": info("IMU n=1"),
        b"\x07x": info("\N{REPLACEMENT CHARACTER}x"),
        b" \r": [],
    },
}


def without_a_number(line: bytes) -> Iterator[bytes]:
    """The line with each of its tokens replaced by what is not that key with a number."""
    kind, *tokens = line.split()
    for number, token in enumerate(tokens):
        key = token.split(b"=")[0]
        for wrong in (b"", key, key + b"=nan", key + b"=1e5", key + b"=1_0"):
            yield b" ".join([kind, *tokens[:number], wrong, *tokens[number + 1 :]])


NOT_UNDERSTOOD = {
    goob_base: [b"T", b"T a0=1 a1=2 a2=3.5", b"T a0=1 t1=2 a2=3", b"T a0=1_0 a1=2 a2=3", b"T a0=\xd9\xa1 a1=2 a2=3",
                b"T a0=99999999999999999999 a1=2 a2=3", b"T a0=1 a1=2 a2=3T", b"C v=1e400", b"C v=" + b"9" * 400],
    imu_mpu6050: [*without_a_number(FAST), *without_a_number(SLOW)],
}  # fmt: skip
PROTOCOLS = pytest.mark.parametrize("protocol", REPORTS, ids=lambda protocol: protocol.__name__.rpartition(".")[2])


def parsed(protocol: ModuleType, line: bytes) -> list[Any]:
    found = protocol.parse(line)
    return found if isinstance(found, list) else [found] if found is not None else []


@PROTOCOLS
def test_every_field_of_a_line_is_reported(protocol: ModuleType) -> None:
    assert {line: parsed(protocol, line) for line in REPORTS[protocol]} == REPORTS[protocol]


@PROTOCOLS
def test_a_report_without_a_usable_field_is_a_warning(protocol: ModuleType) -> None:
    for line in NOT_UNDERSTOOD[protocol]:
        (report,) = parsed(protocol, line)
        assert isinstance(report, DeviceLogLine), line
        assert report.level == logging.WARNING


#: Of each protocol what its board sends, and what else comes on a line: noise, echoes, other programs.
KNOWN = {
    goob_base: [b"T a0=1 a1=2 a2=3", b"T t0=1 t1=2 t2=3 chg=1", b"C chg=0 v=7.5", b"C v=7.5\r", b"OK M", b"WARN late",
                b"ERR speed", b"Done!"],
    imu_mpu6050: [b"I n=1 ms=2 ax=0 ay=0 az=1 gx=0 gy=0 gz=0 t=20 r=0 p=0"],
}  # fmt: skip
NOISE = [b"", b"\r", b"\0", b"\xff\xfe\x80", b"M 0.000 0.000", b"T", b"T a0=1", b"C v=nan", b"TC v=7", b"OKAY", b"ok",
         b"Done", b"I n=1", b">>> ", b"login:", bytes(range(128, 256))]  # fmt: skip


@PROTOCOLS
def test_only_lines_of_the_protocol_count_as_received_from_its_board(protocol: ModuleType) -> None:
    def understood(line: bytes) -> bool:
        return any(map(is_known, parsed(protocol, line)))

    assert [line for line in KNOWN[protocol] if not understood(line)] == []
    others = [line for other, lines in KNOWN.items() for line in lines if other is not protocol]
    assert [line for line in (*NOISE, *others) if understood(line)] == []


def check(reports: list[Any]) -> None:
    """Numbers are numbers, and what is logged is short and printable."""
    for report in reports:
        match report:
            case Level(volts):
                assert math.isfinite(volts)
            case Touch(a0, a1, a2):
                assert max(abs(a0), abs(a1), abs(a2)) < 2**31
            case Motion(_, _, values) | Summary(_, _, values):
                assert all(map(math.isfinite, values.values()))
            case DeviceLogLine(_, text):
                assert len(text) <= 220
                assert text.isprintable()


PIECES = [b"T", b"C", b" ", *(b"%s=" % key for key in (b"a0", b"a1", b"a2", b"t0", b"chg", b"v")),
          b"nan", b"inf", b"1e999", b"-", b"7", b"\0"]  # fmt: skip


WORDS = st.sampled_from([*PIECES, *FAST.split(), *SLOW.split()]) | st.binary(max_size=16)
GARBAGE = st.binary(max_size=300) | st.text(max_size=100).map(str.encode)


@settings(max_examples=cases(300, 5_000))
@given(
    st.sampled_from([goob_base, imu_mpu6050]),
    st.sampled_from([b"", b" "]).flatmap(lambda gap: st.lists(WORDS, max_size=16).map(gap.join)) | GARBAGE,
)
def test_any_line_can_be_parsed_and_reports_no_number_that_is_none(protocol: ModuleType, line: bytes) -> None:
    check(parsed(protocol, line))


# -- what is sent to goob_base_v1


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (goob_base.drive_line(-0.0001, 0.25), b"M 0.000 0.250\n"),
        (goob_base.drive_line(7, -1e300), b"M 1.000 -1.000\n"),
        (goob_base.STOP, b"M 0.000 0.000\n"),
        (goob_base.lights_line(-1, 2, 0.0004), b"L 0.000 1.000 0.000\n"),
        (goob_base.flash_line(0, 0.5, 9, 2), b"F 0.000 0.500 1.000 2.000\n"),
        (goob_base.flash_line(0, 0, 1, 0.001), b"F 0.000 0.000 1.000 0.050\n"),
        (goob_base.flash_line(0, 0, 1, 1e300), b"F 0.000 0.000 1.000 3600.000\n"),
        (goob_base.mix(0.5, 0.75), (1.0, 0.25)),
        (goob_base.mix(1.0, -1.0), (0.0, -1.0)),
    ],
)
def test_commands(line: object, expected: object) -> None:
    assert line == expected


@pytest.mark.parametrize(
    ("make", "count"),
    [(goob_base.mix, 2), (goob_base.drive_line, 2), (goob_base.lights_line, 3), (goob_base.flash_line, 4)],
)
def test_what_is_no_number_never_becomes_a_command(make: Callable[..., object], count: int) -> None:
    for place, bad in product(range(count), (math.nan, math.inf, -math.inf)):
        with pytest.raises(PayloadError):
            make(*(bad if at == place else 0.0 for at in range(count)))
