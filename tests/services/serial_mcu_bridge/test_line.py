"""What a serial line keeps in mind: the newest line of a kind, how long its board is silent, how often it starts."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.services.serial_mcu_bridge.line.outbox import Outbox
from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.line.silence import Silence
from pebble.services.serial_mcu_bridge.line.starts import Starts
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, Type, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.host import Session

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


ECHO = Frame(Type.PING, sequence=1)
FRAMES = {
    "a log line and another frame": (encode(Frame(Type.LOG, b"hello")) + encode(Frame(Type.PONG)), 2),
    "a reading before the manifest": (encode(Frame(Type.SAMPLE, b"x", 1)), 1),
    "an echo of what the host sends": (encode(ECHO), 0),
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
