"""Firmware files in an import world of their own."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from pebble.extensions.lab.simulation.micropython.loader import FirmwareModules

ROBOT = """
from common.counter import up
from common import counter
import common.counter as same
import common.counter
import machine

def step():
    assert counter is same is common.counter
    return up(), machine.name
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A board's files; ``write`` more with Path.write_text."""
    for folder in ("common", "toy"):
        (tmp_path / folder).mkdir()
    (tmp_path / "common/counter.py").write_text(
        "count = 0\n\ndef up():\n    global count\n    count += 1\n    return count\n"
    )
    (tmp_path / "toy/robot.py").write_text(ROBOT)
    return tmp_path


def world(root: Path, name: str = "a") -> FirmwareModules:
    return FirmwareModules({"machine": SimpleNamespace(name=name)}, root=root)


def test_two_boards_know_nothing_of_each_other_nor_of_the_host(root: Path) -> None:
    before = set(sys.modules), list(sys.path)
    one, other = world(root, "one").module("toy.robot"), world(root, "other").module("toy.robot")
    assert [one.step(), one.step(), other.step()] == [(1, "one"), (2, "one"), (1, "other")]
    assert (set(sys.modules), list(sys.path)) == before
    assert "toy" not in sys.modules
