"""The host's side of pebble_serial_v1, without a serial line and without a clock; hostile frames raise nothing."""

from __future__ import annotations

import logging
import random
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from pebble.errors import PayloadError
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, decode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.host import (
    ANSWER_S,
    SILENCE_S,
    WAITING,
    Answer,
    Described,
    Event,
    Gone,
    Reading,
    RefusedInput,
    Send,
    Session,
)
from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import IMU, STATION, M
from tests.support import cases

OPENED = 100.0
WALL_MS = 1_700_000_000_123


class Host:
    """A session, the current time, its events and the frames that it sent."""

    def __init__(self) -> None:
        self.session = Session()
        self.now = OPENED
        self.events: list[Event] = []
        self.sent: list[tuple[float, Frame]] = []
        self.session.opened(OPENED)

    def feed(self, *frames: bytes) -> list[Event]:
        return self._take(self.session.feed(b"".join(frames), self.now))

    def until(self, when: float) -> None:
        """Advance the time to ``when``, with a tick each time the session is due."""
        while (due := self.session.due) is not None and due <= when:
            assert due > self.now - 1e-9
            self.now = max(self.now, due)
            self._take(self.session.tick(self.now, WALL_MS))
        self.now = when

    def describe(self, manifest: M = STATION) -> None:
        self.feed(wire.frame(wire.DESCRIBE, manifest.describe()))

    def of(self, kind: type) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]

    def asked(self) -> list[float]:
        return [round(at - OPENED, 3) for at, frame in self.sent if frame.type == wire.DESCRIBE_REQ]

    def command(self, name: str, values: dict[str, Any]) -> Frame:
        manifest = self.session.manifest
        assert manifest is not None
        interface = next(one for one in manifest.interfaces if one.name == name)
        send = self.session.commands([(interface, values)], self.now, WALL_MS)
        self._take([send])
        return self.sent[-1][1]

    def _take(self, events: list[Event]) -> list[Event]:
        self.events += events
        for event in events:
            if isinstance(event, Send):
                assert event.data.endswith(b"\0")
                (stuffed,) = filter(None, event.data.split(b"\0"))
                self.sent.append((self.now, decode(stuffed)))
        return events

    def refused(self, *frames: bytes) -> str:
        """Feed what yields nothing but one refusal; return its subject."""
        (refused,) = self.feed(*frames)
        assert isinstance(refused, RefusedInput)
        return refused.subject


@pytest.fixture
def host() -> Host:
    return Host()


def state(interface: int = 2, payload: bytes = b"\1\0\1", sequence: int = 9, ms: int = 77) -> bytes:
    return wire.frame(wire.STATE, payload, interface, sequence, ms)


# -- discovery


HELLO = wire.frame(wire.HELLO, STATION.hello())


def test_when_it_requests_the_manifest(host: Host) -> None:
    """A second after opening and then every two; soon after a hello it does not know, however often that comes."""
    host.until(OPENED + 8)
    assert host.asked() == [1.0, 3.0, 5.0, 7.0]
    assert host.of(Send)[0].data.startswith(b"\0"), "an earlier host may have been killed in the middle of a frame"
    host.describe()
    host.until(OPENED + 12)
    assert host.asked() == [1.0, 3.0, 5.0, 7.0]
    greeted, repeated = Host(), Host()
    greeted.until(OPENED + 0.3)
    greeted.feed(HELLO)
    greeted.until(OPENED + 2)
    assert greeted.asked() == [0.55]
    for tenth in range(30):
        repeated.until(OPENED + tenth / 10)
        repeated.feed(HELLO)
    assert len(repeated.asked()) >= 2
    assert repeated.asked()[0] == 0.25


def test_a_known_hello_makes_a_device_usable_at_once(host: Host) -> None:
    host.describe()
    assert host.feed(HELLO) == [], "that of a reboot changes nothing"
    assert host.session.closed() == [Gone("the line is gone")]
    host.session.opened(host.now)
    (described,) = host.feed(HELLO)
    assert described == host.of(Described)[0]
    assert [type(event) for event in host.feed(state())] == [Reading]
    host.until(host.now + 4)
    assert host.asked() == []


