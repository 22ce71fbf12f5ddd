"""One end of a transfer of time-stamped frames, 30 a second, as a process that measures during a given window.

``python -m pebble.bench.frames_worker VARIANT ROLE WHERE SIZE SLOWER_US``: ``WHERE`` is a folder for sockets, or a
broker's port; ``SIZE`` is ``640x480``; a writer delays each frame by ``SLOWER_US``. One end of GStreamer's is this
file in the system's Python, where gi and Gst are installed; without arguments it fails if it could not be. So a plain
file imports only the standard library, numpy, and the other end of a worker.

A frame begins with the time it was complete (CLOCK_MONOTONIC, ns) and its number, and ends with its number again. The
time is written last. A process writes ``{"ready": true}``, receives ``FROM UNTIL`` (CLOCK_MONOTONIC, ns), and answers
an empty line with what it measured in that window.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

if __package__:
    from pebble.errors import TransportError
    from pebble.rig import worker_end
    from pebble.transports.frames import FrameInfo, FrameReader, FrameWriter, Slot, shared_memory
else:  # the system's Python runs plain files
    sys.path.append(str(Path(__file__).parents[1] / "rig"))
    import worker_end  # type: ignore[import-not-found, no-redef]

RATE_HZ = 30.0
_WARM_UP = 8  # frames: the first ones create pools and fill caches
_READ_S = 0.2
_GAP_S = 0.010  # between a frame and the bare copy after it
_FRAMES_IN_SEGMENT = 8
_STREAM, _TOPIC = "bench", "pebble/bench/frames"
_WITHOUT_COPIES = ("zenoh-shm", "memcpy")

Gst: Any = None  # loaded by main(): other Pythons have no gi


class Writer(Protocol):
    """One way of sending frames; ``fallbacks`` did not go through shared memory."""

    fallbacks: int = 0

    def begin(self) -> np.ndarray | None:
        """The buffer for the next frame's pixels (uint8, 1-D); None if no frame can be sent now."""

    def send(self) -> None: ...

    def close(self) -> None:
        return


class Reader(Protocol):
    """One way of receiving frames."""

    def read(self, timeout: float) -> np.ndarray | None:
        """The next frame, or None after ``timeout`` seconds. A view is released as soon as it is deleted."""

    def close(self) -> None:
        return


class Window:
    """The time in which is measured (``ns``), and the end of standard input, which names it."""

    def __init__(self, results: Callable[[], dict[str, Any]]) -> None:
        self.ns, self._results = range(0), results
        self.ended = worker_end.serve_on_thread(self._handle)

    def _handle(self, line: str) -> dict[str, Any] | None:
        if not line:
            return self._results()
        self.ns = range(*map(int, line.split()))
        return None


def write(writer: Writer, size: int, *, slower_us: float) -> None:
    """Writes a frame of ``size`` bytes 30 times a second until standard input closes; answers how many of the window.

    Each frame is delayed by ``slower_us`` of busy work between its time stamp and its sending.
    """
    picture = np.random.default_rng(1).integers(0, 256, size, dtype=np.uint8)
    stamps: list[int] = []
    window = Window(lambda: {"sent": sum(one in window.ns for one in stamps), "fallbacks": writer.fallbacks})
    worker_end.answer({"ready": True})
    due = time.monotonic()
    while not window.ended.is_set():
        due += 1 / RATE_HZ
        window.ended.wait(max(0.0, due - time.monotonic()))
        frame = writer.begin()
        if frame is not None:
            stamps.append(_fill(frame, picture, len(stamps) + 1))
            _spin(slower_us)
            writer.send()
    writer.close()


def _fill(frame: np.ndarray, picture: np.ndarray, number: int) -> int:
    """Fills the frame as a camera does: pixels, then the time, which is returned."""
    np.copyto(frame, picture)
    frame[8:16] = frame[-8:] = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
    stamp = time.monotonic_ns()
    frame[:8] = np.frombuffer(stamp.to_bytes(8, "little"), np.uint8)
    return stamp


def _spin(us: float) -> None:
    """Same as pebble.bench.null.spin, which the system's Python cannot import."""
    end = time.perf_counter_ns() + int(1000 * us)
    while time.perf_counter_ns() < end:
        pass


