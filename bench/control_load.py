"""A load during the measurement of commands, as a process that standard input switches on and off.

``python -m pebble.bench.control_load hog|writer|reader [mqtt|zenoh-shm WHERE]``: a busy loop, or one end of a stream of
raw 640x480 pictures at 30 Hz, as in ``pebble bench frames``. Line ``1`` switches it on, ``0`` off, ``?`` does nothing;
each is answered with the number of pictures so far.
"""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np

from pebble.bench import frames_worker
from pebble.bench.frames_loop import RATE_HZ, Reader, Writer
from pebble.rig.worker_end import answer, serve_on_thread

SIZE = 640 * 480 * 3
_READ_S = 0.2
_ALIVE_S = 0.01  # of reading while off: the client's network loop must run to stay connected
_EVERY = 64  # bytes: one in each cache line is read
_REST_S = 1.0  # between two runs of the network loop while off


class Switch:
    """Switches the load as standard input requests, and answers with the number of pictures."""

    def __init__(self) -> None:
        self.pictures = 0
        self._on = threading.Event()
        self.wait = self._on.wait  # until it is on, or standard input closes
        self._ended = serve_on_thread(self._handle, self._on.set)
        answer({"pictures": 0})  # it is ready

    @property
    def ended(self) -> bool:
        return self._ended.is_set()

    @property
    def on(self) -> bool:
        return self._on.is_set() and not self.ended

    def _handle(self, line: str) -> dict[str, Any]:
        if line == "1":
            self._on.set()
        elif line == "0":
            self._on.clear()
        return {"pictures": self.pictures}


def main(role: str, kind: str = "", where: str = "") -> None:
    if role == "hog":
        _hog(Switch())
    elif role == "writer":
        _write(frames_worker.writer(kind, where, SIZE), Switch())
    else:
        _read(frames_worker.reader(kind, where), Switch())


def _hog(switch: Switch) -> None:
    while not switch.ended:
        switch.wait()
        while switch.on:
            pass


def _write(writer: Writer, switch: Switch) -> None:
    picture = np.random.default_rng(1).integers(0, 256, SIZE, dtype=np.uint8)
    while not switch.ended:
        switch.wait()
        due = time.monotonic()
        while switch.on:
            frame = writer.begin()
            if frame is not None:
                np.copyto(frame, picture)
                writer.send()
                switch.pictures += 1
            del frame
            due += 1 / RATE_HZ
            time.sleep(max(0.0, due - time.monotonic()))
    writer.close()


def _read(reader: Reader, switch: Switch) -> None:
    while not switch.ended:
        switch.wait(_REST_S)
        frame = reader.read(_READ_S if switch.on else _ALIVE_S)
        if frame is not None:
            switch.pictures += bool(frame[::_EVERY].any())
            del frame
            reader.done()
    reader.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
