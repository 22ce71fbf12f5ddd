"""Soundboards of robots on either transport."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.ext.soundboard.soundboard_rig import Soundboard
from tests.support import Broker

Make = Callable[..., Soundboard]


@pytest.fixture
def make(local: Broker) -> Iterator[Make]:
    """Makes one with these options; with ``clip``, that tone is there and the service runs."""
    with ExitStack() as ends:

        def made(kind: str = "mqtt", *, clip: float = 0.0, **options: Any) -> Soundboard:
            board = ends.enter_context(Soundboard(kind, local.port, **options))
            return board.with_clip("a.wav", clip) if clip else board

        yield made


@pytest.fixture(params=["mqtt", "zenoh"])
def both(request: pytest.FixtureRequest, make: Make) -> Soundboard:
    return make(request.param)


@pytest.fixture
def board(make: Make) -> Soundboard:
    return make()
