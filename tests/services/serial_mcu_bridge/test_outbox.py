"""The newest line of a kind replaces older ones, and an expired drive line becomes the stop."""

from typing import Any

import pytest

from pebble.services.serial_mcu_bridge.line.outbox import Outbox

DRIVE = ("drive", b"drive", 10.0, 0.75)
#: What is put in, when what is taken out.
HISTORIES: dict[str, tuple[list[tuple[Any, ...]], list[tuple[float, bytes | None]]]] = {
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


@pytest.mark.parametrize(("steps", "taken"), HISTORIES.values(), ids=HISTORIES)
def test_what_is_sent(steps: list[tuple[Any, ...]], taken: list[tuple[float, bytes | None]]) -> None:
    outbox = Outbox(b"stop", 0.75)
    for name, *arguments in steps:
        getattr(outbox, name)(*arguments)
    assert [(now, outbox.take(now)) for now, _ in taken] == taken
    assert not outbox.waiting
