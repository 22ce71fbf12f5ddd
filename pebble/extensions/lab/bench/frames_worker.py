"""The process at either end of a transfer of time-stamped frames, 30 a second.

``python -m pebble.extensions.lab.bench.frames_worker VARIANT ROLE WHERE SIZE``: ``WHERE`` is a folder for sockets, or a
broker's port; ``SIZE`` is ``640x480``. For GStreamer this file runs as a plain file in the system's Python, where gi
and Gst are installed; then it imports only the standard library, numpy and worker_end.py. Without arguments
it only loads GStreamer, and fails if that is not installed.

A frame begins with the time at which its pixels were complete (CLOCK_MONOTONIC, ns). A process writes
``{"ready": true}``, and answers each line with what it has measured so far.
"""

from __future__ import annotations

import struct
import sys
import time
from collections import deque
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

if __package__:
    from pebble.errors import TransportError
    from pebble.extensions.lab.rig import worker_end
    from pebble.extensions.media.frames import FrameInfo, FrameReader, FrameWriter
else:  # the system's Python runs plain files
    sys.path.append(str(Path(__file__).parents[1] / "rig"))
    import worker_end  # type: ignore[import-not-found, no-redef]

RATE_HZ = 30.0
_WARM_UP = 8  # frames: the first ones create pools and fill caches
_READ_S = 0.2
_FRAMES_IN_SEGMENT = 8
_STREAM, _TOPIC = "bench", "pebble/bench/frames"

Gst: Any = None  # loaded by main(): other Pythons have no gi
Fill = Callable[[np.ndarray], None]  # writes the pixels of a frame (uint8, 1-D)


def write(writer: Writer, size: int) -> None:
    """Write a frame of ``size`` bytes 30 times a second until standard input closes; report the frames' times."""
    picture = np.random.default_rng(1).integers(0, 256, size, dtype=np.uint8)
    stamps: list[int] = []  # of the frames, also of those that could not be sent

    def fill(frame: np.ndarray) -> None:
        """Write pixels first, then the time, as a camera does."""
        np.copyto(frame, picture)
        stamps.append(time.monotonic_ns())
        struct.pack_into("<q", frame.data, 0, stamps[-1])

    ended = worker_end.serve_on_thread(lambda _line: {"stamps": stamps})
    worker_end.answer({"ready": True})
    due = time.monotonic()
    while not ended.is_set():
        due += 1 / RATE_HZ
        ended.wait(max(0.0, due - time.monotonic()))
        if not writer.write(fill):
            stamps.append(time.monotonic_ns())  # no reader gets it: it counts as lost
    writer.close()


def read(reader: Reader) -> None:
    """Read frames until standard input closes; report the time of each frame and of its arrival."""
    arrived: list[tuple[int, int]] = []
    ended = worker_end.serve_on_thread(lambda _line: {"arrived": arrived})
    while not ended.is_set():
        frame = reader.read(_READ_S)
        if frame is None:
            continue
        now = time.monotonic_ns()
        (stamp,) = struct.unpack_from("<q", frame.data)
        del frame  # releases a view before the next frame
        arrived.append((stamp, now))
        if len(arrived) == _WARM_UP:
            worker_end.answer({"ready": True})
    reader.close()


# -- Pebble's frame transport. ``write`` sends the frame that ``fill`` writes; false: none can be sent now. ``read``
#    returns the next frame, or None after a timeout; a view is released as soon as it is deleted.


class ZenohWriter:
    """A writer that creates frames in the shared memory, as services do."""

    def __init__(self, folder: Path, size: int) -> None:
        self._info, self._frame = FrameInfo(format="bgr24"), np.zeros(size, np.uint8)
        self._writer = FrameWriter(folder, _STREAM, capacity=size).open()
        _refuse(self._writer.problem)
        self.close = self._writer.close

    def write(self, fill: Fill) -> bool:
        """Send the frame that ``fill`` writes. While there is no reader, send nothing and return False."""
        if not self._writer.wanted:
            return False
        slot = self._writer.slot(len(self._frame))
        fill(self._frame if slot is None else slot.array)
        if slot is None:  # no part of the shared memory is free now: the writer sends a copy
            self._writer.write(self._frame, self._info)
        else:
            slot.send(self._info)
        return True


