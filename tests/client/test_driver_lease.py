"""Who drives a robot, by what servers and terminals announce."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.client.control import IDLE_S
from pebble.client.driver_lease import DriverLease
from pebble.transports import Message

GOOB = "pebble/robots/goob"
EPOCH = 1_760_000_000_000


def lease(server: str = "drive-1") -> DriverLease:
    return DriverLease(GOOB, server, by="ann@desk", device="terminal on desk")


def announcement(server: str, since: int | None, *, robot: str = GOOB, retain: bool = False) -> Message:
    robots = {} if since is None else {robot: {"by": "bob", "device": "phone", "since": since}}
    payload = json.dumps({"t": EPOCH, "robots": robots}).encode()
    return Message(f"pebble/servers/{server}/outgoing/driving", payload, retain=retain)


def robots(messages: list[Message]) -> list[Any]:
    assert {message.topic for message in messages} <= {"pebble/servers/drive-1/outgoing/driving"}
    return [json.loads(message.payload)["robots"] for message in messages]


def test_it_is_announced_once_a_second_while_it_is_held_and_once_when_it_is_not() -> None:
    mine = lease()
    assert mine.tick(0.0, EPOCH) == []
    mine.take(1.0, EPOCH)
    wanted = [{GOOB: {"by": "ann@desk", "device": "terminal on desk", "since": EPOCH}}]
    assert robots(mine.tick(1.0, EPOCH)) == wanted
    assert mine.tick(1.5, EPOCH + 500) == []
    assert robots(mine.tick(2.0, EPOCH + 1000)) == wanted
    mine.release()
    assert robots(mine.tick(2.1, EPOCH + 1100)) == [{}]
    assert mine.tick(9.0, EPOCH + 8000) == []


def test_it_ends_after_a_minute_without_a_gesture() -> None:
    mine = lease()
    mine.take(0.0, EPOCH)
    mine.use(5.0)
    mine.tick(5.0 + IDLE_S, EPOCH)
    assert mine.held
    assert robots(mine.tick(5.1 + IDLE_S, EPOCH)) == [{}]
    assert not mine.held


def test_another_driver_is_known_for_3_s_after_its_announcement() -> None:
    mine = lease()
    mine.receive(announcement("fair-1", EPOCH), 1.0)
    assert str(mine.other(3.9)) == "bob (phone) at fair-1"
    assert mine.other(4.1) is None
    mine.receive(announcement("fair-1", EPOCH), 5.0)
    mine.receive(announcement("fair-1", None), 5.1)
    assert mine.other(5.2) is None


@pytest.mark.parametrize(
    "message",
    [
        announcement("fair-1", EPOCH, robot="pebble/robots/fred"),
        announcement("fair-1", EPOCH, retain=True),
        Message("pebble/robots/goob/outgoing/driving", announcement("x", EPOCH).payload),
        Message("pebble/servers/fair-1/outgoing/driving", b"{"),
        Message("pebble/servers/fair-1/outgoing/online", announcement("x", EPOCH).payload),
        Message("nonsense", b""),
    ],
)
def test_what_is_no_announcement_of_another_driver_of_this_robot(message: Message) -> None:
    mine = lease()
    mine.receive(message, 0.0)
    assert mine.other(0.1) is None


def test_a_take_over_is_newer_than_what_it_ends_despite_wrong_clocks() -> None:
    mine = lease()
    mine.receive(announcement("fair-1", EPOCH + 999_999), 0.0)
    mine.take(0.1, EPOCH)
    mine.receive(announcement("fair-1", EPOCH + 999_999), 0.2)  # it has not heard of it yet
    assert (mine.held, mine.other(0.3)) == (True, None)
    (announced,) = robots(mine.tick(0.3, EPOCH))
    assert announced[GOOB]["since"] == EPOCH + 1_000_000


def test_a_newer_driver_elsewhere_ends_it() -> None:
    mine = lease()
    mine.take(0.0, EPOCH)
    mine.receive(announcement("fair-1", EPOCH + 1), 0.1)
    assert (mine.held, str(mine.other(0.2))) == (False, "bob (phone) at fair-1")
    assert robots(mine.tick(0.2, EPOCH)) == [{}]


@pytest.mark.parametrize(("server", "held"), [("a", True), ("z", False)])
def test_of_two_at_the_same_millisecond_one_wins(server: str, held: bool) -> None:
    mine = lease("drive-1")
    mine.take(0.0, EPOCH)
    mine.receive(announcement(server, EPOCH), 0.1)
    assert mine.held is held


def test_own_announcements_measure_the_way_through_the_broker() -> None:
    mine = lease()
    mine.take(0.0, EPOCH)
    (sent,) = mine.tick(0.0, EPOCH)
    assert (mine.round_trip_s, mine.late_s(5.0)) == (None, 0.0), "a broker may refuse them"
    mine.receive(sent, 0.02)
    assert (mine.round_trip_s, mine.late_s(0.5)) == (0.02, 0.0)
    mine.tick(1.0, EPOCH + 1000)
    assert mine.late_s(1.75) == 0.75
    mine.reconnected()
    assert mine.late_s(1.75) == 0.0


def test_announcements_of_many_servers_are_bounded() -> None:
    mine = lease()
    for number in range(100):
        mine.receive(announcement(f"s{number:02}", EPOCH), 0.0)
    mine.receive(announcement("one more", EPOCH + 1), 0.0)
    assert str(mine.other(0.1)) == "bob (phone) at s99"
    mine.receive(announcement("s00", EPOCH + 1), 0.0)
    assert str(mine.other(0.1)) == "bob (phone) at s00"
