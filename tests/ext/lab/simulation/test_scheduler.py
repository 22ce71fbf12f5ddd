"""Turns for many boards on one thread: at once when a socket has news, and else at least as often as they ask for."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.servers import LoopbackServers
from pebble.extensions.lab.simulation.scheduler import Scheduler


class Network:
    def __init__(self) -> None:
        self.new_sockets: list[socket.socket] = []
        self.unread = False


class Board:
    """Counts its turns; reads at most ``piece`` bytes in each."""

    def __init__(self, pause_s: float, piece: int = 100) -> None:
        self.pause_s, self.piece = pause_s, piece
        self.network: Any = Network()
        self.near, self.far = socket.socketpair()
        self.near.setblocking(False)
        self.network.new_sockets.append(self.near)
        self.turns: list[float] = []
        self.read = b""

    def step(self) -> None:
        self.turns.append(time.monotonic())
        try:
            got = self.near.recv(self.piece)
        except BlockingIOError:
            return
        self.read += got
        self.network.unread = len(got) == self.piece


@pytest.fixture
def scheduler() -> Iterator[Scheduler]:
    with closing(LoopbackServers()) as servers, closing(Scheduler(servers)) as scheduler:
        yield scheduler


def run(scheduler: Scheduler, seconds: float) -> None:
    end = time.monotonic() + seconds
    scheduler.run(lambda: time.monotonic() < end)


def test_data_on_a_socket_causes_a_turn_of_that_board_only(scheduler: Scheduler) -> None:
    boards = [Board(60.0) for _ in range(3)]
    for board in boards:
        scheduler.add(board)
    run(scheduler, 0.05)
    before = [len(board.turns) for board in boards]
    sent = time.monotonic()
    boards[1].far.send(b"hello")
    run(scheduler, 0.1)
    assert boards[1].read == b"hello"
    assert boards[1].turns[-1] - sent < 0.09
    assert [len(board.turns) - count for board, count in zip(boards, before, strict=True)] == [0, 1, 0]


def test_a_board_that_does_not_read_does_not_keep_the_others_waiting(scheduler: Scheduler) -> None:
    deaf, other = Board(0.05), Board(0.01)
    deaf.step = lambda: deaf.turns.append(0.0)  # type: ignore[method-assign]
    deaf.far.send(b"unheard")
    scheduler.add(deaf)
    scheduler.add(other)
    run(scheduler, 0.3)
    assert len(deaf.turns) <= 8
    assert len(other.turns) >= 15


def test_a_socket_number_that_is_used_again_belongs_to_its_new_board(scheduler: Scheduler) -> None:
    first, second = Board(60.0), Board(60.0)
    scheduler.add(first)
    run(scheduler, 0.02)
    number = first.near.fileno()
    first.near.close()
    second.near.close()
    second.near, second.far = socket.socketpair()
    assert second.near.fileno() == number
    second.near.setblocking(False)
    second.network.new_sockets[:] = [second.near]
    scheduler.add(second)
    run(scheduler, 0.02)
    second.far.send(b"for the second")
    run(scheduler, 0.05)
    assert second.read == b"for the second"
