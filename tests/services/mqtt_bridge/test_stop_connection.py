"""The connection that stops have of their own: in virtual time, a broker that may hold up what others send."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from itertools import groupby

import pytest

from pebble.transports import State
from tests.ext.thin.test_thin import flood
from tests.forwarding.virtual import World

STOP, PRESS = "incoming/estop", b"?"  # without a name: each counts
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