def test_any_difference_in_a_hello_asks_again_and_another_manifest_replaces_everything(host: Host) -> None:
    host.describe()
    other = M("other", (wire.I(7, "lamp", wire.OUT, wire.KIND_STATE, (wire.F("on", wire.BOOL),)),))
    events = host.feed(wire.frame(wire.HELLO, STATION.but(firmware="1.1").hello()))
    assert [type(event) for event in events] == [Gone]
    assert host.refused(state()) == "early"
    host.until(host.now + 0.3)
    assert host.asked() == [0.25]
    host.describe()
    events = host.feed(wire.frame(wire.DESCRIBE, other.describe()))
    assert [type(event) for event in events] == [Gone, Described]
    assert host.refused(state()) == "state"
    (reading,) = host.feed(state(7, b"\1"))
    assert isinstance(reading, Reading)
    assert reading.values == {"on": True}
    assert host.feed(wire.frame(wire.DESCRIBE, other.describe())) == [], "the same manifest again has no effect"


def test_readings_that_do_not_fit_make_it_ask_but_not_every_time(host: Host) -> None:
    host.describe()
    for tenth in range(50):
        host.until(OPENED + tenth / 10)
        host.feed(state(interface=99))
        host.until(OPENED + tenth / 10 + 0.05)
        host.describe()
    assert host.asked() == [0.0], "one request within ten seconds"


def test_a_manifest_that_cannot_be_used_is_refused_and_asked_for_again(host: Host) -> None:
    """The original Pebble's reader thread ends by bad text in a hello."""
    host.until(OPENED + 1)
    assert host.refused(wire.frame(wire.DESCRIBE, STATION.describe()[:-1])) == "describe"
    assert "DESCRIBE refused" in host.events[-1].reason  # type: ignore[union-attr]
    host.until(OPENED + 3.5)
    assert host.asked() == [1.0, 3.0]
    host.refused(wire.frame(wire.HELLO, M(b"\xff\xff").hello()))
    assert "not UTF-8" in host.events[-1].reason  # type: ignore[union-attr]
    host.describe()
    assert host.of(Described)


# -- readings


@pytest.mark.parametrize(
    ("frame", "subject"),
    [
        (state(interface=1), "state"),  # a command, which sends no values
        (state(interface=99), "state"),
        (state(payload=b"\1\2\3\4"), "state"),
        (wire.frame(wire.CMD, b"\1", 1, 1), "cmd"),
        (wire.frame(wire.NACK, b"why", 1, 12345), "nack"),
    ],
)
def test_frames_that_make_no_sense_are_refused_and_counted_by_name(host: Host, frame: bytes, subject: str) -> None:
    host.describe()
    assert host.refused(frame) == subject
    assert isinstance(host.feed(state())[0], Reading)


def test_a_frame_without_end_and_half_a_frame_from_before_the_replug_are_discarded(host: Host) -> None:
    host.describe()
    events = host.feed(*(b"\x55" * 1000 for _ in range(20)))
    assert [event.subject for event in events if isinstance(event, RefusedInput)] == ["too long"]
    assert [type(event) for event in host.feed(b"\0", state())] == [Reading]
    host.feed(state()[:6])
    host.session.closed()
    host.session.opened(host.now)
    assert not [event for event in host.feed(state()[6:]) if not isinstance(event, RefusedInput)]
    (line,) = host.feed(wire.frame(wire.LOG, b"imu_ready \x1b[31m \xff"))
    assert line == DeviceLogLine(logging.INFO, "imu_ready \N{REPLACEMENT CHARACTER}[31m \\xff")


# -- commands


