"""One end of a frame transfer, as a process.

``python -m pebble.bench.frames_worker VARIANT ROLE WHERE SIZE SLOWER_US``: ``WHERE`` is a folder for sockets, or a
broker's port; ``SIZE`` is ``640x480``; a writer delays each frame by ``SLOWER_US``.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from pebble.bench.frames_loop import Reader, Writer, frame_bytes, read, write
from pebble.errors import TransportError
from pebble.transports.frames import Frame, FrameInfo, FrameReader, FrameWriter, Slot, shared_memory

STREAM = "bench"
_TOPIC = "pebble/bench/frames"
_CONNECT_S = 10.0
_WITHOUT_COPIES = ("zenoh-shm", "memcpy")
_INFO = FrameInfo(format="bgr24")


class ZenohWriter:
    """Pebble's frame transport; ``in_segment``: frames are created in the shared segment, else copied there."""

    def __init__(self, folder: Path, size: int, *, in_segment: bool, shared: bool) -> None:
        self._size, self._in_segment = size, in_segment
        self._writer = FrameWriter(folder, STREAM, capacity=size).open()
        _refuse(self._writer.problem if shared else "")
        self._frame = np.zeros(size, np.uint8)
        self._slot: Slot | None = None

    def begin(self) -> np.ndarray | None:
        if not self._writer.wanted:
            return None
        self._slot = self._writer.slot(self._size) if self._in_segment else None
        return self._frame if self._slot is None else self._slot.array

    def send(self) -> None:
        if self._slot is not None:
            self._slot.send(_INFO)
        else:
            self._writer.write(self._frame, _INFO)

    @property
    def fallbacks(self) -> int:
        return self._writer.counters["fallbacks"]

    def close(self) -> None:
        self._slot = None
        self._writer.close()


class ZenohReader(Reader):
    """Pebble's frame transport, as views into the segment or as copies."""

    def __init__(self, folder: Path, *, views: bool, shared: bool) -> None:
        self._shared = shared
        self._reader = FrameReader(folder, STREAM, views=views).open()
        self._frame: Frame | None = None

    def read(self, timeout: float) -> np.ndarray | None:
        self._frame = self._reader.read(timeout)
        _refuse(self._reader.problem if self._shared else "")
        return None if self._frame is None else self._frame.data

    def done(self) -> None:
        self._frame = None

    def close(self) -> None:
        self._reader.close()


def _refuse(problem: str) -> None:
    """Raises TransportError: results of frames that took another way would be labelled wrongly."""
    if problem:
        raise TransportError(problem)


class MqttWriter:
    """QoS 0 through a broker. The next frame is not begun before the last one is sent."""

    def __init__(self, port: int, size: int) -> None:
        self._client = _mqtt(port, None)
        self._client.loop_start()
        self.fallbacks = 0
        self._frame = bytearray(size)
        self._leaving: Any = None

    def begin(self) -> np.ndarray | None:
        if self._leaving is not None and not self._leaving.is_published():
            return None
        return np.frombuffer(self._frame, np.uint8)

    def send(self) -> None:
        self._leaving = self._client.publish(_TOPIC, self._frame, qos=0)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


class MqttReader(Reader):
    """Runs paho's network loop in the reading thread, which avoids a handover between threads."""

    def __init__(self, port: int) -> None:
        self._arrived: deque[bytes] = deque(maxlen=1)
        self._client = _mqtt(port, lambda _client, _data, message: self._arrived.append(message.payload))
        self._client.subscribe(_TOPIC, qos=0)

    def read(self, timeout: float) -> np.ndarray | None:
        end = time.monotonic() + timeout
        while not self._arrived:
            left = end - time.monotonic()
            if left <= 0:
                return None
            self._client.loop(left)
        return np.frombuffer(self._arrived.popleft(), np.uint8)

    def close(self) -> None:
        self._client.disconnect()


def _mqtt(port: int, on_message: Any) -> Any:
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = on_message
    client.connect("127.0.0.1", port)
    end = time.monotonic() + _CONNECT_S
    while not client.is_connected() and time.monotonic() < end:
        client.loop(0.05)
    return client


def main(arguments: list[str]) -> int:
    variant, role, where, size_, slower_us = arguments
    size = frame_bytes(size_)
    if variant == "zenoh-net":  # as on a system where memory may not be locked: frames are sent as bytes
        shared_memory.lockable = lambda size: False  # noqa: ARG005
    if role == "writer":
        write(writer(variant, where, size), size, slower_us=float(slower_us))
    else:
        read(reader(variant, where), bare_copy=size if variant == "memcpy" else 0)
    return 0


def writer(variant: str, where: str, size: int) -> Writer:
    if variant == "mqtt":
        return MqttWriter(int(where), size)
    return ZenohWriter(Path(where), size, in_segment=variant in _WITHOUT_COPIES, shared=variant != "zenoh-net")


def reader(variant: str, where: str) -> Reader:
    if variant == "mqtt":
        return MqttReader(int(where))
    return ZenohReader(Path(where), views=variant in _WITHOUT_COPIES, shared=variant != "zenoh-net")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
