"""Did a robot do what it was told? Judged by what its MCU saw, never by what the robot says. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from pebble.demo.script import Done
from pebble.simulation.mcu import Look
from pebble.simulation.motion import FULL_SPEED_MM_S, TRACK_MM
from pebble.simulation.trace import Entry

REACTION_S = 1.0  # from the first command until the wheels turn
_TURNING_MM_S = 20.0
_ENOUGH = 0.4  # of the ideal way: motors lag, Fred's are trimmed


@dataclass(frozen=True, slots=True)
class Verdict:
    """One step of one robot: what was measured, and what was wrong with it (empty: nothing)."""

    done: Done
    reaction_s: float
    stop_s: float
    ahead_mm: float
    turned_rad: float
    wrong: tuple[str, ...]

    @property
    def robot(self) -> str:
        return self.done.robot

    @property
    def step(self) -> str:
        return self.done.step.name


def judge(done: Done, looks: Iterable[Look], entries: Iterable[Entry], *, stop_s: float, has_lights: bool) -> Verdict:
    """Compare a finished step with its MCU's reports, with what reached it and with what its motors did.

    ``stop_s``: how long after the operator's last act the motors may run.
    """
    seen = [look for look in looks if done.began <= look.ns / 1e9 <= done.ended]
    traced = [entry for entry in entries if done.began <= entry.ns / 1e9 <= done.ended]
    reaction, stop = _reaction(done, seen), _stop(done, traced)
    ahead, turned = _way(seen)
    wrong = [
        *_too_late("the wheels turned", reaction, REACTION_S),
        *_too_late("the motors stopped", stop, stop_s),
        *_too_short("ahead", ahead, done.step.drive.z * FULL_SPEED_MM_S * done.step.drive_s, "mm"),
        *_too_short(
            "to the left", turned, -done.step.drive.x * 2 * FULL_SPEED_MM_S / TRACK_MM * done.step.drive_s, "rad"
        ),
        *_still_rolling(seen),
        *(_dark(traced) if has_lights else ()),
    ]
    return Verdict(done, reaction, stop, ahead, turned, tuple(wrong))


def _reaction(done: Done, seen: Sequence[Look]) -> float:
    """Seconds until both wheels turned the way they were told; infinite for never."""
    wanted = (done.step.drive.z + done.step.drive.x, done.step.drive.z - done.step.drive.x)
    for look in seen:
        speeds = (look.board.left_mm_s, look.board.right_mm_s)
        if all(speed * math.copysign(1, want) > _TURNING_MM_S for speed, want in zip(speeds, wanted, strict=True)):
            return look.ns / 1e9 - done.began
    return math.inf


def _stop(done: Done, traced: Sequence[Entry]) -> float:
    """Seconds from the operator's last act until the motors were off for good; infinite if they never were."""
    motors = [(entry.ns / 1e9, entry.motors) for entry in traced if entry.motors is not None]
    running = [index for index, (_, speeds) in enumerate(motors) if speeds != (0.0, 0.0)]
    after = motors[running[-1] + 1 :] if running else []
    return max(0.0, after[0][0] - done.released) if after else math.inf


def _way(seen: Sequence[Look]) -> tuple[float, float]:
    """Millimetres ahead, seen in the direction at the start, and radians to the left, summed over full turns."""
    if not seen:
        return 0.0, 0.0
    first, last = seen[0].board.pose, seen[-1].board.pose
    dx, dy = last.x_mm - first.x_mm, last.y_mm - first.y_mm
    ahead = dx * math.cos(first.heading_rad) + dy * math.sin(first.heading_rad)
    headings = [look.board.pose.heading_rad for look in seen]
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


def _still_rolling(seen: Sequence[Look]) -> list[str]:
    if seen and seen[-1].board.left_mm_s == seen[-1].board.right_mm_s == 0.0:
        return []
    return ["the wheels still turned at the end"]


def _dark(traced: Sequence[Entry]) -> list[str]:
    return [] if any(entry.line[:2] in ("L ", "F ") for entry in traced) else ["no light was switched"]
