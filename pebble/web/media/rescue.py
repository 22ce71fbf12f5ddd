"""Pictures as plain JPEGs, for pages that cannot decode a robot's encoding, or whose connection cannot carry it.

One stream per robot for all who need it: the server decodes, and sends at most five pictures a second, always the
newest; over a thin connection smaller ones, because a large one would delay everything else. cv2 and PyAV are
imported with the first picture, for they take memory that most servers never need.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pebble.media import pyav

if TYPE_CHECKING:
    from pebble.media.decode import Decoded, VideoDecoder

PERIOD_S: Final = 0.2
_MAX_WAITING_BYTES: Final = 16 << 20


class Form(NamedTuple):
    """What the pictures are like."""

    quality: int
    width: int | None = None  # pixels, at most; None: as they come


FULL: Final = Form(60)
SMALL: Final = Form(40, 320)


class RescuedPicture(NamedTuple):
    jpeg: bytes
    captured_ms: int  # 0: unknown


def unavailable(encoding: str) -> str:
    """Why this server cannot decode ``encoding``; empty if it can."""
    return f"this server cannot convert h264: it {pyav.INSTALL}" if encoding == "h264" and not pyav.installed() else ""


def newest_jpeg(payloads: Sequence[bytes]) -> RescuedPicture | None:
    """The last picture of a key frame and the differences after it. Takes milliseconds: call it on a thread."""
    decoded = _newest(_make_decoder(), payloads)
    return None if decoded is None else _encode(decoded, FULL)


class RescueStream:
    """Converts the pictures of one robot while it is started, to all ``forms``. All methods run on the event loop."""

    def __init__(self, ready: Callable[[Form, RescuedPicture], None]) -> None:
        self.forms: Sequence[Form] = ()
        self._ready = ready
        self._pending: list[bytes] = []
        self._fed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    @property
    def started(self) -> bool:
        return self._task is not None

    def start(self, chain: Sequence[bytes]) -> None:
        """Begin with ``chain``: the newest key frame and all pictures since."""
        if self._task is None:
            self._pending = list(chain)
            self._fed.set()
            self._task = asyncio.create_task(self._run())

    def feed(self, payload: bytes, *, keyframe: bool) -> None:
        """Give it every payload: a difference needs all before it."""
        if self._task is None:
            return
        if keyframe or sum(map(len, self._pending)) > _MAX_WAITING_BYTES:
            self._pending.clear()  # the decoder notices what is missing, and waits for a key frame
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
            for form, picture in await asyncio.to_thread(_convert, decoder, batch, self.forms):
                self._ready(form, picture)
            await asyncio.sleep(PERIOD_S)


def _make_decoder() -> VideoDecoder:
    from pebble.media.decode import VideoDecoder

    return VideoDecoder()


def _convert(
    decoder: VideoDecoder, payloads: Sequence[bytes], forms: Sequence[Form]
) -> list[tuple[Form, RescuedPicture]]:
    newest = _newest(decoder, payloads)
    return [] if newest is None else [(form, _encode(newest, form)) for form in forms]


def _newest(decoder: VideoDecoder, payloads: Sequence[bytes]) -> Decoded | None:
    newest: Decoded | None = None
    for payload in payloads:
        newest = decoder.feed(payload) or newest
    return newest


def _encode(decoded: Decoded, form: Form) -> RescuedPicture:
    import cv2

    picture: Any = decoded.picture
    height, width = picture.shape[:2]
    if form.width is not None and width > form.width:
        size = (form.width, max(1, height * form.width // width))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, form.quality])[1]
    return RescuedPicture(jpeg.tobytes(), decoded.captured_ms or 0)
