"""Several brokers that know nothing of each other, heard as one: what counts is where the robot is."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pebble.runtime.every_host import CHANGE_S, MAX_ROBOTS, EveryHost, Homes, operators
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from tests.support import Broker, until

BASE = "pebble/robots/goob"
HEARTBEAT, END = b'{"t": 1, "online": true}', b'{"t": 1, "online": false}'


@pytest.mark.parametrize(
    ("story", "where"),  # heartbeats by host and time; e: the will, l: the connection is lost
    [
        ("0@0", 0),
        ("0@0 1@0.2", 0),  # one that was on its way for long
        ("0@0 0@0.25 1@0.3 0@0.5 1@0.6", 0),
        (f"0@0 1@{CHANGE_S}", 1),
        ("0@0 0@1 1@1.9 0@2", 0),  # over a slow link its heartbeats are further apart
        ("0@0 0@1 1@2.5", 1),
        ("0@0 0@20 1@23", 1),  # it stood still
        ("0@0 e0@0.1 1@0.1", 1),  # it has left in order
        ("0@0 e1@0.1", 0),  # the other host has noticed late that it is gone
        ("0@0 l0@0.1", None),
        ("0@0 l0@0.1 1@0.1", 1),
    ],
)
def test_where_a_robot_is(story: str, where: int | None) -> None:
    homes = Homes()
    for event in story.split():
        what, _, at = event.partition("@")
        host = int(what[-1])
        {"e": lambda: homes.ended("r", host), "l": lambda: homes.lost(host)}.get(  # noqa: B023 - called at once
            what[0],
            lambda: homes.heartbeat("r", host, float(at)),  # noqa: B023
        )()
    assert homes.of("r") == where


def test_invented_robots_keep_no_real_one_out() -> None:
    homes = Homes()
    for number in range(2 * MAX_ROBOTS):
        homes.get(f"invented-{number}")
    assert homes.heartbeat("real", 1, 100.0)
    assert homes.of("real") == 1


@pytest.fixture
def robots(brokers: tuple[Broker, Broker]) -> Iterator[list[Transport]]:
    """The robot, as a client of each broker."""
    each = [create("mqtt", "robot", MqttSettings(host="127.0.0.1", port=one.port)).open() for one in brokers]
    yield each
    for one in each:
        one.close()


@pytest.fixture
def operator(brokers: tuple[Broker, Broker]) -> Iterator[EveryHost]:
    places = tuple(("127.0.0.1", one.port) for one in brokers)
    made = operators("page", "mqtt", MqttSettings(host=places[0][0], port=places[0][1], hosts=places))
    assert isinstance(made, EveryHost)
    yield made
    made.close()


def _put(robot: Transport, metric: str, payload: bytes, *, retain: bool = True) -> None:
    assert robot.publish(f"{BASE}/outgoing/{metric}", payload, qos=QoS.DELIVERED, retain=retain, remember=False)


def _is_at(operator: EveryHost, robot: Transport, broker: Broker) -> bool:
    _put(robot, "online", HEARTBEAT)
    return operator.host_of(BASE) == f"127.0.0.1:{broker.port}"


def test_the_state_at_the_robots_own_host_counts(
    brokers: tuple[Broker, Broker], robots: list[Transport], operator: EveryHost
) -> None:
    here, there = robots
    _put(here, "status", b'"new"')
    _put(there, "status", b'"old"')
    _put(there, "capabilities", b'"of long ago"')
    seen: dict[str, bytes] = {}
    operator.open()
    assert operator.state is State.CONNECTED
    operator.subscribe(f"{BASE}/outgoing/#", lambda one: seen.update({one.topic.rpartition("/")[2]: one.payload}))
    assert until(lambda: _is_at(operator, here, brokers[0]), step=0.2)
    assert until(lambda: (seen.get("status"), seen.get("capabilities")) == (b'"new"', b""))
    _put(there, "status", b'"older still"')
    _put(there, "online", END)  # the will that a hung host speaks once it goes on
    _put(here, "charging-level", b"7")
    assert until(lambda: seen.get("charging-level") == b"7")
    assert (seen["status"], seen["online"]) == (b'"new"', HEARTBEAT)
    brokers[0].kill()
    assert until(lambda: _is_at(operator, there, brokers[1]), step=0.2)
    assert until(lambda: seen["status"] == b'"older still"'), "it is the newest one where the robot is now"


def test_commands_go_where_the_robot_is_and_stops_everywhere(
    brokers: tuple[Broker, Broker], robots: list[Transport], operator: EveryHost
) -> None:
    got: list[tuple[int, str]] = []
    for number, robot in enumerate(robots):
        robot.subscribe(f"{BASE}/incoming/#", lambda one, n=number: got.append((n, one.topic[len(BASE) + 10 :])))  # type: ignore[misc]
    operator.open()
    assert until(lambda: _is_at(operator, robots[1], brokers[1]), step=0.2)
    for metric in ("drive-values", "estop", "by/ann/estop"):
        assert operator.publish(f"{BASE}/incoming/{metric}", b"{}", qos=QoS.DELIVERED)
    assert operator.publish(f"{BASE}/incoming/flags/mqtt-video", b"true", qos=QoS.DELIVERED, retain=True)
    flag = "flags/mqtt-video"
    wanted = [(n, one) for n in (0, 1) for one in ("estop", "by/ann/estop", flag)] + [(1, "drive-values")]
    assert until(lambda: sorted(got) == sorted(wanted)), got


def test_one_broker_alone_is_an_ordinary_connection(brokers: tuple[Broker, Broker]) -> None:
    made = operators("page", "mqtt", MqttSettings(host="127.0.0.1", port=brokers[0].port))
    assert not isinstance(made, EveryHost)


def test_one_host_that_is_away_is_named_and_hinders_nothing(
    brokers: tuple[Broker, Broker], robots: list[Transport], operator: EveryHost
) -> None:
    brokers[1].kill()
    operator.open()
    assert operator.state is State.CONNECTED
    assert f"127.0.0.1:{brokers[1].port}" in operator.problem
    seen: list[Message] = []
    operator.subscribe(f"{BASE}/outgoing/#", seen.append)
    assert until(lambda: _is_at(operator, robots[0], brokers[0]), step=0.2)
    assert until(lambda: seen)
