"""Wakes a thread that waits for new work, or for descriptors."""

import socket
import threading
import time
from contextlib import suppress


class Wakeup:
    """An event that resets itself: any thread or signal handler sets it, one thread waits. A set before a wait counts.

    It is a bare lock that is free while the event is set. A Condition takes ten times as long, and a signal handler
    that notifies it may interrupt its own thread inside. ``queue.SimpleQueue.get`` with a timeout of some µs can wait
    for ever (Python 3.11): the time that remains may become negative, which its lock takes for no timeout.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def set(self) -> None:
        """Wake the waiting thread, now or in its next wait."""
        try:
            self._lock.release()
        except RuntimeError:  # set already
            return

    def wait(self, end: float | None) -> bool:
        """Wait until the event is set, or until ``end`` (monotonic seconds); reset it; return whether it was set."""
        return self._lock.acquire(timeout=-1 if end is None else max(0.0, end - time.monotonic()))


class WakeupPipe:
    """A descriptor that one thread polls beside its devices. Other threads and signals set it, also before the poll."""

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)

    def fileno(self) -> int:
        return self._reader.fileno()

    @property
    def set_fileno(self) -> int:
        """Descriptor that sets the pipe when a byte is written to it, for ``signal.set_wakeup_fd``."""
        return self._writer.fileno()

    def set(self) -> None:
        with suppress(OSError):  # full: it wakes up anyway; or closed
            self._writer.send(b"!")

    def clear(self) -> None:
        with suppress(BlockingIOError):
            self._reader.recv(65_536)

    def close(self) -> None:
        self._reader.close()
        self._writer.close()
