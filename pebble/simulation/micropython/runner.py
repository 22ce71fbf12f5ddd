"""Keep a robot's firmware running on its board, as common/run.py does on a real one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from pebble.simulation.micropython.board import Board, Robot
from pebble.simulation.micropython.watchdog import BoardReset

log = logging.getLogger(__name__)


class Runner:
    """``step`` is one turn of the loop. A reset or an error in the firmware boots it anew, and is counted.

    ``on_boot`` gets the new robot each time.
    """

    def __init__(
        self,
        board: Board,
        robot: str,
        settings: dict[str, Any] | None = None,
        *,
        on_boot: Callable[[Robot], None] = lambda _robot: None,
    ) -> None:
        self.board, self.name, self.settings, self._on_boot = board, robot, settings or {}, on_boot
        self.robot: Robot = self.boot()

    def boot(self) -> Robot:
        """Power on, or press the button."""
        self.robot = self.board.load(self.name, self.settings)
        self._on_boot(self.robot)
        return self.robot

    def step(self) -> None:
        try:
            self.robot.step()
        except BoardReset as reason:
            log.info("the simulated %s resets: %s", self.name, reason)
            self._again()
        except Exception:  # as on a board: whatever it is, stop and start anew; the traceback names the firmware's line
            log.exception("the firmware of the simulated %s failed", self.name)
            self.robot.stop()
            self._again()

    def _again(self) -> None:
        self.board.resets += 1
        self.boot()
