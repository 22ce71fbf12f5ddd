"""Decodes video payloads of every encoding. A damaged picture is refused; then a key frame is needed."""

from dataclasses import dataclass
from typing import Final

from pebble.errors import PayloadError, PebbleError
from pebble.extensions.media import pyav
from pebble.extensions.media.h264 import H264Decoder
from pebble.extensions.media.jpeg import MAX_BYTES, Pixels, decode_jpeg
from pebble.extensions.media.jpeg_delta import add
from pebble.extensions.media.json_video import inflate, jpeg_of
from pebble.extensions.media.packets import Picture
from pebble.extensions.media.picture_header import PictureHeader, follows, read_header

MAX_PAYLOAD: Final = MAX_BYTES * 3 // 2  # base64 takes a third more


@dataclass(frozen=True, slots=True)
class Decoded:
    """A picture that may be shown."""

    picture: Pixels  # BGR, (height, width, 3), the caller's own
    captured_ms: int | None  # epoch time at the sender; None: not in the payload
    frame: int | None  # its number; None: raw JPEG has none
    keyframe: bool
    encoding: str  # json | pbvd | pbvz | h264 | jpeg


class VideoDecoder:
    """A decoder of the payloads of one topic: json, pbvd, pbvz, h264 and raw JPEG, in any order.

    After a lost frame, a restart of the sender or a refused payload it returns nothing until the next key frame. Damage
    is found by the checksums of json, pbvz and h264. pbvd and raw JPEG have none: there it is found by their structure.
    """

    def __init__(self) -> None:
        self.wants_keyframe = False  # request one, at most once a second
        self.problem = ""  # why the last payload was refused, for display
        self._last: PictureHeader | None = None  # None: the next difference builds on nothing
        self._reference: Pixels | None = None
        self._h264: H264Decoder | None = None

    def feed(self, payload: bytes) -> Decoded | None:
        """Return the picture of this payload; None if it is refused, or a key frame must come first.

        Never raises for a payload.
        """
        try:
            header, body = _read(payload)
            if not follows(self._last, header):
                self._reset()
                return None
            picture = self._decode(header, body)
        except PebbleError as error:
            self.problem = str(error)
            self._reset()
            self.wants_keyframe = isinstance(error, PayloadError)  # as in _reset, but not for a missing library
            return None
        self._last = header
        self.wants_keyframe = False
        return Decoded(picture, header.captured_ms, header.frame, header.keyframe, header.encoding)

    def _reset(self) -> None:
        self._last = self._reference = None
        self.wants_keyframe = True

    def _decode(self, header: PictureHeader, body: bytes) -> Pixels:
        if header.encoding == "h264":
            if self._h264 is None or self._last is None:
                self._h264 = H264Decoder()
            return self._h264.decode(body, keyframe=header.keyframe)
        pixels = decode_jpeg(body)
        if header.encoding == "jpeg":
            return pixels
        if header.keyframe or self._reference is None:
            self._reference = pixels
        elif pixels.shape == self._reference.shape:
            add(self._reference, pixels, self._reference)
        else:
            raise PayloadError("a difference of another size than the picture it builds on")
        return self._reference.copy()


def _read(payload: bytes) -> tuple[PictureHeader, bytes]:
    """Return the header of ``payload`` and the bytes to decode. Raises PayloadError if it is no picture."""
    if len(payload) > MAX_PAYLOAD:
        raise PayloadError(f"{len(payload)} bytes, more than {MAX_PAYLOAD}")
    header = read_header(payload)
    if header is None:
        raise PayloadError("none of the forms of a picture")
    match header.encoding:
        case "jpeg":
            return header, payload
        case "json":
            return header, jpeg_of(payload)
        case "h264" if not pyav.installed():
            raise PebbleError(f"h264 {pyav.INSTALL}")
        case "pbvz":
            return header, inflate(Picture.unpack(payload).body, MAX_BYTES)
    return header, Picture.unpack(payload).body
