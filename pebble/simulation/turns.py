"""One thread gives many simulated boards their turns: at once when a socket has news, and else often enough."""

from __future__ import annotations

import heapq
import select
import socket
import time
from collections.abc import Callable
from typing import Protocol

from pebble.simulation.micropython.servers import LoopbackServers
from pebble.simulation.micropython.sockets import HostNetwork

_EVENTS = select.EPOLLIN | select.EPOLLOUT | select.EPOLLET
_GRAIN_S = 0.0005  # boards that are due within this time have their turn now
_LONGEST_S = 0.05
_AT_ONCE = 16  # boards that were only due; then news of the others come first again


class Turning(Protocol):
    """A board with real sockets. ``pause_s`` is the longest time to its next turn."""

    network: HostNetwork

    @property
    def pause_s(self) -> float: ...

    def step(self) -> None: ...


class Turns:
    """``add`` boards, then ``run``. Late turns are not made up for. Only the thread that runs may add.

    ``count`` is how many turns there were.
    """

    def __init__(self, servers: LoopbackServers) -> None:
        self.count = 0
        self._servers = servers
        self._epoll = select.epoll()
        self._boards: list[Turning] = []
        self._due: list[tuple[float, int]] = []  # a heap of times and boards; an entry that is not in _next is void
        self._next: list[float] = []
        self._of: dict[int, int] = {}  # file descriptor to board
        self._servers_of = {sock.fileno(): sock for sock in servers.sockets}
        for sock in servers.sockets:
            self._epoll.register(sock, select.EPOLLIN)

    def add(self, board: Turning) -> None:
        """Its first turn comes at once."""
        self._boards.append(board)
        self._next.append(0.0)
        self._plan(len(self._boards) - 1, time.monotonic())

    def run(self, going_on: Callable[[], bool]) -> None:
        """Until ``going_on`` says no; it is asked at least every 50 ms."""
        while going_on():
            self.turn()

    def turn(self) -> None:
        """Wait for news or for the next board that is due, and step what needs it."""
        for index in self._news():
            self._step(index)
        now = time.monotonic()
        left = _AT_ONCE
        while left and self._due and self._due[0][0] <= now + _GRAIN_S:
            due, index = heapq.heappop(self._due)
            if due == self._next[index]:
                left -= 1
                self._step(index)

    def close(self) -> None:
        self._epoll.close()

    def _news(self) -> list[int]:
        """The boards whose sockets have some."""
        now = time.monotonic()
        wait = min(_LONGEST_S, max(0.0, self._due[0][0] - now)) if self._due else _LONGEST_S
        boards: dict[int, None] = {}
        for descriptor, _ in self._epoll.poll(wait):
            if descriptor in self._servers_of:
                self._servers.serve(self._servers_of[descriptor])
            elif descriptor in self._of:
                boards[self._of[descriptor]] = None
        return list(boards)

    def _step(self, index: int) -> None:
        board = self._boards[index]
        self.count += 1
        board.network.unread = False
        board.step()
        if board.network.fresh:
            self._watch(board.network.fresh, index)
        now = time.monotonic()
        self._plan(index, now if board.network.unread else now + board.pause_s)

    def _watch(self, fresh: list[socket.socket], index: int) -> None:
        """Descriptors leave epoll by being closed; numbers are used again."""
        for sock in fresh:
            if sock.fileno() >= 0:
                self._of[sock.fileno()] = index
                self._epoll.register(sock, _EVENTS)
        fresh.clear()

    def _plan(self, index: int, due: float) -> None:
        self._next[index] = due
        heapq.heappush(self._due, (due, index))
