"""Groups of commands at a motor owner: one write on the serial line, or nothing."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from pebble.services.serial_mcu_bridge.line.outbox import Outbox
from tests.services.serial_mcu_bridge.motor_rig import STOP, STOPPED, Bench
from tests.support import until

DRIVE, LIGHTS = {"z": 0.5}, {"r": 0.2, "g": 0.7, "b": 1}
_COLOURS = (number / 1000 for number in count(1))  # each once
MOVED, LIT = "M 0.500 0.500", "L 1.000 0.700 0.200"


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    bench = Bench(tmp_path_factory.mktemp("groups"), "goob", groups=True)
    yield bench
    bench.close()


def lines_of(bench: Bench, metric: str, body: Any, least: int = 1) -> list[str]:
    """The lines that a command brings, ``least`` if any, after those of a zero and before those of plain lights."""
    bench.drive(0.0)
    assert bench.shines(b=next(_COLOURS))
    before = len(bench.lines)
    bench.send(metric, body)
    until(lambda: len(bench.lines) >= before + least, 0.3)  # the next lights replace those that wait
    assert bench.shines(b=next(_COLOURS))
    return bench.lines[before:-1]


@pytest.mark.parametrize(
    ("metric", "body", "lines"),
    [
        ("group", {"drive-values": DRIVE, "lights-solid": LIGHTS}, [MOVED, LIT]),
        ("group", {"lights-solid": LIGHTS, "drive-values": DRIVE}, [MOVED, LIT]),
        ("group", {"drive-values": {"z": 0}, "lights-solid": LIGHTS}, [STOPPED, LIT]),
        ("group", {"drive-values": DRIVE}, [MOVED]),
        ("group", {"lights-solid": LIGHTS}, [LIT]),
        ("group", {"soundboard-command": {"action": "stop"}}, []),
        ("group", {"drive-values": DRIVE, "lights-solid": LIGHTS, "warp": {}}, []),
        ("group", {"drive-values": DRIVE, "lights-solid": LIGHTS, "estop-reset": {"boot": "", "count": 1}}, []),
        ("group", {"drive-values": {"z": 0.5, "key": "stranger"}, "lights-solid": LIGHTS}, []),
        ("drive-values", DRIVE | {"group": True}, []),
        ("drive-values", {"z": 0, "group": True}, [STOPPED]),
        ("lights-solid", LIGHTS | {"group": True}, []),
        ("lights-flash", LIGHTS | {"group": True}, []),
    ],
)
def test_a_group_is_obeyed_at_once_and_its_copies_are_not(
    bench: Bench, metric: str, body: Any, lines: list[str]
) -> None:
    brought = lines_of(bench, metric, body, len(lines) or 1)
    assert list(dict.fromkeys(brought)) == lines, "a zero may be repeated"


def test_no_member_is_obeyed_while_the_robot_is_stopped(bench: Bench) -> None:
    bench.send("estop", STOP)
    assert bench.stopped()
    lines = lines_of(bench, "group", {"drive-values": DRIVE, "lights-solid": LIGHTS})
    bench.reset()
    assert set(lines) <= {STOPPED}


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


def test_without_the_key_groups_are_nothing_and_copies_are_commands(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "goob")
    try:
        assert MOVED not in lines_of(bench, "group", {"drive-values": DRIVE, "lights-solid": LIGHTS})
        assert MOVED in lines_of(bench, "drive-values", DRIVE | {"group": True})
    finally:
        bench.close()
