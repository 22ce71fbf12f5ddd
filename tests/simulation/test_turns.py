"""Turns for many boards on one thread: at once when a socket has news, and else at least as often as they ask for."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

from pebble.simulation.micropython.servers import LoopbackServers
from pebble.simulation.turns import Turns


class Network:
    def __init__(self) -> None:
        self.fresh: list[socket.socket] = []
        self.unread = False


class Board:
    """Counts its turns; reads at most ``piece`` bytes in each."""

    def __init__(self, pause_s: float, piece: int = 100) -> None:
        self.pause_s, self.piece = pause_s, piece
        self.network: Any = Network()
        self.near, self.far = socket.socketpair()
        self.near.setblocking(False)
        self.network.fresh.append(self.near)
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
def turns() -> Iterator[Turns]:
    with closing(LoopbackServers()) as servers, closing(Turns(servers)) as turns:
        yield turns


def run(turns: Turns, seconds: float) -> None:
    end = time.monotonic() + seconds
    turns.run(lambda: time.monotonic() < end)


def test_each_board_has_its_own_pace(turns: Turns) -> None:
    fast, slow = Board(0.01), Board(0.1)
    turns.add(fast)
    turns.add(slow)
    run(turns, 0.5)
    assert 15 <= len(fast.turns) <= 53
    assert 3 <= len(slow.turns) <= 8


def test_news_mean_a_turn_at_once_for_that_board_only(turns: Turns) -> None:
    boards = [Board(60.0) for _ in range(3)]
    for board in boards:
        turns.add(board)
    run(turns, 0.05)
    before = [len(board.turns) for board in boards]
    sent = time.monotonic()
    boards[1].far.send(b"hello")
    run(turns, 0.1)
    assert boards[1].read == b"hello"
    assert boards[1].turns[-1] - sent < 0.09
    assert [len(board.turns) - count for board, count in zip(boards, before, strict=True)] == [0, 1, 0]


def test_what_is_left_unread_means_another_turn_at_once(turns: Turns) -> None:
    board = Board(60.0, piece=10)
    turns.add(board)
    run(turns, 0.02)
    board.far.send(bytes(95))
    run(turns, 0.1)
    assert len(board.read) == 95


def test_a_board_that_does_not_read_does_not_keep_the_others_waiting(turns: Turns) -> None:
    deaf, other = Board(0.05), Board(0.01)
    deaf.step = lambda: deaf.turns.append(0.0)  # type: ignore[method-assign]
    deaf.far.send(b"unheard")
    turns.add(deaf)
    turns.add(other)
    run(turns, 0.3)
    assert len(deaf.turns) <= 8
    assert len(other.turns) >= 15


def test_a_socket_number_that_is_used_again_belongs_to_its_new_board(turns: Turns) -> None:
    first, second = Board(60.0), Board(60.0)
    turns.add(first)
    run(turns, 0.02)
    number = first.near.fileno()
    first.near.close()
    second.near.close()
    second.near, second.far = socket.socketpair()
    assert second.near.fileno() == number
    second.near.setblocking(False)
    second.network.fresh[:] = [second.near]
    turns.add(second)
    run(turns, 0.02)
    second.far.send(b"for the second")
    run(turns, 0.05)
    assert second.read == b"for the second"