def test_a_command_becomes_a_frame_and_answers_find_their_command(host: Host) -> None:
    host.describe()
    first = host.command("o2_set", {"on": True})
    assert (first.type, first.interface, first.payload) == (wire.CMD, 3, b"\1")
    assert first.timestamp == WALL_MS % 2**32
    second = host.command("o1_set", {"on": False})
    assert second.sequence == first.sequence + 1
    with pytest.raises(PayloadError, match="o1_set: on is missing"):
        host.command("o1_set", {})
    assert host.feed(wire.frame(wire.NACK, b"busy", 1, second.sequence)) == [
        Answer("o1_set", second.sequence, False, "busy")
    ]
    assert host.feed(wire.frame(wire.ACK, b"", 3, first.sequence)) == [Answer("o2_set", first.sequence, True)]
    assert host.refused(wire.frame(wire.ACK, b"", 3, first.sequence)) == "ack", "a command is answered once"


def test_groups_wait_in_eight_places_whatever_they_set(host: Host) -> None:
    host.describe()
    assert host.session.manifest is not None
    first, second = (one for one in host.session.manifest.interfaces if one.name in ("o1_set", "o2_set"))
    kinds = [
        host.session.commands([(one, {"on": True}) for one in order], host.now, WALL_MS).kind
        for order in [(first, second), (second, first)] * 20
    ]
    assert len(set(kinds)) == WAITING
    assert host.session.commands([(first, {"on": True})], host.now, WALL_MS).kind not in kinds


def test_commands_without_an_answer_are_reported_and_not_remembered_for_ever(host: Host) -> None:
    """At most eight commands of each interface wait to be sent, independently of those of others."""
    host.describe()
    command = host.command("o1_set", {"on": True})
    host.until(host.now + ANSWER_S - 0.01)
    assert host.of(Answer) == []
    host.until(host.now + 0.1)
    assert host.of(Answer) == [Answer("o1_set", command.sequence, None)]
    for _ in range(1000):
        for name in ("o1_set", "o2_set"):
            host.command(name, {"on": True})
    host.until(host.now + ANSWER_S)
    assert len(host.of(Answer)) == 65
    waiting = [{event.kind for event in host.of(Send) if event.kind.startswith(f"command {n}/")} for n in (1, 3)]
    assert [len(kinds) for kinds in waiting] == [8, 8]


# -- silence


def test_a_silent_device_is_pinged_and_then_counts_as_gone(host: Host) -> None:
    host.describe()
    began = host.now
    host.until(began + 14.9)
    pings = [at - began for at, frame in host.sent if frame.type == wire.PING]
    assert pings == pytest.approx([5.0, 10.0])
    assert host.of(Gone) == []
    host.until(began + SILENCE_S)
    assert [gone.why for gone in host.of(Gone)] == ["has been silent for 15 s"]
    host.until(began + 20)
    assert host.asked() == [15.0, 17.0, 19.0]
    host.describe()
    assert len(host.of(Described)) == 2
    count = len(host.sent)
    for second in range(21, 60):  # one that sends is not pinged, and one that answers stays
        host.until(began + second)
        if second < 40:
            host.feed(state())
            assert len(host.sent) == count
        elif host.sent[-1][0] > host.now - 1:
            host.feed(wire.frame(wire.PONG))
    assert len(host.of(Gone)) == 1
    assert len(host.sent) > count + 2


FRAMES = cases(5_000, 200_000)
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


ATTACKS: list[Callable[[random.Random], bytes]] = [
    lambda chance: mutated(chance.choice(_FRAMES), chance),
    lambda chance: wire.sealed(mutated(chance.choice(_BODIES), chance)),
    lambda chance: chance.randbytes(chance.randint(0, 80)) + b"\0",
    lambda chance: wire.sealed(b"\1" + chance.randbytes(chance.randint(0, 60))),
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
    for number in range(50):
        manifest = M(f"u{number}", STATION.interfaces, hash=f"h{number}")
        events += session.feed(wire.frame(wire.HELLO, manifest.hello()), 1.0)
        events += session.feed(wire.frame(wire.DESCRIBE, manifest.describe()), 1.0)
    assert sum(isinstance(event, Described) for event in events) == 50
    assert sum(isinstance(event, Gone) for event in events) == 49
    assert len(session.known) == 16
