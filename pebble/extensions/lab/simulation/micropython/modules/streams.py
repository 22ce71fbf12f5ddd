"""MicroPython's streams, which read and write without blocking, and the module ``select`` that polls them."""

import errno
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from types import SimpleNamespace
from typing import Any, Protocol

from pebble.extensions.lab.simulation.micropython.faults import WouldHang, failure

POLLIN, POLLOUT, POLLERR, POLLHUP = 1, 4, 8, 16


class Pollable(Protocol):
    def ready(self, mask: int) -> int:
        """Return the present events in ``mask``; POLLERR and POLLHUP are always included."""


class Poll:
    """``select.poll()``: polls the objects themselves, without waiting."""

    def __init__(self) -> None:
        self._watched: dict[int, tuple[Pollable, int]] = {}

    def register(self, thing: Pollable, mask: int = POLLIN | POLLOUT) -> None:
        if not hasattr(thing, "ready"):
            raise failure(errno.EINVAL)
        self._watched[id(thing)] = thing, mask

    def poll(self, timeout: int = -1) -> Sequence[tuple[Pollable, int]]:
        """Return the objects that are ready, with their events."""
        return list(self.ipoll(timeout))

    def ipoll(self, timeout: int = -1) -> Iterable[tuple[Pollable, int]]:
        """Poll; on a real board this allocates no list."""
        if timeout != 0:
            raise WouldHang("the firmware polls with a timeout, meanwhile its motors have no deadline")
        for thing, mask in self._watched.values():
            if events := thing.ready(mask):
                yield thing, events


def select_module() -> SimpleNamespace:
    return SimpleNamespace(poll=Poll, POLLIN=POLLIN, POLLOUT=POLLOUT, POLLERR=POLLERR, POLLHUP=POLLHUP)


class Stream(ABC):
    """MicroPython's stream methods. Subclasses supply ``_receive`` and ``_send``, which transfer data once."""

    @abstractmethod
    def _receive(self, size: int) -> bytes | None:
        """Return at most ``size`` bytes; None if there are none now, b"" if the peer has closed. Raises OSError."""

    @abstractmethod
    def _send(self, data: bytes) -> int | None:
        """Return how many bytes were sent; None if none can be sent now. Raises OSError."""

    def read(self, size: int) -> bytes | None:
        """Return the available bytes, at most ``size``; None if there are none, b"" at the end."""
        data = b""
        while len(data) < size:
            chunk = self._receive(size - len(data))
            if not chunk:
                return data or chunk
            data += chunk
        return data

    def readinto(self, buffer: Any) -> int | None:
        view = memoryview(buffer).cast("B")
        chunk = self.read(len(view))
        if chunk is None:
            return None
        view[: len(chunk)] = chunk
        return len(chunk)

    def write(self, data: Any) -> int | None:
        """Return how many bytes were sent; None if none."""
        view, done = memoryview(data).cast("B"), 0
        while done < len(view):
            sent = self._send(bytes(view[done:]))
            if sent is None:
                return done or None
            done += sent
        return done
