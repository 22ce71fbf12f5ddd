"""Writes and reads time-stamped frames at a steady rate, and measures during a given window.

Runs in two Pythons: Pebble's own, and the system's, where gi and Gst are installed. There it is one end of a transfer
through GStreamer, as a plain file: ``python3 frames_loop.py writer|reader SOCKET 640x480 SLOWER_US``; without
arguments it fails if it could not be. So it imports only the standard library, numpy, and the other end of a worker.

A frame begins with the time it was complete (CLOCK_MONOTONIC, ns) and its number, and ends with its number again. The
time is written last. A process writes ``{"ready": true}``, receives ``FROM UNTIL`` (CLOCK_MONOTONIC, ns) and answers
after that window.
"""

from __future__ import annotations

import math
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

if __package__:
    from pebble.rig import worker_end
else:  # the system's Python runs plain files
    sys.path.append(str(Path(__file__).parents[1] / "rig"))
    import worker_end  # type: ignore[import-not-found, no-redef]

RATE_HZ = 30.0
_WARM_UP = 8  # frames: the first ones create pools and fill caches
_READ_S = 0.2
_LATE_NS = 150_000_000  # how long to wait for the last frames after the window
_GAP_S = 0.010  # between a frame and the bare copy after it
_FRAMES_IN_SEGMENT = 8
_START_NS = 5_000_000_000

Gst: Any = None  # loaded by main(): other Pythons have no gi


class Writer(Protocol):
    """One way of sending frames."""

    @property
    def fallbacks(self) -> int:
        """How many frames did not go through shared memory."""

    def begin(self) -> np.ndarray | None:
        """The buffer for the next frame's pixels (uint8, 1-D); None if no frame can be sent now."""

    def send(self) -> None:
        """Sends the completed frame."""

    def close(self) -> None: ...


class Reader(Protocol):
    """One way of receiving frames."""

    def read(self, timeout: float) -> np.ndarray | None:
        """The next frame, or None after ``timeout`` seconds."""

    def done(self) -> None:
        """Releases the array; nothing to do if it is a copy."""
        return

    def close(self) -> None: ...


class Window:
    """The time in which is measured, as standard input names it; CLOCK_MONOTONIC, ns."""

    def __init__(self) -> None:
        self._begin = self._end = math.inf
        self.ended = worker_end.serve_on_thread(self._take)  # standard input

    def _take(self, line: str) -> None:
        self._begin, self._end = map(int, line.split())

    def __contains__(self, ns: int) -> bool:
        return self._begin <= ns < self._end

    def is_over(self) -> bool:
        """Whether the last frames of the window have had time to arrive."""
        return time.monotonic_ns() >= self._end + _LATE_NS

    def percent(self, ns: int) -> float:
        """Of the window's duration."""
        return 100 * ns / (self._end - self._begin)


def write(writer: Writer, size: int, *, slower_us: float = 0.0) -> None:
    """Writes a frame of ``size`` bytes 30 times a second until standard input closes; answers how many of the window.

    Each frame is delayed by ``slower_us`` of busy work between its time stamp and its sending.
    """
    picture = np.random.default_rng(1).integers(0, 256, size, dtype=np.uint8)
    window, number, sent, answered, due = Window(), 0, 0, False, time.monotonic()
    worker_end.answer({"ready": True})
    while not window.ended.is_set():
        due += 1 / RATE_HZ
        window.ended.wait(max(0.0, due - time.monotonic()))
        frame = writer.begin()
        if frame is not None:
            number += 1
            stamp = _fill(frame, picture, number)
            _spin(slower_us)
            writer.send()
            sent += stamp in window
        if window.is_over() and not answered:
            answered = True
            worker_end.answer({"sent": sent, "fallbacks": writer.fallbacks})
    writer.close()


