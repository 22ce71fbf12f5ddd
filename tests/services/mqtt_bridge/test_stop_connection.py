"""The connection that stops have of their own: in virtual time, a broker that may hold up what others send."""

from __future__ import annotations

import logging
from collections.abc import Callable

import pytest

from pebble.transports import State
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
        "long": lambda: world.run(70),
        "mirror": lambda: world.remote.publish("incoming/flags/remote-mirror", b"true", retain=True),
        "local-press": lambda: world.local.publish(STOP, PRESS),
        **world.interruptions(),
    }


@pytest.mark.parametrize(
    "history",
    [
        "press 1 press 2",
        "press-retained 1 press 2",
        "flood press 1 press 2 drain 2 press 3",
        "flood press 1 long drain 2",  # no flood is that long
        "no-stops press 1 stops press 2",
        "flood no-stops press 0 drain 1",
        "flood press 1 no-stops drain 2",  # rather twice than not at all
        "cut press 1 mend press 2",
        "flood press 1 cut mend press 2",
        "flood press 1 drop press 2 drain 2",
        "flood press 1 drop drain dead press 1 known 2",
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


def test_a_broker_without_room_for_it_costs_one_line(world: World, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    world.stops.cut()
    world.run(2000)
    found = [record.message for record in caplog.records if record.message.startswith((OWN, NONE))]
    assert len(found) == 1
    assert found[0].startswith(NONE)
    assert world.stops.state is State.CLOSED
    world.stops.mend()
    world.run(700)
    assert caplog.messages[-1] == OWN


def test_who_may_connect_only_once_connects_once(world: World, caplog: pytest.LogCaptureFixture) -> None:
    """The broker ends the older connection of the two."""
    for _ in range(6):
        world.stops.cut()
        world.run(0.5)
        world.stops.mend()
        world.uplink.cut()
        world.run(0.5)
        world.uplink.mend()
        world.run(0.2)
    world.run(2000)
    assert world.stops.state is State.CLOSED
    assert len([message for message in caplog.messages if message.startswith(NONE)]) == 1
    world.remote.publish(STOP, PRESS)
    world.run()
    assert len(world.local.on(STOP)) == 1
