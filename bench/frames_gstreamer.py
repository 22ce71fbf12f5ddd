"""Frames through GStreamer's shmsink and shmsrc: a program for the system's Python, where gi and Gst are installed.

``python3 frames_gstreamer.py writer|reader SOCKET WIDTH HEIGHT SLOWER_US``. As in the original Pebble, the pipeline
writes the picture directly into the shared segment, so the writer makes no copy; the reader maps the newest buffer and
copies it into an array of its own.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

import numpy as np

if __package__:
    from pebble.bench import frames_loop
else:  # the system's Python runs this as a plain file next to frames_loop.py
    import frames_loop  # type: ignore[import-not-found, no-redef]

Gst: Any = None  # loaded by main(): other Pythons may import this file and have no gi
_FRAMES_IN_SEGMENT = 8
_START_NS = 5_000_000_000


class GstWriter:
    """appsrc into shmsink; buffers come from the sink's allocator, so pictures are created in the segment."""

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


class GstReader:
    """shmsrc into appsink, which holds only the newest buffer; the reader copies it once."""

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

    def done(self) -> None:
        """The array is our own."""

    def close(self) -> None:
        self._pipeline.set_state(Gst.State.NULL)


def main(arguments: list[str]) -> None:
    role, socket, width, height, slower_us = arguments
    _load_gst()
    Gst.init(None)
    caps, size = f"video/x-raw,format=BGR,width={width},height={height},framerate=30/1", int(width) * int(height) * 3
    control_pipe = frames_loop.ControlPipe()
    if role == "writer":
        frames_loop.write(GstWriter(socket, caps, size), size, control_pipe, slower_us=float(slower_us))
    else:
        frames_loop.read(GstReader(socket, caps), control_pipe)


def _load_gst() -> None:
    global Gst
    import gi  # type: ignore[import-not-found]

    gi.require_version("Gst", "1.0")
    gi.require_version("GstApp", "1.0")
    Gst = import_module("gi.repository.Gst")
    import_module("gi.repository.GstApp")  # gives appsrc and appsink their methods


if __name__ == "__main__":
    main(sys.argv[1:])
