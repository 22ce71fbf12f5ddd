"""Runs a robot's firmware on its simulated board, as common/run.py does on a real one."""

import logging
from typing import Any

from pebble.extensions.lab.simulation.micropython.board import Board, FirmwareRobot
from pebble.extensions.lab.simulation.micropython.timers import BoardReset

log = logging.getLogger(__name__)


class Runner:
    """A board that runs its firmware; ``step`` is one turn of the loop.

    A reset or an error in the firmware reboots the board, and is counted.
    """

    def __init__(self, board: Board, robot: str, settings: dict[str, Any] | None = None) -> None:
        self.board, self.name, self.settings = board, robot, settings or {}
        self.robot: FirmwareRobot = self.boot()

    def boot(self) -> FirmwareRobot:
        """Power on, or press the reset button."""
        self.robot = self.board.load(self.name, self.settings)
        return self.robot

    def step(self) -> None:
        try:
            self.robot.step()
        except BoardReset as reason:
            log.info("the simulated %s resets: %s", self.name, reason)
            self._reboot()
        except Exception:  # as on a board: on any error, stop and reboot; the traceback names the firmware's line
            log.exception("the firmware of the simulated %s failed", self.name)
            self.robot.stop()
            self._reboot()

    def _reboot(self) -> None:
        self.board.resets += 1
        self.boot()
