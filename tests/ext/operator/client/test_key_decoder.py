"""The bytes of a terminal as keys."""

from __future__ import annotations

import pytest

from pebble.extensions.operator.client.terminal.key_decoder import ALONE_S, KeyDecoder


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wW", ["w", "w"]),
        (b" !q", ["space", "!", "q"]),
        (b"\x04", ["end"]),
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"\x1b\x1b[A", ["escape", "up"]),  # Escape and an arrow, or Alt and an arrow
        (b"\x1b!", ["escape", "!"]),
        (b"\x1bw", ["escape", "w"]),  # or Alt and W
        (b"\x1b[1;2A", []),  # shift and an arrow
        (b"\x1b[5~w", ["w"]),
        (b"\x1b[[Aw", ["w"]),  # the first function key of the Linux console
        ("ä€\x00\r\n\t\x7f".encode(), ["ä", "€"]),
        (b"\x1b[" + b"0" * 100 + b"w", []),
    ],
)
def test_keys(data: bytes, keys: list[str]) -> None:
    assert KeyDecoder().feed(data, 0.0) == keys
    bytewise = KeyDecoder()
    assert [key for byte in data for key in bytewise.feed(bytes([byte]), 0.0)] == keys


def test_an_escape_byte_alone_is_the_escape_key() -> None:
    decoder = KeyDecoder()
    assert decoder.due is None
    assert decoder.feed(b"\x1b", 1.0) == []
    assert decoder.due == 1.0 + ALONE_S
    assert decoder.feed(b"", 1.0 + ALONE_S / 2) == []
    assert decoder.feed(b"", 1.0 + ALONE_S) == ["escape"]
    assert (decoder.due, decoder.feed(b"", 9.0)) == (None, [])


def test_the_rest_of_a_sequence_that_comes_late_is_no_sequence() -> None:
    decoder = KeyDecoder()
    decoder.feed(b"\x1b", 1.0)
    assert decoder.feed(b"a", 2.0) == ["escape", "a"]
    decoder.feed(b"\x1b[", 3.0)
    assert decoder.feed(b"w", 4.0) == ["w"]


def test_what_never_ends_is_forgotten() -> None:
    decoder = KeyDecoder()
    for _ in range(100):
        decoder.feed(b"\x1b[" + b";" * 40, 0.0)
    assert decoder.feed(b"w", 1.0) == ["w"]
