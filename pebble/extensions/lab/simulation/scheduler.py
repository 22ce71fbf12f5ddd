"""Runs many simulated boards on one thread: at once when a socket is ready, otherwise periodically."""

import heapq
import select
import socket
import time
from collections.abc import Callable
from typing import Protocol

from pebble.extensions.lab.simulation.micropython.modules.sockets import HostNetwork
from pebble.extensions.lab.simulation.micropython.servers import LoopbackServers

_EVENTS = select.EPOLLIN | select.EPOLLOUT | select.EPOLLET
_GRAIN_S = 0.0005  # boards that are due within this time run now
_LONGEST_S = 0.05
_AT_ONCE = 16  # boards that are due; then ready sockets have priority again


class ScheduledBoard(Protocol):
    """A board with real sockets. ``pause_s`` is the longest time until its next turn."""

    network: HostNetwork

    @property
    def pause_s(self) -> float: ...

    def step(self) -> None: ...


class Scheduler:
    """Runs the boards that were added. Missed turns are skipped. Only the thread that runs may add boards.

    ``count`` is the number of turns so far.
    """

    def __init__(self, servers: LoopbackServers) -> None:
        self.count = 0
        self._servers = servers
        self._epoll = select.epoll()
        self._boards: list[ScheduledBoard] = []
        self._due: list[tuple[float, int]] = []  # a heap of times and boards; an entry that is not in _next is void
        self._next: list[float] = []
        self._of: dict[int, int] = {}  # file descriptor to board
        self._servers_of = {sock.fileno(): sock for sock in servers.sockets}
        for sock in servers.sockets:
            self._epoll.register(sock, select.EPOLLIN)

    def add(self, board: ScheduledBoard) -> None:
        """Add a board; its first turn is immediate."""
        self._boards.append(board)
        self._next.append(0.0)
        self._schedule(len(self._boards) - 1, time.monotonic())

    def run(self, keep_running: Callable[[], bool]) -> None:
        """Run while ``keep_running`` returns True; it is called at least every 50 ms."""
        while keep_running():
            self.run_once()

    def run_once(self) -> None:
        """Wait for a ready socket or for the next board that is due, and step those boards."""
        for index in self._ready_boards():
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

    def _ready_boards(self) -> list[int]:
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
        if board.network.new_sockets:
            self._watch(board.network.new_sockets, index)
        now = time.monotonic()
        self._schedule(index, now if board.network.unread else now + board.pause_s)

    def _watch(self, new_sockets: list[socket.socket], index: int) -> None:
        """Watch new sockets. Closing a descriptor removes it from epoll; its number may be reused."""
        for sock in new_sockets:
            if sock.fileno() >= 0:
                self._of[sock.fileno()] = index
                self._epoll.register(sock, _EVENTS)
        new_sockets.clear()

    def _schedule(self, index: int, due: float) -> None:
        self._next[index] = due
        heapq.heappush(self._due, (due, index))
