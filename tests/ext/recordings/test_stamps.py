"""Stamps are found and moved."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.extensions.media import json_video
from pebble.extensions.media.packets import KEY_FRAME, Codec, Picture, PictureKind, Sound
from pebble.extensions.media.picture_header import read_header
from pebble.extensions.recordings.stamps import is_keyframe, is_media, is_picture, shifted, stamp_ns

T_MS = 1_732_300_000_123
T_NS = T_MS * 10**6

SOUND = Sound(Codec.PCM16LE, 1, 16000, 320, 7, T_MS, b"\0" * 640)
PICTURE = Picture(PictureKind.JPEG, 3, T_MS, b"\xff\xd8picture")


def json_picture(keyframe: bool = True) -> bytes:
    return json_video.pack(3, keyframe, T_MS, b"\xff\xd8picture" * 300)


@pytest.mark.parametrize(
    "payload",
    [
        b'{"t": 1732300000123, "online": true}',
        b'{"t":1732300000123,"value":{"t":5,"timestamp":7}}',
        b'{"timestamp":1732300000.123}',
        b'{"t":1.732300000123e+12}',
        SOUND.pack(),
        PICTURE.pack(),
        json_picture(),
    ],
)
def test_the_own_stamp_is_found(payload):
    assert abs(stamp_ns(payload) - T_NS) < 1000


@pytest.mark.parametrize(
    "payload",
    [
        b"P",
        b'{"x":0.5}',
        b'{"t":-1732300000123}',
        b'{"t":1e300}',
        b'{"t":10000000000}',
        b'{"t":"1732300000123"}',
        b'{"value":{"t":1732300000123}}',
        SOUND.pack()[:23],
        PICTURE.pack()[:18],
        b"PBAT" + b"\xff" * 40,
        b"\xff\xd8\xff",
    ],
)
def test_what_is_no_stamp_is_0(payload):
    assert stamp_ns(payload) == 0


def test_a_stamp_of_a_board_counts_from_its_start():
    assert stamp_ns(b'{"t":1}') == 10**9
    assert stamp_ns(b'{"t":100000000000}') == 10**17, "milliseconds from here on"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b'{"online":true,"t":1732300000123}', b'{"online":true,"t":1732300002623}'),
        (b'{"timestamp": 1732300000.1234567 }', b'{"timestamp":1732300002.6234567}'),
        (b'{"t":1732300000123,"value":{"t":1732300000123}}', b'{"t":1732300002623,"value":{"t":1732300000123}}'),
        (
            b'{"t":1732300000123,"x":1,"timestamp":1732300000.5}',
            b'{"t":1732300002623,"x":1,"timestamp":1732300003.0}',
        ),
        (b'{"t":1732300000123', b'{"t":1732300000123'),
        (b'{"t":1234}', b'{"t":1234}'),
        (b'{"x":0.25}', b'{"x":0.25}'),
        (b"PBAT", b"PBAT"),
    ],
)
def test_stamps_are_moved_and_nothing_else(before, after):
    assert shifted(before, 2_500_000_000) == after


def test_headers_are_moved():
    assert Sound.unpack(shifted(SOUND.pack(), 2 * 10**9)).captured_ms == T_MS + 2000
    assert Picture.unpack(shifted(PICTURE.pack(), -2 * 10**9)).captured_ms == T_MS - 2000
    assert shifted(PICTURE.pack(), 10**6)[19:] == PICTURE.body
    header = read_header(shifted(json_picture(), 10**9))
    assert header is not None
    assert header.captured_ms == T_MS + 1000


def test_an_unknown_stamp_stays_unknown():
    unknown = Picture(PictureKind.JPEG, 3, 0, b"").pack()
    assert shifted(unknown, 10**18) == unknown
    assert shifted(PICTURE.pack(), -2 * 10**18) == PICTURE.pack()


@given(st.binary(max_size=600), st.integers(-(10**19), 10**19))
def test_any_bytes_are_taken(payload, by_ns):
    for one in (payload, b"{" + payload, b"PBAT" + payload, b"PBVD" + payload, b'{"id":' + payload):
        assert 0 <= stamp_ns(one) < 1 << 63
        shifted(one, by_ns)
        assert isinstance(is_media(one), bool)
        assert isinstance(is_keyframe(one), bool)


NO_MEDIUM, MEDIUM, SOME_PICTURE, WHOLE = range(4)


@pytest.mark.parametrize(
    ("payload", "kind"),
    [
        (PICTURE.pack(), WHOLE),
        (Picture(PictureKind.DELTA_JPEG, 4, T_MS, b"").pack(), SOME_PICTURE),
        (Picture(PictureKind.H264, 4, T_MS, b"", KEY_FRAME).pack(), WHOLE),
        (Picture(PictureKind.H264, 4, T_MS, b"").pack(), SOME_PICTURE),
        (json_picture(), WHOLE),
        (json_picture(False), SOME_PICTURE),
        (b"\xff\xd8\xff", WHOLE),
        (SOUND.pack(), MEDIUM),
        *((one, NO_MEDIUM) for one in (b"", b"{}", b'{"id":5,"name":"outlet"}', b'{"keyframe":true}', b"\xff", b"PBA")),
    ],
)
def test_media_pictures_and_key_frames_are_known_by_their_first_bytes(payload, kind):
    found = [is_media(payload), is_picture(payload), is_keyframe(payload)]
    assert found == [kind >= one for one in (MEDIUM, SOME_PICTURE, WHOLE)]
