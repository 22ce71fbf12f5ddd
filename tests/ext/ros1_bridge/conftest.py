"""The partners of the bridge: scripted ones always, and Debian's rosmaster and rospy in `make long PART=ros1`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ext.ros1_bridge.world import DEBIAN, NEEDED, Husky, World

DEBIAN_ONLY = [
    pytest.mark.skipif(not os.environ.get("PEBBLE_THOROUGH"), reason="make long PART=ros1"),
    pytest.mark.skipif(not DEBIAN, reason=f"/usr/bin/python3 cannot import {NEEDED}"),
]


@pytest.fixture(params=["scripted", pytest.param("debian", marks=DEBIAN_ONLY)])
def ros(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[World]:
    """A master and a base."""
    world = World(tmp_path, request.param)
    world.start_master()
    world.start_base()
    yield world
    world.close()


@pytest.fixture
def husky(ros: World, tmp_path: Path) -> Iterator[Husky]:
    """A robot whose bridge is connected to the base."""
    husky = Husky(ros, tmp_path).ready()
    yield husky
    husky.end()