class ZenohReader:
    """A reader whose frames are views of the shared memory, not copies."""

    def __init__(self, folder: Path) -> None:
        self._reader = FrameReader(folder, _STREAM, views=True).open()
        self.close = self._reader.close

    def read(self, timeout: float) -> np.ndarray | None:
        frame = self._reader.read(timeout)
        _refuse(self._reader.problem)
        return None if frame is None else frame.data


def _refuse(problem: str) -> None:
    """Raise TransportError if there is a problem: frames then take another way, and would count for this variant."""
    if problem:
        raise TransportError(problem)


# -- MQTT, QoS 0


class MqttWriter:
    """A writer that begins a frame only after the last one was sent."""

    def __init__(self, port: int, size: int) -> None:
        self._client, self._frame, self._leaving = _mqtt(port), bytearray(size), None
        self._client.loop_start()
        self.close = self._client.disconnect

    def write(self, fill: Fill) -> bool:
        """Send the frame that ``fill`` writes; return False, without one, while the last one is still being sent."""
        if self._leaving is not None and not self._leaving.is_published():
            return False
        fill(np.frombuffer(self._frame, np.uint8))
        self._leaving = self._client.publish(_TOPIC, self._frame, qos=0)
        return True


class MqttReader:
    """A reader that runs paho's network loop on the reading thread, which saves a switch of threads."""

    def __init__(self, port: int) -> None:
        self._arrived: deque[bytes] = deque(maxlen=1)
        self._client = _mqtt(port)
        self._client.on_message = lambda _client, _data, message: self._arrived.append(message.payload)
        self._client.subscribe(_TOPIC, qos=0)
        self.close = self._client.disconnect

    def read(self, timeout: float) -> np.ndarray | None:
        end = time.monotonic() + timeout
        while not self._arrived:
            remaining_s = end - time.monotonic()
            if remaining_s <= 0:
                return None
            self._client.loop(remaining_s)
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


class GstWriter:
    """A writer: appsrc into shmsink. As in the original, pictures are created in the shared segment without a copy."""

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

    def write(self, fill: Fill) -> bool:
        """Send the frame that ``fill`` writes; return False, without one, if no buffer can be allocated."""
        buffer = Gst.Buffer.new_allocate(self._allocator, self._size, None)
        if buffer is None:
            return False
        with buffer.map(Gst.MapFlags.WRITE) as mapped:
            fill(np.frombuffer(mapped.data, np.uint8))
        self._source.push_buffer(buffer)
        return True

    def close(self) -> None:
        """Close: shmsink removes its socket and its segment."""
        self._pipeline.set_state(Gst.State.NULL)


class GstReader:
    """A reader: shmsrc into appsink, which holds only the newest buffer; the reader maps it and copies it once."""

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
    if not all(map(Gst.ElementFactory.find, ("shmsink", "shmsrc", "appsrc", "appsink"))):
        raise RuntimeError("GStreamer has no shmsink, shmsrc, appsrc or appsink")


# -- the process

Writer = ZenohWriter | MqttWriter | GstWriter
Reader = ZenohReader | MqttReader | GstReader


def writer(variant: str, where: str, size: int, caps: str = "") -> Writer:
    """Return a writer. ``size`` in bytes; ``caps``: the format of frames, for GStreamer."""
    if variant == "gstreamer-shm":
        return GstWriter(f"{where}/gst.sock", caps, size)
    return MqttWriter(int(where), size) if variant == "mqtt" else ZenohWriter(Path(where), size)


def reader(variant: str, where: str, caps: str = "") -> Reader:
    if variant == "gstreamer-shm":
        return GstReader(f"{where}/gst.sock", caps)
    return MqttReader(int(where)) if variant == "mqtt" else ZenohReader(Path(where))


def main(arguments: list[str]) -> None:
    if not __package__:  # in the system's Python
        _load_gstreamer()
    if not arguments:
        return
    variant, role, where, size = arguments
    width, height = map(int, size.split("x"))
    count, caps = 3 * width * height, f"video/x-raw,format=BGR,width={width},height={height},framerate=30/1"
    if role == "writer":
        write(writer(variant, where, count, caps), count)
    else:
        read(reader(variant, where, caps))


if __name__ == "__main__":
    main(sys.argv[1:])
