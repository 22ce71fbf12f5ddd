from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.launcher.robot import Launch, Robot, Row
from tests.support import WAIT_S


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Launch]:
    robots: list[Robot] = []

    def make(*rows: Row, options: tuple[str, ...] = (), env: dict[str, str] | None = None, **launcher: Any) -> Robot:
        robots.append(Robot(tmp_path, list(rows), *options, env=env or {}, **launcher))
        return robots[-1]

    yield make
    for robot in robots:
        robot.process.kill()  # the children notice by themselves
        robot.process.wait(WAIT_S)
        left = robot.end_leftovers()
        assert not left, f"processes that outlived their launcher: {left}"
