"""The silence of a board that reports at rest means something; that of others does not."""

from __future__ import annotations

from types import ModuleType

import pytest

from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.line.silence import Silence
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, Type, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.host import Session
from pebble.services.serial_mcu_bridge.text import goob_base, imu_mpu6050
from pebble.services.serial_mcu_bridge.text.device_log import is_known

#: Per second: r received at rest, d received while it was driven, . nothing, o opened again, x the device has gone.
CASES = {
    "never heard": ("." * 30, "ready", None),
    "Goob and Fred, who report at rest": ("r" * 30, "ready", 0),
    "a pause": ("rrrrrr...", "ready", 1000),
    "it hangs": ("rrrrr..........", "silent", 10_000),
    "it sends again": ("rrrrr..........r", "ready", 0),
    "heard once, at its start": ("r" + "." * 30, "ready", 10_000),
    "a start of four seconds": ("rrrr" + "." * 30, "ready", 10_000),
    "it answers to commands only": ("d" * 30 + "." * 30, "ready", 10_000),
    "it reports its battery every 3 s": ("r.." * 10 + "." * 10, "ready", 10_000),
    "regular, driven, then dead": ("rrrrr" + "d" * 9 + "." * 10, "silent", 10_000),
    "opened again, not heard": ("rrrrro" + "." * 20, "ready", None),
    "opened again, heard": ("rrrrror", "ready", 0),
    "gone": ("rrrrrx", "absent", None),
}


@pytest.mark.parametrize(("seconds", "state", "silent_ms"), CASES.values(), ids=CASES)
def test_silence(seconds: str, state: str, silent_ms: int | None) -> None:
    silence, opened, received, found = Silence(), 1, 0, ("", None)
    for now, second in enumerate(seconds, start=100):
        opened += second == "o"
        received = 0 if second == "o" else received + 20 * (second in "rd")
        line = LineState.ABSENT if second == "x" else LineState.READY
        found = silence.check(line, opened, received, float(now), idle=second != "d")
    assert found == (state, silent_ms)


#: Of each protocol what its board sends, and what else comes on a line: noise, echoes, other programs.
KNOWN = {
    goob_base: [b"T a0=1 a1=2 a2=3", b"T t0=1 t1=2 t2=3 chg=1", b"C chg=0 v=7.5", b"C v=7.5\r", b"OK M", b"WARN late",
                b"ERR speed", b"Done!"],
    imu_mpu6050: [b"I n=1 ms=2 ax=0 ay=0 az=1 gx=0 gy=0 gz=0 t=20 r=0 p=0"],
}  # fmt: skip
NOISE = [b"", b"\r", b" ", b"\0", b"\xff\xfe\x80", b"\x00\xf8\x00\xf8", b"~", b"M 0.000 0.000", b"L 0.000 0.000 0.000",
         b"T", b"C", b"T a0=1", b"T a0=x a1=2 a2=3", b"C v=nan", b"C v=", b"TC v=7", b"OKAY", b"ok", b"Done", b"I n=1",
         b">>> ", b"Traceback (most recent call last):", b"SyntaxError: invalid syntax", b"login:", b"garbage",
         bytes(range(128, 256))]  # fmt: skip


@pytest.mark.parametrize("protocol", KNOWN)
def test_only_lines_of_the_protocol_count_as_received_from_its_board(protocol: ModuleType) -> None:
    def understood(line: bytes) -> bool:
        found = protocol.parse(line)
        reports = found if isinstance(found, list) else [found] if found is not None else []
        return any(map(is_known, reports))

    assert [line for line in KNOWN[protocol] if not understood(line)] == []
    others = [line for other, lines in KNOWN.items() for line in lines if other is not protocol]
    assert [line for line in (*NOISE, *others) if understood(line)] == []


ECHO = Frame(Type.PING, sequence=1)
FRAMES = {
    "an answer": (encode(Frame(Type.PONG)), 1),
    "a log line": (encode(Frame(Type.LOG, b"hello")), 1),
    "a reading before the manifest": (encode(Frame(Type.SAMPLE, b"x", 1)), 1),
    "two": (encode(Frame(Type.PONG)) + encode(Frame(Type.LOG, b"hello")), 2),
    "an echo of what the host sends": (encode(ECHO), 0),
    "a damaged one": (encode(Frame(Type.PONG))[:-2] + b"\x01\0", 0),
    "no frame": (b"C chg=0 v=7.5\n\0", 0),
    "zeros": (b"\0" * 64, 0),
    "noise": (bytes(range(255, 0, -1)) * 40 + b"\0", 0),
}


@pytest.mark.parametrize(("data", "frames"), FRAMES.values(), ids=FRAMES)
def test_only_frames_of_a_device_count_as_received_from_it(data: bytes, frames: int) -> None:
    session = Session()
    session.opened(0.0)
    session.feed(data, 1.0)
    assert session.frames == frames
