"""Numbers and encodings of media are read from their first bytes."""

import json

import pytest

from pebble.contract.packets import KEY_FRAME, Codec, Picture, PictureKind, Sound
from pebble.media.json_video import JsonPicture
from pebble.recordings.media_numbers import AUDIO, JPEG, JSON_PICTURE, LIMIT, NAMES, VIDEO, media_number
from pebble.recordings.stamps import is_keyframe

SOUND = Sound(Codec.PCM16LE, 1, 16000, 320, 4_294_967_295, 1_732_300_000_123, bytes(640))


def picture(kind: int, flags: int = 0) -> bytes:
    return Picture(kind, 4_294_967_294, 1_732_300_000_123, b"\xff\xd8", flags).pack()


@pytest.mark.parametrize(
    ("payload", "name", "number", "keyframe"),
    [
        (SOUND.pack(), "pcm", 4_294_967_295, None),
        (Sound(Codec.OPUS, 2, 48000, 960, 1, 0, b"opus").pack(), "opus", 1, None),
        (picture(PictureKind.JPEG), "pbvd", 4_294_967_294, True),
        (picture(PictureKind.DELTA_JPEG), "pbvd", 4_294_967_294, False),
        (picture(PictureKind.ZLIB_JPEG), "pbvz", 4_294_967_294, True),
        (picture(PictureKind.ZLIB_DELTA_JPEG), "pbvz", 4_294_967_294, False),
        (picture(PictureKind.H264), "h264", 4_294_967_294, False),
        (picture(PictureKind.H264, KEY_FRAME), "h264", 4_294_967_294, True),
        (JsonPicture(7, True, 1_732_300_000_123, b"\xff\xd8").pack(), "json", 7, True),
        (json.dumps({"id": 8, "keyframe": False, "data": ""}).encode(), "json", 8, False),
        (b'{"id":%d,"keyframe":true,"data":""}' % (LIMIT + 5), "json", 5, True),
        (b"\xff\xd8\xff\xe0 a JPEG", "jpeg", None, True),
    ],
)
def test_media_are_numbered(payload, name, number, keyframe):
    found = media_number(payload)
    assert (NAMES[found.kind], found.number, found.keyframe) == (name, number, keyframe)
    assert (found.keyframe or False) == is_keyframe(payload)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b'{"online": true}',
        b'{"id": 5, "name": "no picture"}',
        b'{"id": "5", "keyframe": true}',
        b'{"id":%s,"keyframe":true}' % (b"9" * 5000),
        b"PBAT",
        SOUND.pack()[:15],
        b"PBVD\x01\x01",
        picture(6),
        picture(250),
        SOUND.pack()[:5] + b"\x09" + SOUND.pack()[6:],
    ],
)
def test_anything_else_is_none(payload):
    assert media_number(payload) is None


def test_every_kind_is_a_picture_or_sound():
    assert set(NAMES) == VIDEO | AUDIO
    assert VIDEO.issuperset({JSON_PICTURE, JPEG})
