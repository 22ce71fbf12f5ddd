"""What programs expect at the sockets of pictures and of sound, and how a frame becomes that."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from pebble.config.media import AvDaemon
from pebble.errors import PayloadError
from pebble.services.gstreamer_mirror.shm_pipe import Bytes
from pebble.transports.frames import Frame

_CHUNK_S = 0.02  # of sound in one frame of av_daemon
_ROW_UNIT = 4  # bytes: GStreamer's rows of BGR begin at multiples of it


class Form(ABC):
    """The buffers of one socket."""

    encoding: str
    description: str
    width: int | None = None
    height: int | None = None
    stream: str  # where the frames come from
    depth = 1  # how many frames may wait to be sent
    shared = True  # whether frames come through shared memory
    slot_bytes: int
    slots: int

    @abstractmethod
    def buffer(self, frame: Frame) -> tuple[int, Callable[[Bytes], None]]:
        """The size of the buffer, and what writes it. Raises PayloadError for what readers would misread."""


class Pictures(Form):
    """BGR pictures of the configured size, turned as the camera turns them."""

    encoding, stream = "bgr24", "camera"
    slots = 12

    def __init__(self, options: AvDaemon) -> None:
        video = options.video
        sides = video.width, video.height
        self.width, self.height = sides[::-1] if video.rotate_degrees in (90, 270) else sides
        self.description = f"BGR {self.width}x{self.height}"
        self._stride = -(-3 * self.width // _ROW_UNIT) * _ROW_UNIT
        self.slot_bytes = self._stride * self.height

    def buffer(self, frame: Frame) -> tuple[int, Callable[[Bytes], None]]:
        picture = frame.picture()
        height, width, _ = picture.shape
        if (width, height) != (self.width, self.height):
            raise PayloadError(
                f"the camera sends {width}x{height}, and readers expect {self.width}x{self.height}: nothing is shown"
            )

        def draw(room: Bytes) -> None:
            rows = room.reshape(height, self._stride)[:, : 3 * width]
            rows.reshape(height, width, 3)[:] = picture  # a view of the room: the only copy

        return self.slot_bytes, draw


class Sound(Form):
    """Interleaved samples of 16 bits, little endian, in pieces of any length."""

    encoding, stream = "s16le", "microphone"
    depth, shared = 10, False
    slots = 256

    def __init__(self, options: AvDaemon) -> None:
        self._rate, self._channels = options.audio.rate, options.audio.channels
        self.description = f"S16LE {_shown(self._rate, self._channels)}"
        self.slot_bytes = 2 * round(self._rate * _CHUNK_S) * 2 * self._channels

    def buffer(self, frame: Frame) -> tuple[int, Callable[[Bytes], None]]:
        info, data = frame.info, frame.data
        if (info.format, info.rate, info.channels) != ("s16le", self._rate, self._channels):
            raise PayloadError(
                f"the microphone sends {info.format} {_shown(info.rate, info.channels)}, and readers expect "
                f"{self.description}: nothing is heard"
            )
        if data.size > self.slot_bytes:
            raise PayloadError(f"a piece of sound has {data.size} bytes, more than {self.slot_bytes}")

        def draw(room: Bytes) -> None:
            room[:] = data

        return data.size, draw


def _shown(rate: int, channels: int) -> str:
    return f"{rate} Hz, {channels} channel{'s' if channels != 1 else ''}"
