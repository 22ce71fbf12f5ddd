"""Hostile frames: nothing is raised, and valid frames among them are still decoded."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable

from pebble.services.serial_mcu_bridge.pebble_serial_v1 import frame
from pebble.services.serial_mcu_bridge.pebble_serial_v1.host import Described, Gone, Reading, RefusedInput, Session
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import IMU, STATION, M
from tests.support import cases

FRAMES = cases(10_000, 200_000)
GROUP = 500

_BODIES = [
    wire.body(wire.HELLO, STATION.hello()),
    wire.body(wire.HELLO, IMU.hello()),
    wire.body(wire.DESCRIBE, STATION.describe()),
    wire.body(wire.DESCRIBE, IMU.describe()),
    wire.body(wire.STATE, b"\1\0\1", 2, 7, 8),
    wire.body(wire.SAMPLE, bytes(range(18)), 1, 7, 8),
    wire.body(wire.ACK, b"", 1, 1),
    wire.body(wire.NACK, b"no\xff", 1, 1),
    wire.body(wire.LOG, "grüße".encode()),
    wire.body(wire.PONG),
]
_FRAMES = [wire.sealed(body) for body in _BODIES]
GOOD = wire.frame(wire.DESCRIBE, STATION.describe()) + wire.frame(wire.STATE, b"\1\0\1", 2, 7, 8)


def mutated(raw: bytes, chance: random.Random) -> bytes:
    damaged = bytearray(raw)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(damaged) + 1)
        how = chance.randrange(4)
        if how == 0 and at < len(damaged):
            damaged[at] = chance.randrange(256)
        elif how == 1:
            del damaged[at : at + chance.randint(1, 8)]
        elif how == 2:
            damaged[at:at] = chance.randbytes(chance.randint(1, 8))
        elif at < len(damaged):
            damaged[at] ^= 1 << chance.randrange(8)
    return bytes(damaged)


def sealed(body: bytes) -> bytes:
    """Add a valid checksum and valid stuffing, so that the content is parsed."""
    return frame.stuff(body + frame.crc(body).to_bytes(2, "little")) + b"\0"


ATTACKS: list[Callable[[random.Random], bytes]] = [
    lambda chance: mutated(chance.choice(_FRAMES), chance),
    lambda chance: sealed(mutated(chance.choice(_BODIES), chance)),
    lambda chance: chance.randbytes(chance.randint(0, 80)) + b"\0",
    lambda chance: sealed(b"\1" + chance.randbytes(chance.randint(0, 60))),
    lambda chance: sealed(
        wire.body(chance.randrange(256), chance.randbytes(chance.randint(0, 40)), chance.randrange(6))
    ),
]


def test_hostile_frames() -> None:
    chance, session, seen = random.Random(20), Session(), Counter[str]()
    session.opened(0.0)
    sent = 0
    for group in range(FRAMES // GROUP):
        now = float(group)
        attack = b"".join(chance.choice(ATTACKS)(chance) for _ in range(GROUP))
        sent += GROUP
        for event in session.feed(attack, now):
            if isinstance(event, RefusedInput):
                seen[event.subject] += 1
                assert event.reason
        session.tick(now, group)
        events = session.feed(b"\0" + GOOD, now)
        assert isinstance(events[-1], Reading), f"no reading after {sent} frames: {events}"
        assert events[-1].values == {"bound": True, "reachable": False, "on": True}
        assert session.manifest is not None
        assert session.manifest.uid == STATION.uid
    assert sent == FRAMES
    assert {"stuffing", "crc", "short", "version", "type", "hello", "describe", "state", "sample"} <= set(seen)
    assert len(seen) < 20, "the number of error kinds is small"


def test_devices_that_change_all_the_time_leave_nothing_behind() -> None:
    session = Session()
    session.opened(0.0)
    events = []
    for number in range(500):
        manifest = M(f"u{number}", STATION.interfaces, hash=f"h{number}")
        events += session.feed(wire.frame(wire.HELLO, manifest.hello()), 1.0)
        events += session.feed(wire.frame(wire.DESCRIBE, manifest.describe()), 1.0)
    assert sum(isinstance(event, Described) for event in events) == 500
    assert sum(isinstance(event, Gone) for event in events) == 499
    assert len(session.known) == 16
