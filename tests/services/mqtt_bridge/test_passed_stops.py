"""A stop is passed on until every motor owner has confirmed it, and stops have a connection of their own: rows.

What becomes of it at whole robots, on both transports, is tried by tests/robot; what an owner obeys in
tests/services/serial_mcu_bridge/test_control.py.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from itertools import groupby
from typing import Any

import pytest
from msgspec import UNSET
from msgspec.structs import replace

from pebble.contract import ESTOP, ESTOP_STATE, codec
from pebble.contract.payloads import EstopCommand, EstopState
from pebble.extensions.fleet.robot_audit import Audit
from pebble.services.mqtt_bridge.passed_stops import NAMES, STATE_S, PassedStops, is_named, named
from pebble.transports import State
from tests.ext.thin.test_thin import flood
from tests.forwarding.virtual import World
from tests.support import Clock

STOP = "incoming/estop"
NAME = {letter: letter * 16 for letter in "abc"}
FREE = EstopState(
    latched=False, boot="00000001", count=0, recent=[], by="", why="", since=0, persisted=True, reset_refused=None
)  # fmt: skip


def payload(letter: str, **fields: Any) -> bytes:
    return codec.encode(ESTOP, EstopCommand(stop=NAME[letter], **fields))


class Robot:
    """The bridge's memory of some owners, and their newest states, in histories of words.

    ``a`` a stop comes; ``serial+a`` this owner names it and has saved it, ``?`` has not, ``*`` cannot, ``-`` was reset;
    ``serial0`` it restarts free, ``serial!`` withdraws its state; ``bridge`` restarts; ``fill`` 1,023 other stops come;
    ``3s`` time passes; ``=a>serial,tail`` is what is repeated now, ``:…`` what the last stop was passed to.
    """

    def __init__(self, owners: tuple[str, ...]) -> None:
        self.owners, self.now = owners, 100.0
        self.states = dict.fromkeys(owners, FREE)
        self.given_up: list[str] = []
        self.passed: list[bytes] = []
        self.bridge()

    def bridge(self) -> None:
        self.stops = PassedStops(self.owners, lambda: self.now)

    def do(self, word: str) -> None:
        self.now += 0.01
        if word in NAME:
            self.passed = self.stops.accept(payload(word))
        elif word == "bridge":
            self.bridge()
        elif word == "fill":
            for number in range(NAMES - 1):
                self.stops.accept(codec.encode(ESTOP, EstopCommand(stop=f"{number:016x}")))
        elif word[-1] == "s" and word[:-1].isdigit():
            self.now += int(word[:-1])
            self.given_up += [f"{stop.stop}>{owner}"[15:] for owner, stop in self.stops.give_up()]
        elif word[0] in "=:":
            assert _addresses(self.stops.repeat() if word[0] == "=" else self.passed) == word[1:], word
        else:
            self._tell(word.rstrip("+?*-!0abc"), word)

    def _tell(self, owner: str, word: str) -> None:
        mark, letter = word.removeprefix(owner)[:1], word.removeprefix(owner)[1:]
        before = self.states[owner]
        if mark == "!":
            self.stops.follow(owner, None)
            return
        if mark == "0":
            state = replace(FREE, boot=f"{int(before.boot) + 1:08}")
        else:
            new = NAME[letter] not in before.recent
            state = replace(
                before,
                latched=mark != "-",
                count=before.count + new,
                recent=[NAME[letter], *before.recent] if new else before.recent,
                persisted={"?": False, "*": None}.get(mark, True),
            )
        self.states[owner] = state
        self.stops.follow(owner, state)


def _addresses(payloads: list[bytes]) -> str:
    stops = [codec.decode(ESTOP, one) for one in payloads]
    return ",".join(f"{str(stop.stop)[0]}>{'all' if stop.owner is UNSET else stop.owner}" for stop in stops)


ONE, TWO = ("serial",), ("serial", "tail")
MEMBERS: dict[str, tuple[tuple[str, ...], str]] = {
    "a single owner": (ONE, "a :a>all =a>serial serial?a =a>serial serial+a = a ="),
    "two owners": (TWO, "a =a>serial,a>tail serial+a =a>tail tail?a =a>tail tail+a ="),
    "one that was never heard": (ONE, "a 300s =a>serial"),
    "a new stop after a reset": (ONE, "a serial+a serial-a b :b>all =b>serial"),
    "frozen, a newer state before it": (ONE, "a serial+b =a>serial serial+a ="),
    "of an owner that restarts": (ONE, "serial0 a =a>serial serial0 =a>serial serial+a ="),
    "killed before its file is written": (ONE, "a serial?a serial0 =a>serial serial+a ="),
    "whose state shows it reset before it was saved": (ONE, "a serial?a serial-a ="),
    "that was reset by an older command at its thaw": (ONE, "serial+b a serial-b =a>serial serial+a ="),
    "that cannot save": (ONE, "a serial*a = serial0 ="),
    "the newest counts": (ONE, "a b =b>serial"),
    "newest is who was passed first last": (ONE, "a b a =b>serial serial+b ="),
    "a bridge that restarts forgets": (TWO, "a bridge ="),
    "a withdrawn owner gets nothing, and may come back": (TWO, "a serial! =a>tail 59s serial0 =a>serial,a>tail"),
    "a withdrawn owner is given up": (TWO, "serial! a 59s serial! 1s serial0 =a>tail a :a>all"),
    "a copy after a reset goes to nobody": (ONE, "a serial+a serial-a a : ="),
    "a copy goes to the owner that was not reset": (TWO, "a serial+a tail+a serial-a a :a>tail"),
    "a copy replaces no newer stop, whose owner has shown the copied one": (
        ONE,
        "serial+a bridge serial?b b a =b>serial",
    ),
    "a copy that waits passes": (TWO, "a serial?a b serial?b serial-b b :b>tail"),
    "a restart proves no reset": (ONE, "a serial+a serial0 a :a>all =a>serial"),
    "names have a bound, stops have none": (ONE, "a serial+a serial-a fill a : b a :a>all =b>serial"),
}


@pytest.mark.parametrize(("owners", "history"), MEMBERS.values(), ids=MEMBERS)
def test_it_is_repeated_until_confirmed(owners: tuple[str, ...], history: str) -> None:
    robot = Robot(owners)
    for word in history.split():
        robot.do(word)


def test_a_stop_that_is_given_up_is_told_once() -> None:
    robot = Robot(TWO)
    for word in ("a", "serial!", "60s", "1s", "serial!", "99s"):
        robot.do(word)
    assert robot.given_up == ["a>serial"]


@pytest.mark.parametrize(
    ("raw", "by", "why"),
    [
        (b"{}", "", ""),
        (b'{"stop": "x", "by": "ann", "why": "dog"}', "ann", "dog"),
        (b"x" * 100_000, "", ""),
        (b" \n", "", ""),  # echo | mosquitto_pub -s
    ],
)
def test_one_without_a_name_gets_one(raw: bytes, by: str, why: str) -> None:
    first, second = (codec.decode(ESTOP, named(raw)) for _ in range(2))
    assert (first.by, first.why, len(first.stop), is_named(raw)) == (by, why, 16, False)
    assert first.stop != second.stop


@pytest.mark.parametrize("raw", [b"", payload("a"), b'{"stop": "aaaaaaaaaaaaaaaa", "more": 1}'])
def test_what_has_a_name_or_is_no_stop_passes_as_it_is(raw: bytes) -> None:
    assert named(raw) == raw
    assert PassedStops(ONE, lambda: 0.0).accept(raw) == [raw]


def test_only_the_bridge_says_for_whom_one_is() -> None:
    assert named(payload("a", owner="tail", by="ann")) == payload("a", by="ann")


def test_the_bridge_repeats_it_on_the_robots_side_only(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World("bridge", monkeypatch)
    serial, tail = ({"enabled": True, "serial": {"port": f"/dev/{name}"}} for name in TWO)
    world.start(serial={**serial, "instances": {"tail": tail}})
    world.run()
    world.local.publish("incoming/flags/remote-mirror", b"true", retain=True)
    world.run()
    world.remote.publish(STOP, b"{}")
    world.run(1.9)
    first, *repeated = [codec.decode(ESTOP, one) for one in world.local.payloads(STOP)]
    assert first.owner is UNSET
    assert [stop.owner for stop in repeated[:4]] == ["serial", "tail"] * 2
    assert {stop.stop for stop in repeated} == {first.stop}
    for owner in TWO:
        state = replace(FREE, latched=True, count=1, recent=[first.stop])
        world.local.publish(ESTOP_STATE.topic("", owner=owner)[1:], codec.encode(ESTOP_STATE, state), retain=True)
    world.run(1)
    before = len(world.local.on(STOP))
    world.run(3)
    assert len(world.local.on(STOP)) == before
    assert not world.remote.on(STOP)


@pytest.mark.parametrize(
    ("presses", "boot", "counts", "persisted", "repeats"),
    [
        ("-", "00000001", [1], True, False),
        ("-", "00000001", [1], False, False),  # it is saved later, or comes again after a restart
        ("-", "00000002", [1], True, True),
        ("--", "00000001", [1], True, True),  # which of them was received is not known
        ("--", "00000001", [1, 2], True, False),
        ("c-", "00000001", [1], True, True),  # the owner has received the other one, or this one
        ("---", "00000001", [1, 2], True, True),
    ],
)
def test_without_a_name_an_owner_that_lives_and_saves_it_gets_it_once(
    presses: str, boot: str, counts: list[int], persisted: bool, repeats: bool
) -> None:
    clock = Clock()
    stops = PassedStops(ONE, clock)
    stops.follow("serial", FREE)
    for press in presses:
        stops.accept(payload("c") if press == "c" else named(b"{}"), nameless=press == "-")
    assert not stops.repeat(), "a state may be under way: a repetition before it would be another stop"
    clock.now += STATE_S
    assert stops.repeat()
    for count in counts:
        state = replace(FREE, boot=boot, latched=True, count=count, recent=[NAME["b"]], persisted=persisted)
        stops.follow("serial", state)
    assert bool(stops.repeat()) is repeats


@pytest.mark.parametrize("one", [True, False])
def test_one_of_the_robots_own_side_is_repeated_too(one: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World("bridge", monkeypatch, one=one)
    world.start(serial={"enabled": True, "serial": {"port": "/dev/serial"}})
    world.run()
    world.local.publish(STOP, b"{}")
    world.run(1.9)
    first, *repeated = [codec.decode(ESTOP, raw) for raw in world.local.payloads(STOP) if raw != b"{}"]
    assert len(repeated) >= 2
    assert {(stop.stop, stop.owner) for stop in (first, *repeated)} == {(first.stop, "serial")}
    state = replace(FREE, latched=True, count=1, recent=[first.stop])
    world.local.publish(ESTOP_STATE.topic("", owner="serial")[1:], codec.encode(ESTOP_STATE, state), retain=True)
    world.run(1)
    before = len(world.local.on(STOP))
    world.run(3)
    assert len(world.local.on(STOP)) == before


def test_what_a_withdrawn_owner_has_not_confirmed_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    world = World("bridge", monkeypatch)
    world.start(serial={"enabled": True, "serial": {"port": "/dev/serial"}})
    world.run()
    told: list[tuple[str, object]] = []
    monkeypatch.setattr(Audit, "note", lambda _audit, what, **row: told.append((what, row.get("owner"))))
    world.remote.publish(STOP, b'{"by": "ann"}')
    world.run(0)
    before = len(world.local.on(STOP))
    world.local.publish(ESTOP_STATE.topic("", owner="serial")[1:], b"", retain=True)
    world.run(70)
    assert len(world.local.on(STOP)) <= before + 1
    assert [row for row in told if row[0] == "stop-not-confirmed"] == [("stop-not-confirmed", "serial")]
    assert "is not confirmed by serial" in caplog.text


def test_the_mirror_keeps_a_repetition_for_one_owner_on_the_robots_own_transport(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World("mirror", monkeypatch)
    world.start()
    world.run()
    for stop in (payload("a", owner="tail"), payload("b"), b"\xff"):
        world.local.publish(STOP, stop)
    world.run()
    assert world.remote.payloads(STOP) == [payload("b"), b"\xff"]


PRESS = b"?"  # without a name: each counts
OWN, NONE = "emergency stops have a connection of their own", "emergency stops have no connection of their own"


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    world = World("bridge", monkeypatch)
    world.run()
    start(world)
    world.run(10)
    return world


def start(world: World, level: str = "login") -> None:
    world.start(security={"level": level}, remote_mqtt={"host": "127.0.0.1"})


def words(world: World) -> dict[str, Callable[[], object]]:
    return {
        "press": lambda: world.remote.publish(STOP, PRESS),
        "press-retained": lambda: world.remote.publish(STOP, PRESS, retain=True),
        "flood": world.uplink.hold,  # another's messages are in front
        "drain": world.uplink.let_go,
        "drop": world.uplink.lose,
        "dead": world.stops.hold,  # and this is not known yet
        "known": lambda: (world.stops.lose(), world.stops.let_go(), world.stops.cut()),
        "no-stops": world.stops.cut,
        "stops": world.stops.mend,
        "skip": lambda: (world.stops.lose(), world.stops.let_go()),
        "65-presses": lambda: [world.remote.publish(STOP, PRESS) for _ in range(65)],
        "1025-presses": lambda: [world.remote.publish(STOP, PRESS) for _ in range(1025)],
        **{f"{seconds}s": partial(world.run, seconds) for seconds in (1, 2, 3, 59, 60)},
        "mirror": lambda: world.remote.publish("incoming/flags/remote-mirror", b"true", retain=True),
        "local-press": lambda: world.local.publish(STOP, PRESS),
        **world.interruptions(),
    }


@pytest.mark.parametrize(
    "history",
    [
        "press 1 press 2",
        "press-retained 1 cut mend flood press 2",  # there is no copy of an old one
        "flood press 1 press 2 drain 2 press 3",
        "flood press 1 59s drain 1",
        "flood press 1 60s drain 2",  # no flood is that long
        "dead press 1 skip flood 1s press 2",
        "flood 1025-presses 1025 drain 1026",
        "no-stops press 1 stops press 2",
        "flood no-stops press 0 drain 1",
        "flood press 1 no-stops drain 2",  # rather twice than not at all
        "flood press 1 drain 2s no-stops 2",
        "flood press 1 drain 3s no-stops 1",
        "cut press 1 mend press 2",
        "flood press 1 cut drain mend dead press 2",
        "flood press 1 drop press 2 drain 2",
        "flood press 1 drop drain dead press 1 known 2",
        "flood 65-presses 65 drop drain dead 65-presses 65 known 129",
        "dead press 1 known 1",
        "mirror local-press 0 press 1",
    ],
)
def test_each_counts_once(world: World, history: str) -> None:
    """A number is how many the robot has received by then."""
    for word in history.split():
        if word.isdigit():
            assert len(world.local.on(STOP)) == int(word), (word, world.local.seen)
        else:
            words(world)[word]()
            world.run(0.5)


def test_it_is_neither_made_where_everybody_is_let_in_nor_before_messages_are_forwarded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World("bridge", monkeypatch)
    world.run()
    for level, made in (("open", False), ("login", True)):
        start(world, level)
        assert (world.running[0].stops is not None) == made
        world.run(0)
        world.stop()
    start(world)
    assert world.stops.state is State.CLOSED
    assert world.stops.policy.is_stop(STOP), "it is never too late"


@pytest.mark.parametrize(
    ("denies", "tried", "why"),
    [
        (lambda world: world.stops.cut(), State.CONNECTING, "the hub is away"),
        (lambda world: world.stops.refuse(), State.CONNECTED, f"it refuses to deliver pebble/robots/rover/{STOP}"),
    ],
    ids=["no room", "no subscription"],
)
def test_a_broker_that_denies_it_costs_one_line_and_is_tried_every_ten_minutes(
    world: World, caplog: pytest.LogCaptureFixture, denies: Callable[[World], object], tried: State, why: str
) -> None:
    caplog.set_level(logging.INFO)
    states = []
    for second in range(1216):
        if second % 606 == 0:
            denies(world)
        world.run(1)
        states.append(world.stops.state)
    runs = [(state, len(list(seconds))) for state, seconds in groupby(states)]
    assert runs == [(tried, 5), (State.CLOSED, 600), (tried, 6), (State.CLOSED, 600), (tried, 5)]
    (line,) = [message for message in caplog.messages if message.startswith((OWN, NONE))]
    assert line.startswith(NONE)
    assert line.endswith(f": {why}")
    world.stops.mend()
    world.run(700)
    assert caplog.messages[-1] == OWN


@pytest.mark.parametrize(
    ("pauses", "ended", "state"),
    [
        ("2 2 2", True, State.CONNECTED),  # something else ends it
        ("0.5 0.5", True, State.CONNECTED),
        ("0.5 0.5 2 0.5 0.5 0.5", True, State.CLOSED),
        ("0.5 0.5 0.5", False, State.CONNECTED),
    ],
)
def test_who_may_connect_only_once_connects_once(
    world: World, caplog: pytest.LogCaptureFixture, pauses: str, ended: bool, state: State
) -> None:
    """The broker ends the older connection of the two, so many seconds after the newer one was made."""
    world.uplink.was_ended = ended
    for seconds in pauses.split():
        world.stops.cut()
        world.run(0.5)
        world.stops.mend()
        world.run(float(seconds))
        world.uplink.cut()
        world.run(0.5)
        world.uplink.mend()
        world.run(0.2)
    assert world.stops.state is state
    world.run(2000)
    assert world.stops.state is state
    warnings = [message for message in caplog.messages if message.startswith(NONE)]
    assert len(warnings) == (state is State.CLOSED)
    world.remote.publish(STOP, PRESS)
    world.run()
    assert len(world.local.on(STOP)) == 1


def test_over_a_thin_link_it_is_made_while_a_client_floods_it(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World("bridge", monkeypatch)
    world.start(security={"level": "login"}, remote_mqtt={"host": "127.0.0.1"}, link={"profile": "thin"})
    world.run()
    states = [world.stops.state]
    flood(world, "late 1.6")
    for _ in range(66):
        states.append(world.stops.state)
        world.run(1)
    runs = [(state, len(list(seconds))) for state, seconds in groupby(states)]
    assert runs == [(State.CLOSED, 2), (State.CONNECTED, 60), (State.CLOSED, 5)]
