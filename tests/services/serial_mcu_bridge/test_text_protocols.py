"""Boards that send lines of text: what each line reports, which are not believed, and that no line raises anything.

goob_base_v1 is as in the firmware and host of the original Pebble, without two defects of that host: it uses only the
first report of a line, so it loses a voltage after a charging status; and it drives at full speed on NaN.
Also what waits to be sent on a line, how long its board is silent, and how often it starts.
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
from pebble.services.serial_mcu_bridge.line.outbox import Outbox
from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.line.silence import Silence
from pebble.services.serial_mcu_bridge.line.starts import Starts
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, Type, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.host import Session
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
    for report in parsed(protocol, line):
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


DRIVE = ("drive", b"drive", 10.0, 0.75)
#: What is put in, when what is taken out.
LINES: dict[str, tuple[list[tuple[Any, ...]], list[tuple[float, bytes | None]]]] = {
    "only the newest of a kind is left, and driving goes first": (
        [step for n in range(1000) for step in (("put", "lights", b"L%d" % n), ("drive", b"%d" % n, 0.0, 0.75))],
        [(0.1, b"999"), (0.1, b"L999"), (0.1, None)],
    ),
    "a drive line that waited too long is a stop": ([DRIVE], [(10.76, b"stop"), (10.76, None)]),
    "it may be valid for less than the timeout": ([("drive", b"drive", 10.0, 0.1)], [(10.11, b"stop")]),
    "but not for longer": ([("drive", b"drive", 10.0, 5.0)], [(10.76, b"stop")]),
    "the stop and the lights never expire": (
        [DRIVE, ("halt",), ("put", "lights", b"lights")], [(1e9, b"stop"), (1e9, b"lights")],
    ),
    "a command after the stop counts": ([("halt",), DRIVE], [(10.0, b"drive")]),
    "nothing is left once it was cleared": ([DRIVE, ("clear",)], [(10.0, None)]),
}  # fmt: skip


@pytest.mark.parametrize(("steps", "taken"), LINES.values(), ids=LINES)
def test_what_is_sent(steps: list[tuple[Any, ...]], taken: list[tuple[float, bytes | None]]) -> None:
    outbox = Outbox(b"stop", 0.75)
    for name, *arguments in steps:
        getattr(outbox, name)(*arguments)
    assert [(now, outbox.take(now)) for now, _ in taken] == taken
    assert not outbox.waiting


def test_what_waits_with_a_drive_line_shares_its_fate() -> None:
    stop, group = b"M 0 0\n", b"M 1 1\nL 1 0 0\n"
    outbox = Outbox(stop, 0.75)
    for act, now, lines in [
        (lambda: outbox.drive(group, 0.0, 0.4, "lights"), 0.3, [group]),
        (lambda: outbox.drive(group, 0.0, 0.4, "lights"), 0.5, [stop]),
        (outbox.halt, 0.1, [stop]),
        (lambda: outbox.drive(b"M 2 2\n", 0.0, 0.4), 0.1, [b"M 2 2\n"]),
        (lambda: outbox.put("lights", b"L 0 0 1\n"), 0.1, [group, b"L 0 0 1\n"]),
    ]:
        outbox.put("lights", b"L 0 1 0\n")  # older: the lights of the group replace it
        outbox.drive(group, 0.0, 0.4, "lights")
        act()
        taken = [outbox.take(now) for _ in range(2)]
        assert [line for line in taken if line] == lines


#: Per second: r received at rest, d received while it was driven, . nothing, o opened again, x the device has gone.
SILENCES = {
    "never heard": ("." * 30, "ready", None),
    "Goob and Fred, who report at rest": ("r" * 30, "ready", 0),
    "a pause": ("rrrrrr...", "ready", 1000),
    "it hangs": ("rrrrr..........", "silent", 10_000),
    "a start of four seconds": ("rrrr" + "." * 30, "ready", 10_000),
    "it answers to commands only": ("d" * 30 + "." * 30, "ready", 10_000),
    "it reports its battery every 3 s": ("r.." * 10 + "." * 10, "ready", 10_000),
    "regular, driven, then dead": ("rrrrr" + "d" * 9 + "." * 10, "silent", 10_000),
    "opened again, not heard": ("rrrrro" + "." * 20, "ready", None),
    "opened again, heard": ("rrrrror", "ready", 0),
    "gone": ("rrrrrx", "absent", None),
}


@pytest.mark.parametrize(("seconds", "state", "silent_ms"), SILENCES.values(), ids=SILENCES)
def test_silence(seconds: str, state: str, silent_ms: int | None) -> None:
    silence, opened, received, found = Silence(), 1, 0, ("", None)
    for now, second in enumerate(seconds, start=100):
        opened += second == "o"
        received = 0 if second == "o" else received + 20 * (second in "rd")
        line = LineState.ABSENT if second == "x" else LineState.READY
        found = silence.check(line, opened, received, float(now), idle=second != "d")
    assert found == (state, silent_ms)


FRAMES = {
    "a log line and another frame": (encode(Frame(Type.LOG, b"hello")) + encode(Frame(Type.PONG)), 2),
    "a reading before the manifest": (encode(Frame(Type.SAMPLE, b"x", 1)), 1),
    "an echo of what the host sends": (encode(Frame(Type.PING, sequence=1)), 0),
    "a damaged one": (encode(Frame(Type.PONG))[:-2] + b"\x01\0", 0),
    "no frame": (b"C chg=0 v=7.5\n\0", 0),
    "noise": (bytes(range(255, 0, -1)) * 40 + b"\0", 0),
}


@pytest.mark.parametrize(("data", "frames"), FRAMES.values(), ids=FRAMES)
def test_only_frames_of_a_device_count_as_received_from_it(data: bytes, frames: int) -> None:
    session = Session()
    session.opened(0.0)
    session.feed(data, 1.0)
    assert session.frames == frames


#: What happens at each time: "open" the line, "start" what the board says, or what its clock shows; and the count then.
STARTS = {
    "one opening": ([(0, "open")], 1, 0),
    "the line comes and goes": ([(0, "open"), (5, "open"), (10, "open")], 11, 2),
    "it says so": ([(0, "open"), (5, "start"), (10, "start"), (15, "start")], 16, 3),
    "one start has several signs": ([(0, "open"), (5, "open"), (6.5, "start"), (6.6, 40)], 7, 1),
    "its clock begins anew": ([(0, "open"), (1, 60_000), (5, 300), (9, 4_300), (12, 10)], 13, 2),
    "its clock wraps": ([(0, "open"), (1, 2**32 - 5), (2, 1_000)], 3, 0),
    "samples overtake one another": ([(0, "open"), (1, 60_000), (2, 59_500)], 3, 0),
    "it never runs for a second": ([(0, "open"), (1, 800), (1.1, 0), (3.9, 700), (4, 10), (7, 900), (7.1, 30)], 8, 3),
    "its clock is that of another opening": ([(0, "open"), (1, 60_000), (5, "open"), (5.1, 10)], 6, 1),
    "long ago": ([(0, "open"), (5, "start"), (30, "start")], 66, 1),
}


@pytest.mark.parametrize(("events", "at", "count"), STARTS.values(), ids=STARTS)
def test_starts_within_a_minute(events: list[tuple[float, str | int]], at: float, count: int) -> None:
    starts, opened = Starts(), 0
    for now, event in events:
        opened += event == "open"
        does = {"open": lambda _now: None, "start": starts.began}.get(event)
        (does or (lambda now, event=event, opened=opened: starts.sent(opened, event, now)))(now)
        starts.within_a_minute(opened, now)
    assert starts.within_a_minute(opened, at) == count
