"""Writes and reads time-stamped frames at a steady rate, and measures during a given window.

Runs in two Pythons: Pebble's own, and the system's, which has GStreamer. So it imports only the standard library,
numpy, and the other end of a worker.

A frame begins with the time it was complete (CLOCK_MONOTONIC, ns) and its number, and ends with its number again. The
time is written last. A process writes ``{"ready": true}``, receives ``FROM UNTIL`` (CLOCK_MONOTONIC, ns) and answers
after that window.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from typing import Any, Protocol

import numpy as np

if __package__:
    from pebble.rig import worker_end
else:  # the system's Python runs plain files
    sys.path.append(str(Path(__file__).parents[1] / "rig"))
    import worker_end  # type: ignore[import-not-found, no-redef]

RATE_HZ = 30.0
SMALLEST = 24  # bytes: two stamps and a number
_WARM_UP = 8  # frames: the first ones create pools and fill caches
_READ_S = 0.2
_LATE_NS = 150_000_000  # how long to wait for the last frames after the window
_GAP_S = 0.010  # between a frame and the bare copy after it


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
        """Releases the array."""

    def close(self) -> None: ...


class ControlPipe:
    """The window that this process was given; the other end of a worker."""

    def __init__(self) -> None:
        self.window: tuple[int, int] | None = None
        self.ended = worker_end.serve_on_thread(self._take)

    def _take(self, line: str) -> None:
        begin, end = line.split()
        self.window = (int(begin), int(end))


class Cpu:
    """CPU usage of this process during the window, in per cent of one core."""

    def __init__(self) -> None:
        self._begin: tuple[int, int] | None = None
        self.percent: float | None = None

    def poll(self, window: tuple[int, int] | None, now: int) -> None:
        """Updates the measurement; called repeatedly with ``now`` = time.monotonic_ns()."""
        if window is None or now < window[0] or self.percent is not None:
            return
        if self._begin is None:
            self._begin = (now, time.process_time_ns())
        elif now >= window[1]:
            self.percent = 100 * (time.process_time_ns() - self._begin[1]) / (now - self._begin[0])


def write(writer: Writer, size: int, control_pipe: ControlPipe, *, slower_us: float = 0.0) -> None:
    """Writes a frame of ``size`` bytes 30 times a second until standard input closes; answers with CPU and frames sent.

    Each frame is delayed by ``slower_us`` of busy work between its time stamp and its sending.
    """
    picture = np.random.default_rng(1).integers(0, 256, size, dtype=np.uint8)
    cpu, number, sent, refused, due = Cpu(), 0, 0, 0, time.monotonic()
    reported = False
    worker_end.answer({"ready": True})
    while not control_pipe.ended.is_set():
        due += 1 / RATE_HZ
        control_pipe.ended.wait(max(0.0, due - time.monotonic()))
        frame = writer.begin()
        if frame is not None:
            number += 1
            stamp = _fill(frame, picture, number)
            _spin(slower_us)
            writer.send()
            sent += _within(control_pipe.window, stamp)
        else:
            refused += _within(control_pipe.window, time.monotonic_ns())
        cpu.poll(control_pipe.window, time.monotonic_ns())
        if cpu.percent is not None and not reported:
            reported = True
            worker_end.answer({"cpu": cpu.percent, "sent": sent, "refused": refused, "fallbacks": writer.fallbacks})
    writer.close()


def _within(window: tuple[int, int] | None, at: int) -> bool:
    return window is not None and window[0] <= at < window[1]


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


def read(reader: Reader, control_pipe: ControlPipe, *, bare_copy: int = 0) -> None:
    """Reads until standard input closes; answers with every latency of the window in µs.

    With ``bare_copy``, measures instead the time of a copy of that many bytes between two frames, when the caches hold
    other data.
    """
    cpu, latencies, torn, frames, reported = Cpu(), [], 0, 0, False
    copier = Copier(bare_copy) if bare_copy else None
    while not control_pipe.ended.is_set():
        frame = reader.read(_READ_S)
        now = time.monotonic_ns()
        cpu.poll(control_pipe.window, now)
        if frame is not None:
            frames += 1
            stamp, number = (int.from_bytes(frame[at : at + 8].tobytes(), "little") for at in (0, 8))
            torn += number != int.from_bytes(frame[-8:].tobytes(), "little")
            reader.done()
            del frame
            if _within(control_pipe.window, stamp):
                latencies.append((now - stamp) / 1000)
                if copier is not None:
                    copier.copy(control_pipe.ended)
            if frames == _WARM_UP:
                worker_end.answer({"ready": True})
        if not reported and control_pipe.window is not None and now >= control_pipe.window[1] + _LATE_NS:
            reported = True
            answer = {"cpu": cpu.percent, "latencies_us": latencies, "torn": torn}
            if copier is not None:
                answer |= copier.answer(control_pipe.window)
            worker_end.answer(answer)
    reader.close()


class Copier:
    """Measures bare copies of as many bytes as a frame has."""

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