def read(reader: Reader, *, bare_copy: int = 0) -> None:
    """Reads until standard input closes; answers with every latency of the window in µs.

    With ``bare_copy``, measures instead the time of a copy of that many bytes between two frames, when the caches hold
    other data.
    """
    source = np.random.default_rng(2).integers(0, 256, bare_copy, dtype=np.uint8)
    target = np.zeros(bare_copy, np.uint8)
    latencies_us: list[float] = []
    frames = torn = 0
    window = Window(lambda: {"latencies_us": latencies_us, "torn": torn})
    while not window.ended.is_set():
        frame = reader.read(_READ_S)
        if frame is None:
            continue
        now, frames = time.monotonic_ns(), frames + 1
        stamp, number, last = (int.from_bytes(frame[at:][:8].tobytes(), "little") for at in (0, 8, -8))
        torn += number != last
        del frame
        if stamp in window.ns:
            if bare_copy:
                window.ended.wait(_GAP_S)
                stamp = time.monotonic_ns()
                np.copyto(target, source)
                now = time.monotonic_ns()
            latencies_us.append((now - stamp) / 1000)
        if frames == _WARM_UP:
            worker_end.answer({"ready": True})
    reader.close()


# -- Pebble's frame transport


class ZenohWriter(Writer):
    """Frames are created in the shared segment, or copied there, or sent as bytes."""

    def __init__(self, variant: str, folder: Path, size: int) -> None:
        self._size, self._in_segment, self._info = size, variant in _WITHOUT_COPIES, FrameInfo(format="bgr24")
        self._writer = FrameWriter(folder, _STREAM, capacity=size).open()
        _refuse(self._writer.problem, variant)
        self._frame = np.zeros(size, np.uint8)
        self._slot: Slot | None = None

    def begin(self) -> np.ndarray | None:
        if not self._writer.wanted:
            return None
        self._slot = self._writer.slot(self._size) if self._in_segment else None
        return self._frame if self._slot is None else self._slot.array

    def send(self) -> None:
        if self._slot is not None:
            self._slot.send(self._info)
        else:
            self._writer.write(self._frame, self._info)
        self.fallbacks = self._writer.counters["fallbacks"]

    def close(self) -> None:
        self._slot = None
        self._writer.close()


class ZenohReader(Reader):
    """Frames are views into the segment, or copies."""

    def __init__(self, variant: str, folder: Path) -> None:
        self._variant = variant
        self._reader = FrameReader(folder, _STREAM, views=variant in _WITHOUT_COPIES).open()

    def read(self, timeout: float) -> np.ndarray | None:
        frame = self._reader.read(timeout)
        _refuse(self._reader.problem, self._variant)
        return None if frame is None else frame.data

    def close(self) -> None:
        self._reader.close()


def _refuse(problem: str, variant: str) -> None:
    """Raises TransportError: results of frames that took another way would be labelled wrongly."""
    if problem and variant != "zenoh-net":
        raise TransportError(problem)


# -- MQTT, QoS 0


class MqttWriter(Writer):
    """The next frame is not begun before the last one is sent."""

    def __init__(self, port: int, size: int) -> None:
        self._client, self._frame, self._leaving = _mqtt(port), bytearray(size), None
        self._client.loop_start()

    def begin(self) -> np.ndarray | None:
        if self._leaving is not None and not self._leaving.is_published():
            return None
        return np.frombuffer(self._frame, np.uint8)

    def send(self) -> None:
        self._leaving = self._client.publish(_TOPIC, self._frame, qos=0)


class MqttReader(Reader):
    """Runs paho's network loop in the reading thread, which avoids a handover between threads."""

    def __init__(self, port: int) -> None:
        self._arrived: deque[bytes] = deque(maxlen=1)
        self._client = _mqtt(port)
        self._client.on_message = lambda _client, _data, message: self._arrived.append(message.payload)
        self._client.subscribe(_TOPIC, qos=0)

    def read(self, timeout: float) -> np.ndarray | None:
        end = time.monotonic() + timeout
        while not self._arrived:
            left = end - time.monotonic()
            if left <= 0:
                return None
            self._client.loop(left)
        return np.frombuffer(self._arrived.popleft(), np.uint8)


def _mqtt(port: int) -> Any:
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2)
    client.connect("127.0.0.1", port)
    while not client.is_connected():
        client.loop(0.05)
    return client


# -- GStreamer's shmsink and shmsrc, in the system's Python


