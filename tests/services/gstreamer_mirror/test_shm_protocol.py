"""The commands on a GStreamer socket, byte by byte, and what readers may not send."""

from __future__ import annotations

import struct

import pytest

from pebble.errors import PayloadError
from pebble.services.gstreamer_mirror.shm_protocol import Acknowledgements, new_area, new_buffer

#: As a machine with 64 bits, little endian, lays out: unsigned int, int, unsigned long, unsigned long.
AREA = bytes.fromhex("01000000 01000000 0020000000000000 0500000000000000") + b"/abc\0"
BUFFER = bytes.fromhex("03000000 01000000 0010000000000000 9e03000000000000")


def ack(offset: int, kind: int = 4, area: int = 1) -> bytes:
    return struct.pack("<IiQQ", kind, area, offset, 0)


def test_what_the_writer_sends() -> None:
    assert new_area(8192, "/abc") == AREA
    assert new_buffer(4096, 926) == BUFFER


@pytest.mark.parametrize("piece", [1, 7, 24, 25, 1000])
def test_acknowledgements_in_pieces_of_any_size(piece: int) -> None:
    data = b"".join(map(ack, (0, 4096, 2**40)))
    reader = Acknowledgements()
    found = [offset for at in range(0, len(data), piece) for offset in reader.feed(data[at : at + piece])]
    assert found == [0, 4096, 2**40]


@pytest.mark.parametrize("data", [ack(0, kind=3), ack(0, area=0), b"GET / HTTP/1.1\r\nHost: x\r\n"], ids=repr)
def test_anything_else_is_refused(data: bytes) -> None:
    with pytest.raises(PayloadError):
        Acknowledgements().feed(data)
