"""What pages see of stops that are no longer sent, and of components that were forgotten."""

from __future__ import annotations

import time

import pytest

from pebble.contract import CAPABILITIES, ESTOP, ONLINE, codec
from pebble.contract.payloads import Capabilities, Heartbeat
from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.people import People
from pebble.extensions.operator.client.estop import GIVE_UP_S, StopSender, new_name
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import stops as stops_module
from pebble.extensions.page.server import Server
from pebble.extensions.page.setting import WebSettings
from pebble.extensions.page.stops import Stops
from pebble.transports import Message, MqttSettings
from tests.ext.operator.client.estop_robot import Robot

A, B = "pebble/robots/a", "pebble/robots/b"
FIRST = "f" * 16


def press(stops: Stops, ref: str, user: str = "ann") -> str:
    name = new_name()
    stops.press(ref, name, by=user, why="", now=1.0, known=[], user=user)
    return name


def capabilities_of(ref: str) -> Message:
    value = {"estop": {"available": True, "owners": ["motion"]}, "drive": {"available": True}}
    return Message(CAPABILITIES.topic(ref), codec.encode(CAPABILITIES, Capabilities(t=1, value=value)))


@pytest.mark.parametrize(
    ("ref", "others"),
    [
        (A, [(f"pebble/robots/fake{number}", f"viewer{number}") for number in range(60)]),
        (A, [(B, f"viewer{number}") for number in range(60)]),
        (A, [("", f"viewer{number}") for number in range(60)]),
        ("", [(f"pebble/robots/fake{number}", "ann") for number in range(60)]),
        (A, [(f"pebble/robots/real{number}", "ann") for number in range(19)]),
    ],
    ids=["of invented robots", "of one robot", "of all", "one of all", "of a fleet"],
)
def test_other_stops_end_none_that_is_repeated(
    monkeypatch: pytest.MonkeyPatch, ref: str, others: list[tuple[str, str]]
) -> None:
    monkeypatch.setattr(stops_module, "MAX_STOPS", 20)
    stops = Stops()
    press(stops, ref)
    if ref:
        stops.receive(capabilities_of(ref), 1.0)
    for other, user in others:
        press(stops, other, user)
    repeated = [message.topic for message in [*stops.tick(1.6), *stops.receive(capabilities_of(A), 1.7)]]
    assert ESTOP.topic(A) in repeated


def test_a_stop_is_repeated_once_what_was_sent_has_gone_and_sent_first_in_any_case() -> None:
    """Repeated while it still waits, the stop of a thousand robots holds up their confirmations for seconds."""
    waits = [True]
    stops = Stops(lambda: not waits[0])
    stops.press(A, FIRST, by="ann", why="", now=1.0, known=[], user="ann")
    all_ = stops.press("", new_name(), by="ann", why="", now=1.0, known=[], user="ann")
    assert all_ == []
    assert ESTOP.topic(B) in [one.topic for one in stops.receive(capabilities_of(B), 1.1)]
    assert (stops.tick(2.0), stops.receive(capabilities_of(B), 2.0)) == ([], [])
    waits[0] = False
    assert {ESTOP.topic(A), ESTOP.topic(B)} <= {one.topic for one in stops.tick(2.1)}


def test_a_stop_that_is_over_asks_none_of_its_robots_at_each_heartbeat(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand that are stopped would cost a thousand looks for each of 4,000 heartbeats a second."""
    stops, asked = Stops(), list[StopSender]()
    press(stops, "")
    stops.receive(capabilities_of(A), 1.0)
    stops.tick(1.0 + GIVE_UP_S)
    monkeypatch.setattr(StopSender, "finished", property(lambda sender: asked.append(sender) or True))
    stops.receive(capabilities_of(A), 1.0 + GIVE_UP_S)
    assert (stops.tick(1.0 + GIVE_UP_S), asked) == ([], [])


@pytest.mark.parametrize(
    ("ref", "users", "may_end"),
    [(A, ["ann", "ann"], "ann"), (A, ["ann", "eve"], None), ("", ["ann", "eve", "eve"], None), (A, ["eve"], "eve")],
)
def test_a_newer_stop_of_the_same_takes_the_place_of_the_older(ref: str, users: list[str], may_end: str | None) -> None:
    """Who presses after another person may not end what stands for both."""
    stops, names = Stops(), list[str]()
    for user in users:
        names.append(press(stops, ref, user))
        stops.receive(capabilities_of(A), 1.0)
    assert [stops.user(name) for name in names] == [None] * (len(users) - 1) + [may_end]
    assert stops.view(RobotEstop(A)).stop == names[-1]
    assert [one.topic for one in stops.tick(1.6)].count(ESTOP.topic(A)) == 1


def test_pages_are_told_of_each_step_of_a_stop_and_of_its_motor_owners() -> None:
    stops, robot, shown = Stops(), Robot(A, "left", "right"), RobotEstop(A)
    sent = stops.press(A, FIRST, by="ann", why="", now=1.0, known=[RobotView(B)], user="ann")
    assert (stops.sends_to(A), stops.sends_to(B), stops.collecting) == (True, False, False)
    left, right = robot.take(sent)
    steps = []
    for message in (robot.capabilities(), left, left, right):
        stops.view(shown)
        stops.changed.clear()
        shown.receive(message)
        stops.receive(message, 1.1)
        steps.append((stops.view(shown).sending, set(stops.changed)))
    assert steps == [("sent", {A}), ("sent", {A}), ("sent", set()), ("confirmed", {A})]
    assert [(owner.owner, owner.latched) for owner in stops.view(shown).owners] == [("left", True), ("right", True)]
    assert stops.robots_of(FIRST) == ([A], [])
    press(stops, "")
    assert stops.collecting


def test_a_stop_that_is_no_longer_confirmed_for_lack_of_room_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stops_module, "MAX_STOPS", 2)
    stops = Stops()
    press(stops, A)
    press(stops, B)
    assert not stops.omitted(1.0)
    stops.changed.clear()
    press(stops, "pebble/robots/c")
    assert A in stops.changed
    assert (stops.view(RobotEstop(A)).sending, stops.omitted(1.0), stops.omitted(99.0)) == ("", True, False)


def test_a_component_that_was_forgotten_is_shown_again_by_its_heartbeat() -> None:
    server = Server(WebSettings(broker=MqttSettings(host="127.0.0.1")), People(None), Audit(None))
    heartbeat = Message(ONLINE.topic(A), codec.encode(ONLINE, Heartbeat(t=int(1000 * time.time()))))
    for _ in range(2):
        server.receive(heartbeat, time.monotonic())
        server.show_stops()
        assert server.robots.value(A, "web/estop") is not None
        server.robots.forget(A)
        assert server.robots.value(A, "web/estop") is None
