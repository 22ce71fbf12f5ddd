"""goob_base_v1 as in the firmware and host of the original Pebble, without two defects of that host.

That host uses only the first report of a line, so it loses a voltage after a charging status; and it drives at full
speed on NaN.
"""

import logging
import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pebble.errors import PayloadError
from pebble.services.serial_mcu_bridge.text import goob_base
from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine
from pebble.services.serial_mcu_bridge.text.goob_base import Charging, Level, Report, Touch, parse

NOT_NUMBERS = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize(
    ("line", "reports"),
    [
        (b"T a0=512 a1=498 a2=7", [Touch(512, 498, 7)]),
        (b"T a0=512 a1=498 a2=7\r", [Touch(512, 498, 7)]),
        (b"T a0=-1 a1=4095 a2=0", [Touch(-1, 4095, 0)]),
        (b"T t0=1 t1=2 t2=3 chg=1", [Touch(1, 2, 3), Charging(True)]),
        (b"T t0=1 t1=2 t2=3 chg=0", [Touch(1, 2, 3), Charging(False)]),
        (b"T t0=1 t1=2 t2=3 chg=-1 v=7.1", [Touch(1, 2, 3), Charging(None), Level(7.1)]),
        (b"T  chg=1   t2=3 t1=2 t0=1", [Touch(1, 2, 3), Charging(True)]),
        (b"C chg=-1 v=7.412", [Charging(None), Level(7.412)]),
        (b"C v=7.4", [Level(7.4)]),
        (b"C chg=0", [Charging(False)]),
        (b"C chg=0 v=nan", [Charging(False)]),
        (b"C chg=0 v=inf", [Charging(False)]),
        (b"C chg=x v=8.", [Level(8.0)]),
        (b"T a0=1 a1=2 chg=1", [Charging(True)]),
        (b"OK M", [DeviceLogLine(logging.DEBUG, "OK M")]),
        (b"WARN odd", [DeviceLogLine(logging.WARNING, "WARN odd")]),
        (b"ERR unknown", [DeviceLogLine(logging.ERROR, "ERR unknown")]),
        (b"Starting setup...", [DeviceLogLine(logging.INFO, "Starting setup...")]),
        (b"Done!\r", [DeviceLogLine(logging.INFO, "Done!")]),
        (b"OKAY", [DeviceLogLine(logging.INFO, "OKAY")]),
        (b"t a0=1 a1=2 a2=3", [DeviceLogLine(logging.INFO, "t a0=1 a1=2 a2=3")]),
        (b"M 1.000 1.000", [DeviceLogLine(logging.INFO, "M 1.000 1.000")]),
        (b"", []),
        (b" \r", []),
    ],
)
def test_every_field_of_a_line_is_reported(line: bytes, reports: list[Report]) -> None:
    assert parse(line) == reports


@pytest.mark.parametrize(
    "line",
    [
        b"T",
        b"C",
        b"T a0=1 a1=2 a2=three",
        b"T a0=1 a1=2 a2=3.5",
        b"T a0=1 t1=2 a2=3",
        b"T a0=1_0 a1=2 a2=3",
        b"T a0=\xd9\xa1 a1=2 a2=3",
        b"T a0=99999999999999999999 a1=2 a2=3",
        b"T a0=1 a1=2 a2=3T",
        b"C v=1e400",
        b"C v=" + b"9" * 400,
        b"C =1 v= chg",
    ],
)
def test_a_report_without_a_usable_field_is_a_warning(line: bytes) -> None:
    (report,) = parse(line)
    assert isinstance(report, DeviceLogLine)
    assert report.level == logging.WARNING
    assert report.text.startswith("not understood: ")


def test_device_log_lines_are_short_and_printable() -> None:
    (report,) = parse(b"\x00\xff\x1b[31m" + "ä\n".encode() * 10_000)
    assert isinstance(report, DeviceLogLine)
    assert len(report.text) == 200
    assert report.text.isprintable()
    assert "\\xff" in report.text


def test_garbage_never_raises_and_never_reports_what_is_no_number() -> None:
    random_bytes = random.Random(1)
    pieces = [
        b"T",
        b"C",
        b" ",
        b"a0=",
        b"a1=",
        b"a2=",
        b"t0=",
        b"chg=",
        b"v=",
        b"nan",
        b"inf",
        b"1e999",
        b"-",
        b"7",
        b"\0",
    ]
    for _ in range(100_000):
        line = b"".join(random_bytes.choices(pieces, k=12)) + random_bytes.randbytes(random_bytes.randrange(16))
        _check(parse(line))


@settings(max_examples=300)
@given(st.binary(max_size=300) | st.text(max_size=100).map(str.encode))
def test_any_line_can_be_parsed(line: bytes) -> None:
    _check(parse(line))


def _check(reports: list[Report]) -> None:
    for report in reports:
        match report:
            case Level(volts):
                assert math.isfinite(volts)
            case Touch(a0, a1, a2):
                assert max(abs(a0), abs(a1), abs(a2)) < 2**31
            case DeviceLogLine(_, text):
                assert len(text) <= 220
                assert text.isprintable()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (goob_base.drive_line(0.25, -1.0), b"M 0.250 -1.000\n"),
        (goob_base.drive_line(-0.0001, 0), b"M 0.000 0.000\n"),
        (goob_base.drive_line(7, -1e300), b"M 1.000 -1.000\n"),
        (goob_base.STOP, b"M 0.000 0.000\n"),
        (goob_base.lights_line(1, 0.5, 0), b"L 1.000 0.500 0.000\n"),
        (goob_base.lights_line(-1, 2, 0.0004), b"L 0.000 1.000 0.000\n"),
        (goob_base.flash_line(0, 0, 1, 2), b"F 0.000 0.000 1.000 2.000\n"),
        (goob_base.flash_line(0, 0, 9, 0.001), b"F 0.000 0.000 1.000 0.050\n"),
        (goob_base.flash_line(0, 0, 1, 1e300), b"F 0.000 0.000 1.000 3600.000\n"),
    ],
)
def test_commands(line: bytes, expected: bytes) -> None:
    assert line == expected


@pytest.mark.parametrize(
    ("x", "z", "wheels"),
    [
        (0.0, 1.0, (1.0, 1.0)),
        (0.5, 0.0, (0.5, -0.5)),
        (0.5, 0.75, (1.0, 0.25)),
        (1.0, -1.0, (0.0, -1.0)),
        (-1.0, -1.0, (-1.0, 0.0)),
        (0.0, 0.0, (0.0, 0.0)),
    ],
)
def test_mixing(x: float, z: float, wheels: tuple[float, float]) -> None:
    assert goob_base.mix(x, z) == wheels


@pytest.mark.parametrize("bad", NOT_NUMBERS)
@pytest.mark.parametrize(
    ("make", "count"),
    [(goob_base.mix, 2), (goob_base.drive_line, 2), (goob_base.lights_line, 3), (goob_base.flash_line, 4)],
)
def test_what_is_no_number_never_becomes_a_command(make: Callable[..., object], count: int, bad: float) -> None:
    for place in range(count):
        values = [0.0] * count
        values[place] = bad
        with pytest.raises(PayloadError):
            make(*values)
