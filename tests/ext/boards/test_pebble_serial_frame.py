"""Frames of pebble_serial_v1: known vectors, byte stuffing, the checksum, and input that is not a frame."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.errors import PayloadError
from pebble.runtime.lines import LineSplitter
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import frame
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import FRAME_LIMIT, Frame, FrameError, Type
from tests.ext.boards import mcu_wire as wire


def test_the_known_vectors() -> None:
    request = "03 01 02 01 01 01 01 01 01 01 01 01 01 03 85 6b 00"
    command = "03 01 20 02 03 02 01 01 01 01 01 01 01 04 01 9b 7c 00"
    assert frame.encode(Frame(Type.DESCRIBE_REQ)).hex(" ") == request
    assert frame.encode(Frame(Type.CMD, b"\x01", interface=3, sequence=1)).hex(" ") == command
    assert frame.crc(b"123456789") == 0x29B1
    wrapped = frame.decode(frame.encode(Frame(Type.PING, sequence=2**32 + 5, timestamp=2**40 + 7))[:-1])
    assert (wrapped.sequence, wrapped.timestamp) == (5, 7)


@given(st.binary(max_size=1200))
def test_stuffing_there_and_back(data: bytes) -> None:
    stuffed = frame.stuff(data)
    assert 0 not in stuffed
    assert stuffed == wire.stuff(data)
    assert frame.unstuff(stuffed) == data
    assert len(stuffed) <= len(data) + len(data) // 254 + 1


def test_stuffing_around_a_full_block() -> None:
    for length, tail in itertools.product((0, 1, 253, 254, 255, 507, 508, 509, 762), (b"", b"\0", b"\0\0", b"\0x")):
        data = b"\xff" * length + tail
        assert frame.stuff(data) == wire.stuff(data)
        assert frame.unstuff(frame.stuff(data)) == data
    full = b"x" * 254
    assert frame.unstuff(frame.stuff(full) + b"\x01") == full, "an encoder may close a full last block"


@pytest.mark.parametrize("stuffed", [b"\x02", b"\x05abc", b"\xff" + b"x" * 253, b"\x03a\0", b"\x01\x09ab"])
def test_what_stuffing_cannot_have_made(stuffed: bytes) -> None:
    with pytest.raises(PayloadError):
        frame.unstuff(stuffed)


@given(
    st.sampled_from(Type),
    st.binary(max_size=600),
    st.integers(0, 2**16 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
)
def test_frames_there_and_back(kind: Type, payload: bytes, interface: int, sequence: int, ms: int) -> None:
    encoded = frame.encode(Frame(kind, payload, interface, sequence, ms))
    assert encoded == wire.frame(kind, payload, interface, sequence, ms)
    assert frame.decode(encoded[:-1]) == Frame(kind, payload, interface, sequence, ms)


@pytest.mark.parametrize(
    ("stuffed", "subject"),
    [
        (b"\x07abc", "stuffing"),
        (wire.stuff(b""), "short"),
        (wire.stuff(b"\x01\x10"), "short"),
        (wire.sealed(wire.body(wire.PONG)[:-1])[:-1], "short"),
        (wire.stuff(wire.body(wire.PONG) + b"\0\0"), "crc"),
        (wire.sealed(wire.body(wire.PONG, version=2))[:-1], "version"),
        (wire.sealed(wire.body(wire.PONG, version=0))[:-1], "version"),
        (wire.frame(0x7F)[:-1], "type"),
    ],
)
def test_what_is_no_frame_is_refused_by_name(stuffed: bytes, subject: str) -> None:
    with pytest.raises(FrameError) as caught:
        frame.decode(stuffed)
    assert caught.value.subject == subject
    assert "frame" in str(caught.value)


def test_a_single_flipped_bit_is_noticed() -> None:
    good = wire.frame(wire.STATE, b"\x01\x02", 3, 4, 5)[:-1]
    for position, bit in itertools.product(range(len(good)), range(8)):
        bad = bytearray(good)
        bad[position] ^= 1 << bit
        for part in bytes(bad).split(b"\0"):
            with pytest.raises(FrameError):
                frame.decode(part)


def test_a_stream_without_end_is_thrown_away_up_to_the_next_zero() -> None:
    splitter = LineSplitter(FRAME_LIMIT, frame.END)
    good = wire.frame(wire.PONG)
    found = []
    for chunk in (good[:5], good[5:], *(b"x" * 1000 for _ in range(50)), good, good):
        found += splitter.feed(chunk)
    assert found == [good[:-1], good[:-1]], "the first frame after the endless one is discarded with it"
    assert splitter.discarded_lines == 1
    splitter = LineSplitter(FRAME_LIMIT, frame.END)
    assert splitter.feed(b"x" * FRAME_LIMIT + b"\0" + b"x" * (FRAME_LIMIT + 1) + b"\0") == [b"x" * FRAME_LIMIT]
