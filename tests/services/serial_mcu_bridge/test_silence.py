"""The silence of a board that reports at rest means something; that of others does not."""

from __future__ import annotations

import pytest

from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.line.silence import Silence
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, Type, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.host import Session

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
