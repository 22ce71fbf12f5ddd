"""What pictures and packets of sound are numbered by, and how they are encoded, without decoding them. Pure.

Pictures as JSON have ``id`` and ``keyframe`` (paper 8.8), PBVD and PBAT have headers (``pebble.contract.packets``).
"""

import re
import struct
from typing import Final, NamedTuple

from pebble.contract.packets import KEY_FRAME, PBAT, PBVD, Codec, PictureKind

#: Encodings as one number: those of PBVD are 10 + their kind, those of PBAT 20 + their codec.
JSON_PICTURE, JPEG = 10, 19
_PICTURES, _SOUNDS = 10, 20
LIMIT: Final = 1 << 32  # numbers wrap here

_KIND_FLAGS_FRAME: Final = struct.Struct(">xxxxxBBI")
_CODEC_SEQUENCE: Final = struct.Struct(">xxxxxBxxxxxxI")
_JSON_ID: Final = re.compile(rb'\{"id":\s*(\d{1,16})\s*,\s*"keyframe":\s*(true|false)')
_WHOLE: Final = frozenset({PictureKind.JPEG, PictureKind.ZLIB_JPEG})
_KINDS: Final = frozenset(PictureKind)
_CODECS: Final = frozenset(Codec)

NAMES: Final = {
    JSON_PICTURE: "json",
    _PICTURES + PictureKind.JPEG: "pbvd",
    _PICTURES + PictureKind.DELTA_JPEG: "pbvd",
    _PICTURES + PictureKind.ZLIB_JPEG: "pbvz",
    _PICTURES + PictureKind.ZLIB_DELTA_JPEG: "pbvz",
    _PICTURES + PictureKind.H264: "h264",
    JPEG: "jpeg",
    _SOUNDS + Codec.PCM16LE: "pcm",
    _SOUNDS + Codec.OPUS: "opus",
}
VIDEO: Final = frozenset(kind for kind in NAMES if kind < _SOUNDS)
AUDIO: Final = frozenset(NAMES) - VIDEO


class MediaNumber(NamedTuple):
    """One picture or packet. ``keyframe`` is None for sound, ``number`` for a bare JPEG."""

    kind: int  # one of NAMES
    number: int | None  # modulo LIMIT
    keyframe: bool | None


_BARE_JPEG: Final = MediaNumber(JPEG, None, True)


def media_number(payload: bytes) -> MediaNumber | None:
    """None for everything else, and for kinds and codecs that are not known. Hot."""
    magic = payload[:4]
    if magic == PBAT:
        return _sound(payload)
    if magic == PBVD:
        return _picture(payload)
    if magic == b'{"id':
        found = _JSON_ID.match(payload)
        return None if found is None else MediaNumber(JSON_PICTURE, int(found[1]) % LIMIT, found[2] == b"true")
    return _BARE_JPEG if magic[:2] == b"\xff\xd8" else None


def _sound(payload: bytes) -> MediaNumber | None:
    if len(payload) < _CODEC_SEQUENCE.size:
        return None
    codec, sequence = _CODEC_SEQUENCE.unpack_from(payload)
    return MediaNumber(_SOUNDS + codec, sequence, None) if codec in _CODECS else None


def _picture(payload: bytes) -> MediaNumber | None:
    if len(payload) < _KIND_FLAGS_FRAME.size:
        return None
    kind, flags, frame = _KIND_FLAGS_FRAME.unpack_from(payload)
    if kind not in _KINDS:
        return None
    keyframe = kind in _WHOLE or (kind == PictureKind.H264 and bool(flags & KEY_FRAME))
    return MediaNumber(_PICTURES + kind, frame, keyframe)