def _fill(frame: np.ndarray, picture: np.ndarray, number: int) -> int:
    """Fills the frame as a camera does: pixels, then the time, which is returned."""
    np.copyto(frame, picture)
    ends = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
    frame[8:16] = frame[-8:] = ends
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

    With ``bare_copy``, measures instead the time and the CPU (%) of a copy of that many bytes between two frames, when
    the caches hold other data.
    """
    source = np.random.default_rng(2).integers(0, 256, bare_copy, dtype=np.uint8)
    target = np.zeros(bare_copy, np.uint8)
    window, took_ns, torn, frames, answered = Window(), [], 0, 0, False
    while not window.ended.is_set():
        frame = reader.read(_READ_S)
        if frame is not None:
            now, frames = time.monotonic_ns(), frames + 1
            stamp, number = (int.from_bytes(frame[at : at + 8].tobytes(), "little") for at in (0, 8))
            torn += number != int.from_bytes(frame[-8:].tobytes(), "little")
            reader.done()
            del frame
            if stamp in window and not bare_copy:
                took_ns.append(now - stamp)
            elif stamp in window:
                window.ended.wait(_GAP_S)
                took_ns.append(_copy(source, target))
            if frames == _WARM_UP:
                worker_end.answer({"ready": True})
        if window.is_over() and not answered:
            answered = True
            copies = {"cpu": window.percent(sum(took_ns))} if bare_copy else {}
            worker_end.answer({"latencies_us": [took / 1000 for took in took_ns], "torn": torn, **copies})
    reader.close()


def _copy(source: np.ndarray, target: np.ndarray) -> int:
    """The time it takes, in ns."""
    began = time.monotonic_ns()
    np.copyto(target, source)
    return time.monotonic_ns() - began


def frame_bytes(size: str) -> int:
    """Of a picture in BGR of this size: ``640x480``."""
    width, _, height = size.partition("x")
    return int(width) * int(height) * 3


# -- GStreamer's shmsink and shmsrc, in the system's Python


class GstWriter:
    """appsrc into shmsink. As in the original Pebble, pictures are created in the shared segment: no copy is made."""

    def __init__(self, socket: str, caps: str, size: int) -> None:
        self._size, self._caps = size, Gst.Caps.from_string(caps)
        self._pipeline = Gst.parse_launch(
            f"appsrc name=source is-live=true format=time do-timestamp=true max-buffers=2 leaky-type=downstream"
            f" caps={caps} ! shmsink name=sink"
            f" socket-path={socket} shm-size={_FRAMES_IN_SEGMENT * size} wait-for-connection=false sync=false"
        )
        self._source, self._sink = (self._pipeline.get_by_name(name) for name in ("source", "sink"))
        self._pipeline.set_state(Gst.State.PLAYING)
        self._allocator = self._segment()
        self.fallbacks = 0
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

    def _segment(self) -> Any:
        """The allocator that shmsink offers upstream; it exists once the pipeline has started."""
        query = Gst.Query.new_allocation(self._caps, True)
        if not self._sink.get_static_pad("sink").query(query) or not query.get_n_allocation_params():
            raise RuntimeError("shmsink offers no allocator")
        return query.parse_nth_allocation_param(0)[0]


class GstReader(Reader):
    """shmsrc into appsink, which holds only the newest buffer; the reader maps it and copies it once."""

    def __init__(self, socket: str, caps: str) -> None:
        self._pipeline = Gst.parse_launch(
            f"shmsrc socket-path={socket} is-live=true do-timestamp=true ! {caps}"
            " ! appsink name=sink sync=false max-buffers=1 drop=true"
        )
        self._sink = self._pipeline.get_by_name("sink")
        self._pipeline.set_state(Gst.State.PLAYING)
        if self._pipeline.get_state(_START_NS)[0] == Gst.StateChangeReturn.FAILURE:
            raise RuntimeError(f"shmsrc cannot read {socket}")

    def read(self, timeout: float) -> np.ndarray | None:
        sample = self._sink.try_pull_sample(int(timeout * 1e9))
        if sample is None:
            return None
        with sample.get_buffer().map(Gst.MapFlags.READ) as mapped:
            return np.frombuffer(mapped.data, np.uint8).copy()

    def close(self) -> None:
        self._pipeline.set_state(Gst.State.NULL)


def main(arguments: list[str]) -> None:
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
    if not arguments:  # only asked whether it could
        return
    role, socket, size, slower_us = arguments
    width, _, height = size.partition("x")
    caps = f"video/x-raw,format=BGR,width={width},height={height},framerate=30/1"
    if role == "writer":
        write(GstWriter(socket, caps, frame_bytes(size)), frame_bytes(size), slower_us=float(slower_us))
    else:
        read(GstReader(socket, caps))


if __name__ == "__main__":
    main(sys.argv[1:])
