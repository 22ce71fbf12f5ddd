"""How messages and rates are printed."""

from __future__ import annotations

import math

import msgspec
import pytest

from pebble.client.names import ANY_ROBOT, Names
from pebble.commands.terminal import show
from pebble.media.rate_meter import RateMeter
from pebble.transports import Message, QoS


def test_bodies() -> None:
    assert show.body(b'{"t":1}', 80) == '{"t": 1}'
    assert show.body(b'{"a":{"b":1}}', 8).count("\n") == 4
    assert show.body(b"true", 80) == "true"
    assert show.body(b"", 80).startswith("(empty")
    assert show.body(b"hello", 80) == "hello"
    assert show.body("é".encode(), 80) == "é"
    assert show.body(b"PBAT\x01\x01" + bytes(40), 80).splitlines()[0] == "PBAT sound, 46 bytes"
    assert show.body(b"PBVD\x01\x01", 80).splitlines()[1].startswith("  0000  50 42 56 44 01 01")
    assert show.body(b"\xff\xd8\xff", 80).startswith("JPEG picture")
    assert show.body(b"\x00\x80", 80).startswith("binary, 2 bytes")
    assert max(map(len, show.body(bytes(100), 60).splitlines())) <= 60


@pytest.mark.parametrize("payload", [b"\x1b[31mred", b'"\\u001b[31m"', '"\x9b31m"'.encode(), b'"\\ud800"', b"[" * 5000])
def test_no_payload_upsets_the_terminal(payload: bytes) -> None:
    text = show.body(payload, 80)
    text.encode()
    assert "\x1b" not in text
    assert "\x9b" not in text


def test_headlines() -> None:
    stamped = Message("a/b", b'{"t": 1710969600000}', QoS.DELIVERED, retain=True)
    assert show.headline(stamped, 1710969603.0) == "a/b  20 B  qos 1  retained  stamped 3.0 s ago"
    assert show.headline(Message("a", b"x", retain_requested=True), 0.0) == "a  1 B  qos 0  to be retained"
    assert show.age(-0.5) == "500 ms ahead"
    assert [show.duration(seconds) for seconds in (0.012, 99, 130, 7200, 200_000)] == [
        "12 ms", "99.0 s", "2 min", "2 h", "2 d",
    ]  # fmt: skip


def test_a_thin_link_is_listed() -> None:
    listing = show.Listing(Names(ANY_ROBOT))
    link = {"level": "thin", "drive_hz": 4, "rtt_ms": 600, "queue_ms": 45, "t": 1}
    for name, value in (("goob", link), ("fred", link | {"level": "wide"}), ("eve", 7)):
        listing.add(Message(f"pebble/robots/{name}/outgoing/link", msgspec.json.encode(value), retain=True), 0.0)
    assert show.remarks(listing, 0.0) == ["goob has a slow connection: commands take 0.3 s"]


def test_rates() -> None:
    meter = RateMeter(window_s=math.inf, limit=11)
    assert show.rate_line(meter, 0.0) is None
    for number in range(50):
        meter.add(number * 0.25, 100)
    assert str(show.rate_line(meter, 99.0)).startswith("4.000 Hz  3.2 kbit/s  min 0.2500 s  max 0.2500 s")
