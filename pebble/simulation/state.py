"""A look at a simulated robot from outside."""

from __future__ import annotations

from dataclasses import dataclass

from pebble.simulation.motion import Pose


@dataclass(frozen=True, slots=True)
class Light:
    """What the LED shows in this very moment; parts 0..1."""

    blue: float
    green: float
    red: float


DARK = Light(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class BoardState:
    """A look at the robot: wheel speeds in mm/s, ``drive`` −1..1 as commanded, ``motors`` as the pins show."""

    kind: str
    pose: Pose
    left_mm_s: float
    right_mm_s: float
    drive: tuple[float, float]
    motors: tuple[float, float]
    light: Light
    volts: float
    charging: bool
    commands: int
    last_command: str
