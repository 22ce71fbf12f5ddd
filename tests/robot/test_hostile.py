"""Malformed messages: nothing dies, nothing moves, and refusals are reported."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.contract import CHANNELS, ESTOP, INCOMING
from tests.robot.rig import Rig
from tests.support import cases, until

MESSAGES = cases(1_600, 20_000)
CHUNK = 800  # messages before waiting for a sign that the robot has read them: less than any queue on the way holds

#: No channel accepts one of these.
GARBAGE = (
    *(b"\xff\xfe\0", b"not json", b"[1, 1]", b"1", b"-0", b'"true"', b'"on"', b"null", b"[true]", b"TRUE", b"1.5e308"),
    *(b"[" * 3000, b'{"value":' * 2000, b"[" * 3000 + b"]" * 3000, b'{"x": 1, "value": true, "n": "\xff\xfe"}'),
    *(b'{"value": {"x": 0.5, "z": 0.5, "action": "pl', b'{"x": 1', b'{"x": "' + b"9" * 900),
)

#: Without emergency stops: there garbage is a stop, too (tests/services/serial_mcu_bridge).
_TARGETS = [
    channel
    for channel in CHANNELS
    if channel.direction == INCOMING and channel.payload is not bytes and channel is not ESTOP
]


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with Rig(request.param, mcu="goob") as rig:
        yield rig


@pytest.mark.timeout(180)
def test_malformed_messages(rig: Rig) -> None:
    kinds = itertools.cycle(itertools.product(GARBAGE, _TARGETS))
    processes, memory, began = rig.processes(), _memory(rig), time.monotonic()
    for first in range(0, MESSAGES, CHUNK):
        for raw, channel in itertools.islice(kinds, CHUNK):
            topic = channel.suffix.format(uid="u", name="n", outlet="o1", robot="r")
            rig.operator.send(topic, raw, qos=0)
        assert _still_responds(rig, first / MESSAGES), f"no response after {first + CHUNK} messages"
    assert rig.processes() == processes
    assert not rig.mcu.moving(began)
    assert rig.recorded() == []
    assert _memory(rig) - memory < 30 * 1024, "memory grew by more than 30 MB"
    assert until(lambda: any("refused" in seen.json["message"] for seen in rig.operator.on("outgoing/logs", began)))
    assert rig.stop() == 0
    assert "refused in all: {" in rig.log.read_text()


def _still_responds(rig: Rig, shade: float) -> bool:
    """A good message behind all the bad ones still arrives."""
    began = time.monotonic()
    rig.operator.send("incoming/lights-solid", {"g": round(shade, 3)})
    line = f"L 0.000 {shade:.3f} 0.000"
    return until(lambda: any(entry.line == line for entry in rig.mcu.entries(began)))


def _memory(rig: Rig) -> int:
    """Resident memory of all the robot's processes, KB."""
    pages = sum(int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in rig.processes().values())
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024
