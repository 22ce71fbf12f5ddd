"""Writes and reads stamped frames at a steady pace, and measures while it is told to.

Runs in two Pythons: Pebble's own, and the system's, which alone knows GStreamer. So: the standard library and numpy,
no import of Pebble.

A frame begins with the time it was complete (CLOCK_MONOTONIC, ns) and its number, and ends with its number again. The
time is written last. A process says ``{"ready": true}`` on standard output, is told ``FROM UNTIL`` (CLOCK_MONOTONIC,
ns) on standard input, answers with one JSON object when that is over, and ends with its standard input.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any, Protocol

import numpy as np

RATE_HZ = 30.0
SMALLEST = 24  # bytes: two stamps and a number
_WARM_UP = 8  # frames: pools are made and caches are filled with the first ones
_READ_S = 0.2
_LATE_NS = 150_000_000  # how long after the window its last frames are waited for
_GAP_S = 0.010  # from a frame to the bare copy after it


class Writer(Protocol):
    """One way of sending frames."""

    @property
    def fallbacks(self) -> int:
        """How many frames had to go another way than through shared memory."""

    def begin(self) -> np.ndarray | None:
        """Where the next frame's pixels go (uint8, 1-D); None: nobody can take one now."""

    def send(self) -> None:
        """The frame is complete."""

    def close(self) -> None: ...


class Reader(Protocol):
    """One way of getting them."""

    def read(self, timeout: float) -> np.ndarray | None:
        """The next frame, or None after ``timeout`` seconds."""

    def done(self) -> None:
        """Nobody looks at the array any more."""

    def close(self) -> None: ...


class Orders:
    """What this process was told; a thread of its own listens."""

    def __init__(self) -> None:
        self.window: tuple[int, int] | None = None
        self.ended = threading.Event()
        threading.Thread(target=self._listen, name="orders", daemon=True).start()

    def say(self, what: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps(what) + "\n")
        sys.stdout.flush()

    def _listen(self) -> None:
        for line in iter(sys.stdin.readline, ""):
            begin, end = line.split()
            self.window = (int(begin), int(end))
        self.ended.set()


class Cpu:
    """How much of one core this process took during the window, in per cent."""

    def __init__(self) -> None:
        self._begin: tuple[int, int] | None = None
        self.percent: float | None = None

    def look(self, window: tuple[int, int] | None, now: int) -> None:
        """To be called again and again; ``now`` is time.monotonic_ns()."""
        if window is None or now < window[0] or self.percent is not None:
            return
        if self._begin is None:
            self._begin = (now, time.process_time_ns())
        elif now >= window[1]:
            self.percent = 100 * (time.process_time_ns() - self._begin[1]) / (now - self._begin[0])


def write(writer: Writer, size: int, orders: Orders, *, slower_us: float = 0.0) -> None:
    """Write a frame of ``size`` bytes 30 times a second until the orders end; the answer says CPU and frames sent.

    Between its time stamp and its sending each frame is held up for ``slower_us``, busily.
    """
    picture = np.random.default_rng(1).integers(0, 256, size, dtype=np.uint8)
    cpu, number, sent, refused, due = Cpu(), 0, 0, 0, time.monotonic()
    reported = False
    orders.say({"ready": True})
    while not orders.ended.is_set():
        due += 1 / RATE_HZ
        orders.ended.wait(max(0.0, due - time.monotonic()))
        frame = writer.begin()
        if frame is not None:
            number += 1
            stamp = _fill(frame, picture, number)
            _spin(slower_us)
            writer.send()
            sent += _within(orders.window, stamp)
        else:
            refused += _within(orders.window, time.monotonic_ns())
        cpu.look(orders.window, time.monotonic_ns())
        if cpu.percent is not None and not reported:
            reported = True
            orders.say({"cpu": cpu.percent, "sent": sent, "refused": refused, "fallbacks": writer.fallbacks})
    writer.close()


def _within(window: tuple[int, int] | None, at: int) -> bool:
    return window is not None and window[0] <= at < window[1]


def _fill(frame: np.ndarray, picture: np.ndarray, number: int) -> int:
    """What a camera does: fresh pixels, and then the time, which is returned."""
    np.copyto(frame, picture)
    ends = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
    frame[8:16] = frame[-8:] = ends
    stamp = time.monotonic_ns()
    frame[:8] = np.frombuffer(stamp.to_bytes(8, "little"), np.uint8)
    return stamp


def _spin(us: float) -> None:
    """As pebble.bench.null.spin, which the other Python cannot import."""
    end = time.perf_counter_ns() + int(1000 * us)
    while time.perf_counter_ns() < end:
        pass


def read(reader: Reader, orders: Orders, *, bare_copy: int = 0) -> None:
    """Read until the orders end; the answer holds every latency of the window in µs.

    With ``bare_copy``: instead, how long a copy of so many bytes takes between two frames, when other things have been
    in the caches.
    """
    cpu, latencies, torn, frames, reported = Cpu(), [], 0, 0, False
    copier = Copier(bare_copy) if bare_copy else None
    while not orders.ended.is_set():
        frame = reader.read(_READ_S)
        now = time.monotonic_ns()
        cpu.look(orders.window, now)
        if frame is not None:
            frames += 1
            stamp, number = (int.from_bytes(frame[at : at + 8].tobytes(), "little") for at in (0, 8))
            torn += number != int.from_bytes(frame[-8:].tobytes(), "little")
            reader.done()
            del frame
            if _within(orders.window, stamp):
                latencies.append((now - stamp) / 1000)
                if copier is not None:
                    copier.copy(orders.ended)
            if frames == _WARM_UP:
                orders.say({"ready": True})
        if not reported and orders.window is not None and now >= orders.window[1] + _LATE_NS:
            reported = True
            answer = {"cpu": cpu.percent, "latencies_us": latencies, "torn": torn}
            if copier is not None:
                answer |= copier.answer(orders.window)
            orders.say(answer)
    reader.close()


class Copier:
    """A bare copy of as many bytes as a frame has."""

    def __init__(self, size: int) -> None:
        self._from = np.random.default_rng(2).integers(0, 256, size, dtype=np.uint8)
        self._to = np.zeros(size, np.uint8)
        self._took_ns: list[int] = []

    def copy(self, ended: threading.Event) -> None:
        ended.wait(_GAP_S)
        began = time.monotonic_ns()
        np.copyto(self._to, self._from)
        self._took_ns.append(time.monotonic_ns() - began)

    def answer(self, window: tuple[int, int]) -> dict[str, Any]:
        share = 100 * sum(self._took_ns) / (window[1] - window[0])
        return {"latencies_us": [took / 1000 for took in self._took_ns], "cpu": share}