class GstWriter(Writer):
    """appsrc into shmsink. As in the original Pebble, pictures are created in the shared segment: no copy is made."""

    def __init__(self, socket: str, caps: str, size: int) -> None:
        self._size = size
        self._pipeline = Gst.parse_launch(
            f"appsrc name=source is-live=true format=time do-timestamp=true max-buffers=2 leaky-type=downstream"
            f" caps={caps} ! shmsink name=sink"
            f" socket-path={socket} shm-size={_FRAMES_IN_SEGMENT * size} wait-for-connection=false sync=false"
        )
        self._source, sink = (self._pipeline.get_by_name(name) for name in ("source", "sink"))
        self._pipeline.set_state(Gst.State.PLAYING)
        # The allocator that shmsink offers upstream exists once the pipeline has started.
        query = Gst.Query.new_allocation(Gst.Caps.from_string(caps), True)
        if not sink.get_static_pad("sink").query(query) or not query.get_n_allocation_params():
            raise RuntimeError("shmsink offers no allocator")
        self._allocator = query.parse_nth_allocation_param(0)[0]
        self._buffer: Any = None
        self._mapped: Any = None

    def begin(self) -> np.ndarray | None:
        self._buffer = Gst.Buffer.new_allocate(self._allocator, self._size, None)
        if self._buffer is None:
            return None
        self._mapped = self._buffer.map(Gst.MapFlags.WRITE)
        return np.frombuffer(self._mapped.__enter__().data, np.uint8)

    def send(self) -> None:
        self._mapped.__exit__(None, None, None)
        self._source.push_buffer(self._buffer)
        self._buffer = self._mapped = None

    def close(self) -> None:
        """shmsink removes its socket and its segment."""
        self._pipeline.set_state(Gst.State.NULL)


class GstReader(Reader):
    """shmsrc into appsink, which holds only the newest buffer; the reader maps it and copies it once."""

    def __init__(self, socket: str, caps: str) -> None:
        self._pipeline = Gst.parse_launch(
            f"shmsrc socket-path={socket} is-live=true do-timestamp=true ! {caps}"
            " ! appsink name=sink sync=false max-buffers=1 drop=true"
        )
        self._sink = self._pipeline.get_by_name("sink")
        self._pipeline.set_state(Gst.State.PLAYING)

    def read(self, timeout: float) -> np.ndarray | None:
        sample = self._sink.try_pull_sample(int(timeout * 1e9))
        if sample is None:
            return None
        with sample.get_buffer().map(Gst.MapFlags.READ) as mapped:
            return np.frombuffer(mapped.data, np.uint8).copy()

    def close(self) -> None:
        self._pipeline.set_state(Gst.State.NULL)


def _load_gstreamer() -> None:
    global Gst
    import gi  # type: ignore[import-not-found]

    gi.require_version("Gst", "1.0")
    gi.require_version("GstApp", "1.0")
    Gst = import_module("gi.repository.Gst")
    import_module("gi.repository.GstApp")  # gives appsrc and appsink their methods
    Gst.init(None)
    for name in ("shmsink", "shmsrc", "appsrc", "appsink"):
        if not Gst.ElementFactory.find(name):
            raise RuntimeError(f"GStreamer has no {name}")


# -- the process


def writer(variant: str, where: str, size: int, caps: str = "") -> Writer:
    """``size`` in bytes; ``caps``: the format of frames, for GStreamer."""
    if variant == "gstreamer-shm":
        return GstWriter(f"{where}/gst.sock", caps, size)
    if variant == "mqtt":
        return MqttWriter(int(where), size)
    return ZenohWriter(variant, Path(where), size)


def reader(variant: str, where: str, caps: str = "") -> Reader:
    if variant == "gstreamer-shm":
        return GstReader(f"{where}/gst.sock", caps)
    if variant == "mqtt":
        return MqttReader(int(where))
    return ZenohReader(variant, Path(where))


def main(arguments: list[str]) -> None:
    if not __package__:
        _load_gstreamer()
    if not arguments:  # only asked whether it could
        return
    variant, role, where, size, slower_us = arguments
    width, height = map(int, size.split("x"))
    count, caps = 3 * width * height, f"video/x-raw,format=BGR,width={width},height={height},framerate=30/1"
    if variant == "zenoh-net":  # as on a system where memory may not be locked: frames are sent as bytes
        shared_memory.lockable = lambda size: False  # noqa: ARG005
    if role == "writer":
        write(writer(variant, where, count, caps), count, slower_us=float(slower_us))
    else:
        read(reader(variant, where, caps), bare_copy=count if variant == "memcpy" else 0)


if __name__ == "__main__":
    main(sys.argv[1:])
