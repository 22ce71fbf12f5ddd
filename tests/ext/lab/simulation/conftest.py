"""A bare board, and the clock it runs by."""

from __future__ import annotations

import pytest

from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.ports import ESP32_C6


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(1000.0)


@pytest.fixture
def board(clock: VirtualClock) -> Board:
    return Board(clock, port=ESP32_C6)
