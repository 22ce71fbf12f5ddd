"""One of several brokers is used at a time: who chooses it, who follows, and the return to the first one."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path

import pytest

from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from pebble.transports.hosts import STEADY_S, Address, Place, Turns
from pebble.transports.mqtt.chosen_host import REST_S, ChosenHost, Return
from tests.support import Broker, until

A, B, C = (Place(name, 1883) for name in "abc")
ADDRESSES = {"a": ["10.0.0.1"], "b": ["10.0.1.1", "10.0.1.2"], "c": []}


def _resolve(host: str, port: int) -> list[Address]:
    return [Address(socket.AF_INET, (one, port)) for one in ADDRESSES[host]]


@pytest.mark.parametrize(
    ("places", "held", "tried"),
    [
        ([A, B], [0, 0, 0, 0], ["a", "b1", "b2", "a"]),
        ([A, C, B], [0, 0, 0, 0], ["a", "b1", "b2", "a"]),  # a host without an address has failed
        ([A, B], [0, STEADY_S, 0, 0, 0], ["a", "b1", "b1", "b2", "a"]),  # it held: its host once more, then the others
        ([A, B], [STEADY_S - 1, 0], ["a", "b1"]),
    ],
)
def test_hosts_take_turns(places: list[Place], held: list[float], tried: list[str]) -> None:
    turns, seen = Turns(lambda: places, _resolve), []
    for seconds in held:
        number = str(turns.address().place[0])[-1]
        seen.append(turns.place.host + (number if turns.place is B else ""))
        turns.failed("x", seconds)
    assert seen == tried


def test_one_line_names_each_host_and_why_it_failed() -> None:
    turns, text = Turns(lambda: [A, C, B], _resolve), ""
    for why in ("hung up", "is mute", "is full"):
        turns.address()
        text = turns.failed(why)
    assert text == (
        "a:1883 hung up; c:1883 cannot be reached: it has no address; b:1883 10.0.1.1 is mute; b:1883 10.0.1.2 is full"
    )


class Robot:
    """At the second host, which looks at the first one every second of virtual time."""

    def __init__(self) -> None:
        self.rule, self.now, self.good, self.idle_s = Return(), 0.0, True, 1000.0
        self.rule.connected(0.0, first=False)

    def returns_after(self, within_s: int) -> float | None:
        began = self.now
        for _ in range(within_s):
            self.now += 1.0
            if self.rule.wants_probe(self.now):
                self.rule.probed(self.now, good=self.good)
            if self.rule.is_due(self.now, self.idle_s):
                self.rule.connected(self.now, first=True)
                return self.now - began
        return None


class TestReturn:
    def test_after_three_logins_in_a_row(self) -> None:
        robot = Robot()
        robot.good = False
        assert robot.returns_after(130) is None
        robot.good = True
        assert (robot.returns_after(130) or 999) <= 60

    def test_not_while_it_is_driven(self) -> None:
        robot = Robot()
        robot.idle_s = REST_S - 1
        assert robot.returns_after(1000) is None
        robot.idle_s = REST_S
        assert robot.returns_after(1) == 1

    def test_a_first_host_that_does_not_hold_has_to_be_good_for_longer_each_time(self) -> None:
        robot, took = Robot(), []
        for _ in range(4):
            took.append(robot.returns_after(2000))
            robot.now += 5.0
            robot.rule.connected(robot.now, first=False)
        assert took == [60, 100, 180, 340]
        robot.returns_after(2000)
        robot.now += 700.0  # it held
        robot.rule.connected(robot.now, first=False)
        assert robot.returns_after(2000) == 60

    def test_at_the_first_host_nothing_is_tried(self) -> None:
        robot = Robot()
        robot.rule.connected(0.0, first=True)
        robot.rule.probed(1.0, good=True)  # a look from before the return is answered late
        assert not robot.rule.is_due(1e9, 1e9)
        assert not robot.rule.wants_probe(1e9)


def test_a_file_that_is_missing_or_wrong_names_the_first_host(tmp_path: Path) -> None:
    chosen = ChosenHost(tmp_path / "remote-host", [A, B])
    assert chosen.read() == A
    chosen.write(B)
    assert ChosenHost(tmp_path / "remote-host", [A, B]).read() == B
    for wrong in (b"elsewhere:1883", b"\xff", b""):
        (tmp_path / "remote-host").write_bytes(wrong)
        assert chosen.read() == A


def _settings(brokers: tuple[Broker, Broker], folder: Path) -> MqttSettings:
    places = tuple(("127.0.0.1", one.port) for one in brokers)
    return MqttSettings(host="127.0.0.1", port=places[0][1], hosts=places, chosen=folder / "remote-host")


def _at(transport: Transport, broker: Broker) -> bool:
    return transport.state is State.CONNECTED and transport.host == f"127.0.0.1:{broker.port}"


def test_a_robot_goes_on_at_the_next_host_and_returns_with_all_its_programs(
    brokers: tuple[Broker, Broker], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pebble.transports.mqtt.chosen_host._PROBE_S", 0.2)
    monkeypatch.setattr("pebble.transports.mqtt.chosen_host._GOOD_S", 0.4)
    first, second = brokers
    settings = _settings(brokers, tmp_path)
    will = Message("robot/online", b"no", QoS.DELIVERED, True)
    robot = create("mqtt", "robot", settings, will=will)
    camera = create("mqtt", "camera", replace(settings, follows=True))
    watcher = create("mqtt", "watcher", MqttSettings(host="127.0.0.1", port=second.port))
    seen: list[bytes] = []
    with robot, camera, watcher:
        watcher.subscribe("robot/online", lambda message: seen.append(message.payload))
        assert robot.publish("robot/online", b"yes", qos=QoS.DELIVERED, retain=True)
        assert until(lambda: _at(robot, first) and _at(camera, first))
        first.kill()
        assert until(lambda: _at(robot, second) and _at(camera, second), 30)
        assert until(lambda: seen == [b"yes"])
        first.start()
        assert not until(lambda: not _at(robot, second), 2.0), "it was driven just now"
        robot.idle_s = lambda: REST_S
        assert until(lambda: _at(robot, first) and _at(camera, first), 30)
        assert until(lambda: seen == [b"yes", b"no"]), "who knows only the second host learns that it has left"
    assert robot.went_back
