"""How a robot on two driven wheels moves: wheel speeds in, pose out."""

from __future__ import annotations

import math
from dataclasses import dataclass

WHEEL_DIAMETER_MM = 61.0  # Goob's geometry; Fred's is not documented
TRACK_MM = 130.5
FULL_SPEED_MM_S = 380.0  # about 120 turns a minute
_LAG_S = 0.06  # time constant of the motors
_STANDSTILL_MM_S = 0.5  # friction holds the wheels below this


@dataclass(frozen=True, slots=True)
class Pose:
    x_mm: float = 0.0
    y_mm: float = 0.0
    heading_rad: float = 0.0  # −π..π, counter-clockwise positive


class RobotMotion:
    """Two wheels that follow their commanded speeds with a lag, and where that brings the robot."""

    def __init__(self) -> None:
        self.pose = Pose()
        self.left_mm_s = self.right_mm_s = 0.0
        self.left_mm = self.right_mm = 0.0  # travelled by each wheel; backwards counts down

    def advance(self, left: float, right: float, seconds: float) -> None:
        """Drive the motors at ``left`` and ``right`` (−1..1 of full speed) for ``seconds``."""
        self.left_mm_s, left_mm = _follow(self.left_mm_s, left * FULL_SPEED_MM_S, seconds)
        self.right_mm_s, right_mm = _follow(self.right_mm_s, right * FULL_SPEED_MM_S, seconds)
        self._roll(left_mm, right_mm)

    def _roll(self, left_mm: float, right_mm: float) -> None:
        self.left_mm += left_mm
        self.right_mm += right_mm
        turn, ahead = (right_mm - left_mm) / TRACK_MM, (left_mm + right_mm) / 2
        middle = self.pose.heading_rad + turn / 2
        self.pose = Pose(
            self.pose.x_mm + ahead * math.cos(middle),
            self.pose.y_mm + ahead * math.sin(middle),
            math.remainder(self.pose.heading_rad + turn, math.tau),
        )


def _follow(speed: float, wanted: float, seconds: float) -> tuple[float, float]:
    """The speed reached and the way made by a wheel that approaches ``wanted`` exponentially."""
    left_over = (speed - wanted) * math.exp(-seconds / _LAG_S)
    way = wanted * seconds + (speed - wanted - left_over) * _LAG_S
    reached = wanted + left_over
    return (0.0 if wanted == 0.0 and abs(reached) < _STANDSTILL_MM_S else reached), way
