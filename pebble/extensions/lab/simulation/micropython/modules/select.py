"""The ``select`` module of a simulated board."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Sequence
from types import SimpleNamespace
from typing import Protocol

from pebble.extensions.lab.simulation.micropython.faults import WouldHang, failure
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLERR, POLLHUP, POLLIN, POLLOUT


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


def module() -> SimpleNamespace:
    return SimpleNamespace(poll=Poll, POLLIN=POLLIN, POLLOUT=POLLOUT, POLLERR=POLLERR, POLLHUP=POLLHUP)
