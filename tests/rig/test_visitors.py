"""Which robots people drive, by what servers announce."""

from __future__ import annotations

from pebble.contract import DRIVING, codec
from pebble.contract.payloads import Driver, Driving
from pebble.rig.operator import EXPIRES_S, Visitors
from pebble.transports import Message

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"


def announcement(server: str, *robots: str, device: str = "phone") -> Message:
    driven = {base: Driver(by="anna", device=device, since=1) for base in robots}
    return Message(DRIVING.topic(f"pebble/servers/{server}"), codec.encode(DRIVING, Driving(t=1, robots=driven)))


def test_a_robot_is_driven_while_a_server_announces_it() -> None:
    visitors = Visitors()
    assert visitors.driver(GOOB, 0.0) == ""
    visitors.receive(announcement("hall", GOOB), 10.0)
    assert visitors.driver(GOOB, 11.0) == "anna on phone"
    assert visitors.driver(FRED, 11.0) == ""
    visitors.receive(announcement("hall"), 12.0)
    assert visitors.driver(GOOB, 12.1) == ""
    assert visitors.driven_since(GOOB, 11.5, 13.0)
    assert not visitors.driven_since(GOOB, 12.5, 13.0)


def test_an_announcement_expires_with_its_server() -> None:
    visitors = Visitors()
    visitors.receive(announcement("hall", GOOB, device=""), 10.0)
    assert visitors.driver(GOOB, 10.0 + EXPIRES_S) == "anna"
    assert visitors.driver(GOOB, 10.1 + EXPIRES_S) == ""
    assert not visitors.driven_since(GOOB, 10.5, 20.0)


def test_another_servers_silence_about_a_robot_means_nothing() -> None:
    visitors = Visitors()
    visitors.receive(announcement("hall", GOOB), 10.0)
    visitors.receive(announcement("lab", FRED), 10.1)
    assert (visitors.driver(GOOB, 11.0), visitors.driver(FRED, 11.0)) == ("anna on phone", "anna on phone")


def test_what_is_no_announcement_is_ignored() -> None:
    visitors = Visitors()
    visitors.receive(Message(DRIVING.topic("pebble/servers/hall"), b"{"), 10.0)
    visitors.receive(Message(DRIVING.topic(GOOB), announcement("hall", GOOB).payload), 10.0)
    visitors.receive(Message("nonsense", b""), 10.0)
    assert visitors.driver(GOOB, 10.0) == ""
