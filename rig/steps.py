"""The steps that the scripted operator drives."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from pebble.contract.payloads import Drive, LightsFlash, LightsSolid

COMMAND_PERIOD_S = 0.05  # how often a held stick is repeated


@dataclass(frozen=True, slots=True)
class Step:
    """Repeat ``drive`` for ``drive_s``, then send a stop or simply nothing more, and observe for ``rest_s``."""

    name: str
    drive: Drive
    drive_s: float
    sends_stop: bool
    rest_s: float
    lights: LightsSolid | LightsFlash


@dataclass(frozen=True, slots=True)
class CompletedStep:
    """A step that was sent to one robot. Times are time.monotonic() of the operator."""

    robot: str  # its id
    step: Step
    began: float
    released: float  # the last moving command, or the stop command if the step sends one
    ended: float


SCRIPT = (
    Step("forward, stop", Drive(z=0.6), 1.2, True, 1.4, LightsSolid(g=1.0)),
    Step("turn right, stop", Drive(x=0.35), 0.8, True, 1.4, LightsFlash(b=1.0, period=0.5)),
    Step("forward, let go", Drive(z=0.6), 0.8, False, 1.4, LightsSolid(r=1.0)),
    Step("back, stop", Drive(z=-0.5), 0.8, True, 1.4, LightsSolid(b=0.3, g=0.3, r=0.3)),
)
ROUND_S = sum(step.drive_s + step.rest_s for step in SCRIPT)


def repeat(send: Callable[[], None], wait: Callable[[float], bool], seconds: float) -> bool:
    """Send a drive command again and again, as a held stick does; True if ``wait(seconds)`` says that the demo ends."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        send()
        if wait(COMMAND_PERIOD_S):
            return True
    return False
