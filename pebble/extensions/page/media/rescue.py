"""Pictures as plain JPEGs, for pages that cannot decode a robot's encoding, or whose connection cannot carry it.

One stream per robot for all who need it: the server decodes, and sends at most five small pictures a second, always the
newest: a large one would delay everything else on a thin connection. cv2 and PyAV are imported with the first picture,
for they take memory that most servers never need.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pebble.extensions.media import pyav

if TYPE_CHECKING:
    from pebble.extensions.media.decode import Decoded, VideoDecoder

PERIOD_S: Final = 0.2
WIDTH: Final = 480  # pixels, at most
_QUALITY: Final = 50
_MAX_WAITING_BYTES: Final = 16 << 20  # of pictures that wait to be converted


class RescuedPicture(NamedTuple):
    jpeg: bytes
    captured_ms: int  # 0: unknown


def unavailable(encoding: str) -> str:
    """Return why this server cannot decode ``encoding``; empty if it can."""
    return f"this server cannot convert h264: it {pyav.INSTALL}" if encoding == "h264" and not pyav.installed() else ""


def jpeg_of(key_frame: bytes) -> bytes | None:
    """Return a key frame's picture in full size. Call it on a thread."""
    decoded = _make_decoder().feed(key_frame)
    return None if decoded is None else _encode(decoded.picture)


class RescueStream:
    """A converter of one robot's pictures while it is started. Used on the event loop only."""

    def __init__(self, ready: Callable[[RescuedPicture], None]) -> None:
        self._ready = ready
        self._pending: list[bytes] = []  # payloads to be decoded, in order
        self._fed = asyncio.Event()  # there are such
        self._task: asyncio.Task[None] | None = None

    def start(self, chain: Sequence[bytes]) -> None:
        """Start with ``chain``: the newest key frame and all pictures since."""
        if self._task is None:
            self._pending = list(chain)
            self._fed.set()
            self._task = asyncio.create_task(self._run())

    def feed(self, payload: bytes, *, keyframe: bool) -> None:
        """Add a payload. Every payload is needed, as a difference builds on those before it."""
        if self._task is None:
            return
        if keyframe or sum(map(len, self._pending)) > _MAX_WAITING_BYTES:
            self._pending.clear()  # if differences are lost, the decoder notices that, and waits for a key frame
        self._pending.append(payload)
        self._fed.set()

    def stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
            self._task = None
            self._pending.clear()

    async def _run(self) -> None:
        decoder = await asyncio.to_thread(_make_decoder)
        while True:
            await self._fed.wait()
            self._fed.clear()
            batch, self._pending = self._pending, []
            if (picture := await asyncio.to_thread(_convert, decoder, batch)) is not None:
                self._ready(picture)
            await asyncio.sleep(PERIOD_S)


def _make_decoder() -> VideoDecoder:
    from pebble.extensions.media.decode import VideoDecoder

    return VideoDecoder()


def _convert(decoder: VideoDecoder, payloads: Sequence[bytes]) -> RescuedPicture | None:
    newest: Decoded | None = None
    for payload in payloads:
        newest = decoder.feed(payload) or newest
    return None if newest is None else RescuedPicture(_encode(newest.picture, WIDTH), newest.captured_ms or 0)


def _encode(picture: Any, width: int | None = None) -> bytes:
    import cv2

    height, own_width = picture.shape[:2]
    if width is not None and own_width > width:
        picture = cv2.resize(picture, (width, max(1, height * width // own_width)), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
