"""Judges each step that the demo has driven by what the MCU measured, not by telemetry. Pure."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from pebble.demo.operator import CompletedStep, wheels_of
from pebble.simulation.mcu import Snapshot
from pebble.simulation.motion import FULL_SPEED_MM_S, TRACK_MM
from pebble.simulation.trace import Entry

REACTION_S = 1.0  # from the first command until the wheels turn
_TURNING_MM_S = 20.0
_ENOUGH = 0.4  # of the ideal distance: motors lag, Fred's are trimmed


@dataclass(frozen=True, slots=True)
class StepResult:
    """One step of one robot: what was measured, and its defects (empty: none)."""

    completed: CompletedStep
    reaction_s: float
    stop_s: float
    ahead_mm: float
    turned_rad: float
    wrong: tuple[str, ...]

    @property
    def robot(self) -> str:
        return self.completed.robot

    @property
    def step(self) -> str:
        return self.completed.step.name

    @property
    def summary(self) -> str:
        """Distance, and time until the stop."""
        if self.completed.step.drive.z:
            return f"{self.ahead_mm:+.0f} mm, {self.stop_s * 1000:.0f} ms"
        return f"{math.degrees(-self.turned_rad):+.0f}° right, {self.stop_s * 1000:.0f} ms"


def assess(
    completed: CompletedStep, reports: Iterable[Snapshot], entries: Iterable[Entry], *, stop_s: float, has_lights: bool
) -> StepResult:
    """Compare a completed step with the MCU's reports and with the trace of its lines and motors.

    ``stop_s``: how long the motors may run after the operator's last command.
    """
    reports = [report for report in reports if completed.began <= report.ns / 1e9 <= completed.ended]
    traced = [entry for entry in entries if completed.began <= entry.ns / 1e9 <= completed.ended]
    reaction, stop = _reaction(completed, reports), _stop(completed, traced)
    ahead, turned = _way(reports)
    wrong = [
        *_too_late("the wheels turned", reaction, REACTION_S),
        *_too_late("the motors stopped", stop, stop_s),
        *_too_short("ahead", ahead, completed.step.drive.z * FULL_SPEED_MM_S * completed.step.drive_s, "mm"),
        *_too_short(
            "to the left",
            turned,
            -completed.step.drive.x * 2 * FULL_SPEED_MM_S / TRACK_MM * completed.step.drive_s,
            "rad",
        ),
        *_still_rolling(reports),
        *(_dark(traced) if has_lights else ()),
    ]
    return StepResult(completed, reaction, stop, ahead, turned, tuple(wrong))


def _reaction(completed: CompletedStep, reports: Sequence[Snapshot]) -> float:
    """Seconds until both wheels turned as commanded; infinite for never."""
    wanted = wheels_of(completed.step.drive)
    for report in reports:
        speeds = (report.board.left_mm_s, report.board.right_mm_s)
        if all(speed * math.copysign(1, want) > _TURNING_MM_S for speed, want in zip(speeds, wanted, strict=True)):
            return report.ns / 1e9 - completed.began
    return math.inf


def _stop(completed: CompletedStep, traced: Sequence[Entry]) -> float:
    """Seconds from the operator's last command until the motors stayed off; infinite if they never did."""
    motors = [(entry.ns / 1e9, entry.motors) for entry in traced if entry.motors is not None]
    running = [index for index, (_, speeds) in enumerate(motors) if speeds != (0.0, 0.0)]
    after = motors[running[-1] + 1 :] if running else []
    return max(0.0, after[0][0] - completed.released) if after else math.inf


def _way(reports: Sequence[Snapshot]) -> tuple[float, float]:
    """Millimetres ahead in the direction at the start, and radians to the left, summed over full turns."""
    if not reports:
        return 0.0, 0.0
    first, last = reports[0].board.pose, reports[-1].board.pose
    dx, dy = last.x_mm - first.x_mm, last.y_mm - first.y_mm
    ahead = dx * math.cos(first.heading_rad) + dy * math.sin(first.heading_rad)
    headings = [report.board.pose.heading_rad for report in reports]
    turned = sum(math.remainder(after - before, math.tau) for before, after in pairwise(headings))
    return ahead, turned


def _too_late(what: str, took_s: float, limit_s: float) -> list[str]:
    if took_s <= limit_s:
        return []
    return [f"{what} only after {took_s:.2f} s" if math.isfinite(took_s) else f"never seen: {what}"]


def _too_short(what: str, measured: float, ideal: float, unit: str) -> list[str]:
    if ideal == 0.0 or measured * math.copysign(1, ideal) >= _ENOUGH * abs(ideal):
        return []
    return [f"{measured:.2f} {unit} {what} instead of about {ideal:.2f}"]


def _still_rolling(reports: Sequence[Snapshot]) -> list[str]:
    if reports and reports[-1].board.left_mm_s == reports[-1].board.right_mm_s == 0.0:
        return []
    return ["the wheels still turned at the end"]


def _dark(traced: Sequence[Entry]) -> list[str]:
    return [] if any(entry.line[:2] in ("L ", "F ") for entry in traced) else ["no light was switched"]
