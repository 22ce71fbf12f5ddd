"""What else happens while commands are measured, as a process that is switched on and off by its standard input.

``python -m pebble.bench.control_load hog|writer|reader [mqtt|zenoh WHERE]``: a busy loop, or one end of a stream of raw
640x480 pictures at 30 Hz, made and read as in ``pebble bench frames``. A line ``1`` has it work, ``0`` rest, ``?``
nothing; each is answered by the pictures so far. It ends with its standard input.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from pebble.bench.frames_loop import RATE_HZ, Reader, Writer
from pebble.bench.frames_worker import MqttReader, MqttWriter, ZenohReader, ZenohWriter

SIZE = 640 * 480 * 3
_READ_S = 0.2
_ALIVE_S = 0.01  # of reading at rest: a client's network loop has to run for it to stay connected
_EVERY = 64  # bytes: a look at every cache line
_REST_S = 1.0  # between two signs of life to a broker


class Switch:
    """On or off, as standard input says; and the count that it is answered with."""

    def __init__(self) -> None:
        self.pictures = 0
        self.on = False
        self.ended = False
        self._changed = threading.Condition()
        threading.Thread(target=self._listen, name="switch", daemon=True).start()

    def wait(self, timeout: float | None = None) -> None:
        """Until it is on or everything ends."""
        with self._changed:
            self._changed.wait_for(lambda: self.on or self.ended, timeout)

    def say(self) -> None:
        sys.stdout.write(json.dumps({"pictures": self.pictures}) + "\n")
        sys.stdout.flush()

    def _listen(self) -> None:
        for line in sys.stdin:
            if line.strip() in ("0", "1"):
                self._set(on=line.strip() == "1")
            self.say()
        self._set(on=False, ended=True)

    def _set(self, *, on: bool, ended: bool = False) -> None:
        with self._changed:
            self.on, self.ended = on, ended
            self._changed.notify_all()


def main(arguments: list[str]) -> int:
    role, *where = arguments
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if role == "hog":
        _hog(Switch())
    elif role == "writer":
        _write(_writer(*where), Switch())
    else:
        _read(_reader(*where), Switch())
    return 0


def _hog(switch: Switch) -> None:
    switch.say()
    while not switch.ended:
        switch.wait()
        while switch.on:
            pass


def _write(writer: Writer, switch: Switch) -> None:
    picture = np.random.default_rng(1).integers(0, 256, SIZE, dtype=np.uint8)
    switch.say()
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
    switch.say()
    while not switch.ended:
        switch.wait(_REST_S)
        frame = reader.read(_READ_S if switch.on else _ALIVE_S)
        if frame is not None:
            switch.pictures += bool(frame[::_EVERY].any())
            del frame
            reader.done()
    reader.close()


def _writer(kind: str, where: str) -> Writer:
    return MqttWriter(int(where), SIZE) if kind == "mqtt" else ZenohWriter(Path(where), SIZE, born=True, shared=True)


def _reader(kind: str, where: str) -> Reader:
    return MqttReader(int(where)) if kind == "mqtt" else ZenohReader(Path(where), views=True, shared=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
