"""How messages and rates are printed."""

from __future__ import annotations

import msgspec
import pytest

from pebble.extensions.operator.client.names import ANY_ROBOT, Names
from pebble.extensions.operator.commands import show
from pebble.transports import Message


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


def test_a_thin_link_is_listed() -> None:
    listing = show.Listing(Names(ANY_ROBOT))
    link = {"level": "thin", "drive_hz": 4, "rtt_ms": 600, "queue_ms": 45, "t": 1}
    for name, value in (("goob", link), ("fred", link | {"level": "wide"}), ("eve", 7)):
        listing.add(Message(f"pebble/robots/{name}/outgoing/link", msgspec.json.encode(value), retain=True), 0.0)
    assert show.remarks(listing, 0.0) == ["goob has a slow connection: commands take 0.3 s"]


def test_a_table_in_a_pipe_cuts_no_name(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    names = [f"{'goob-of-the-long-corridor-' * 3}{number}" for number in range(3)]
    show.print_table(("robot", "why"), [(name, "x" * 60) for name in names], whole=("robot",))
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]] == names
