"""Judges how Goob followed a tag by itself, by what its MCU received and where it arrived."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pebble.demo.operator import BY_ITSELF, DISTANCE_M, FOLLOW, HOLD_S, TOLERANCE_M, CompletedFollow, Wheels
from pebble.media.world.world_file import read_world
from pebble.rig.testbed import HORN, TAG_ID, RoomRobot
from pebble.simulation.loudspeaker import playbacks
from pebble.simulation.motion import Pose
from pebble.simulation.trace import Entry

BEARING_RAD = 0.09
_STARTED_S = 10.0  # interpreter, OpenCV and camera on the smallest machine
_TAKEN_OVER_S = 0.25
_RESUMED_S = 3.5
_PLAYED = 0.9  # share of the clip
_STOP: Wheels = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the table; ``wrong`` is empty if the check passed."""

    name: str
    measured: str
    wrong: str = ""


@dataclass(frozen=True, slots=True)
class FollowResult:
    robot: str
    checks: tuple[Check, ...]
    step: str = BY_ITSELF

    @property
    def wrong(self) -> tuple[str, ...]:
        return tuple(check.wrong for check in self.checks if check.wrong)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The true state at the end, known to the world and the loudspeaker."""

    distance_m: float  # between camera and tag
    bearing_rad: float  # of the tag, positive to the left
    played_s: float
    clip_s: float


def outcome(robot: RoomRobot, at: float) -> Outcome:
    """Where the tag was at that time, and what the loudspeaker has played of the clip."""
    poses = (one.board.pose for one in reversed(robot.mcu_reports) if one.ns <= at * 1e9)
    pose = next(poses, Pose(math.nan, math.nan))
    tag = next(tag for tag in read_world(robot.room).tags if tag.id == TAG_ID)
    dx, dy = tag.x - pose.x_mm / 1000, tag.y - pose.y_mm / 1000
    bearing = math.remainder(math.atan2(dy, dx) - pose.heading_rad, math.tau)
    played = [len(one.frames()) for one in playbacks(robot.played) if HORN.startswith(one.frames())]
    return Outcome(math.hypot(dx, dy), bearing, max(played, default=0) / len(HORN), 1.0)


def assess(completed: CompletedFollow, entries: Sequence[Entry], outcome: Outcome) -> FollowResult:
    """Judge by the drive lines that the MCU received, oldest first, and by the outcome."""
    drives = [(entry.ns / 1e9, entry.drive) for entry in entries if entry.drive is not None]
    checks = (
        _driven(completed, drives),
        *_taken_over(completed, drives),
        _resumed(completed, drives),
        _arrived(outcome),
        _played(completed, outcome),
    )
    return FollowResult(completed.robot, checks)


def _driven(completed: CompletedFollow, drives: Sequence[tuple[float, Wheels]]) -> Check:
    name = "the script drives"
    first = next((at for at, wheels in drives if completed.began <= at < completed.took_over and wheels != _STOP), None)
    if first is None:
        return Check(name, "never", f"{FOLLOW} did not drive before the operator took over")
    took = first - completed.began
    return Check(
        name, f"{took:.2f} s after its start", "" if took <= _STARTED_S else f"{FOLLOW} drove only after {took:.1f} s"
    )


def _taken_over(completed: CompletedFollow, drives: Sequence[tuple[float, Wheels]]) -> list[Check]:
    """How long the wheels take to obey the operator, and the script's lines until the hold ends.

    Lines count by their order: several that were read at once have the same time.
    """
    names = "the operator takes over", "script lines during the override"
    later = [(at, wheels) for at, wheels in drives if at >= completed.took_over]
    index = next((index for index, (_, wheels) in enumerate(later) if _same(wheels, completed.wheels)), None)
    if index is None:
        return [Check(names[0], "never", "no command of the operator reached the wheels"), Check(names[1], "")]
    took_s = later[index][0] - completed.took_over
    late = f"the operator's command reached the wheels only after {1000 * took_s:.0f} ms"
    override = [wheels for at, wheels in later[index:] if at < completed.released + HOLD_S - 0.1]
    passed = [wheels for wheels in override if wheels != _STOP and not _same(wheels, completed.wheels)]
    return [
        Check(names[0], f"first line after {1000 * took_s:.0f} ms", "" if took_s <= _TAKEN_OVER_S else late),
        Check(
            names[1],
            f"{len(passed)} of {len(override)}",
            f"{len(passed)} commands of the script passed during the override" if passed else "",
        ),
    ]


def _resumed(completed: CompletedFollow, drives: Sequence[tuple[float, Wheels]]) -> Check:
    name = "given back, the script drives again"
    after = completed.released + HOLD_S - 0.1
    first = next((at for at, wheels in drives if after <= at <= completed.ended and wheels != _STOP), None)
    if first is None:
        return Check(name, "never", f"{FOLLOW} did not drive again")
    took = first - completed.released
    return Check(
        name,
        f"{took:.2f} s after the operator let go",
        "" if took <= _RESUMED_S else f"{FOLLOW} drove again only after {took:.1f} s",
    )


def _arrived(outcome: Outcome) -> Check:
    wrong = []
    if not abs(outcome.distance_m - DISTANCE_M) <= TOLERANCE_M:
        wrong.append(f"{outcome.distance_m:.2f} m from the tag instead of {DISTANCE_M:.2f}")
    if not abs(outcome.bearing_rad) <= BEARING_RAD:
        wrong.append(f"the tag is {math.degrees(outcome.bearing_rad):+.1f}° to the left")
    measured = f"{outcome.distance_m:.3f} m, {math.degrees(outcome.bearing_rad):+.1f}°"
    return Check(f"in front of the tag, {DISTANCE_M:.2f} m", measured, " and ".join(wrong))


def _played(completed: CompletedFollow, outcome: Outcome) -> Check:
    wrong = f"of {completed.clip} the loudspeaker played {outcome.played_s:.2f} s instead of {outcome.clip_s:.2f}"
    return Check(
        f"{completed.clip} is played",
        f"{outcome.played_s:.2f} s of {outcome.clip_s:.2f}",
        "" if outcome.played_s >= _PLAYED * outcome.clip_s else wrong,
    )


def _same(wheels: Wheels, others: Wheels) -> bool:
    """Equal within what a drive line's three decimals can express."""
    return all(abs(one - other) < 0.0015 for one, other in zip(wheels, others, strict=True))
