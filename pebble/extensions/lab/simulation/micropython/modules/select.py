"""The ``select`` module of a simulated board."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Protocol

from pebble.extensions.lab.simulation.micropython.faults import WouldHang, failure
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLERR, POLLHUP, POLLIN, POLLOUT

if TYPE_CHECKING:
    from pebble.extensions.lab.simulation.micropython.hardware import Hardware

_GRAIN_S = 0.001


class Pollable(Protocol):
    def ready(self, mask: int) -> int:
        """Return the present events in ``mask``; POLLERR and POLLHUP are always included."""


class Poll:
    """``select.poll()``: polls the objects themselves. Waiting advances the board's clock."""

    def __init__(self, board: Hardware) -> None:
        self._board = board
        self._watched: dict[int, tuple[Pollable, int]] = {}

    def register(self, thing: Pollable, mask: int = POLLIN | POLLOUT) -> bool:
        """Watch ``thing``; returns True if it was not watched before."""
        if not hasattr(thing, "ready"):
            raise failure(errno.EINVAL)
        new = id(thing) not in self._watched
        self._watched[id(thing)] = thing, mask
        return new

    def unregister(self, thing: Pollable) -> None:
        self._watched.pop(id(thing), None)

    def modify(self, thing: Pollable, mask: int) -> None:
        if id(thing) not in self._watched:
            raise failure(errno.ENOENT)
        self._watched[id(thing)] = thing, mask

    def poll(self, timeout: int = -1) -> Sequence[tuple[Pollable, int]]:
        """Return what is ready; waits up to ``timeout`` ms, for ever if it is negative."""
        ready = self._ready()
        if ready or timeout == 0:
            return ready
        if timeout < 0:
            raise WouldHang("the firmware polls without a timeout")
        until = self._board.clock.now() + timeout / 1000
        while not ready and (left := until - self._board.clock.now()) > 0:
            self._board.pause(min(_GRAIN_S, left))
            ready = self._ready()
        return ready

    def ipoll(self, timeout: int = -1, _flags: int = 0) -> Iterable[tuple[Pollable, int]]:
        """``poll`` that allocates no list on a real board."""
        if timeout != 0:
            return self.poll(timeout)
        for thing, mask in self._watched.values():  # fast path: firmware polls one object before every byte
            if events := thing.ready(mask):
                return ((thing, events),) if len(self._watched) == 1 else self._ready()
        return ()

    def _ready(self) -> Sequence[tuple[Pollable, int]]:
        found = []
        for thing, mask in self._watched.values():
            events = thing.ready(mask)
            if events:
                found.append((thing, events))
        return found


def module(board: Hardware) -> SimpleNamespace:
    return SimpleNamespace(poll=lambda: Poll(board), POLLIN=POLLIN, POLLOUT=POLLOUT, POLLERR=POLLERR, POLLHUP=POLLHUP)
