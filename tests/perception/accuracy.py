"""How exact odometry is, in lockstep with the real firmware: ``python -m tests.perception.accuracy`` prints all."""

from __future__ import annotations

import math
import random
import sys

from pebble.perception.odometry import WheelGeometry
from pebble.simulation.motion import FULL_SPEED_MM_S, TRACK_MM
from tests.perception.wheels_rig import WheelsRig

POWERS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
ONE_SENSOR = WheelGeometry(quadrature="")


def straight(
    power: float, *, geometry: WheelGeometry | None = None, noise: float = 0.0, start: int = 0
) -> tuple[float, float]:
    """2 m: the errors of distance in mm and of the pose in mm. ``start`` is where the wheels stand at first."""
    rig = WheelsRig(geometry=geometry, noise=noise, start_mm=(start * 5.3, start * 3.7))
    rig.wait(0.5)
    rig.drive(2000 / FULL_SPEED_MM_S / abs(power), z=power)
    rig.stop()
    distance = rig.odometry.distance_mm - math.hypot(rig.motion.pose.x_mm, rig.motion.pose.y_mm)
    return distance, rig.error_mm()


def square(
    side: int, *, gyro: bool, power: float = 0.5, turn: float = 0.3, geometry: WheelGeometry | None = None
) -> WheelsRig:
    """Four sides of 1 m; ``side`` 1 turns to the left, −1 to the right."""
    rig = WheelsRig(gyro=gyro, geometry=geometry)
    rig.wait(2.0)
    for _ in range(4):
        rig.drive(1000 / FULL_SPEED_MM_S / power, z=power)
        rig.stop()
        rig.drive(math.pi / 4 * TRACK_MM / FULL_SPEED_MM_S / turn, x=-side * turn)
        rig.stop()
    return rig


def wander(seed: int, *, noise: float = 0.0, geometry: WheelGeometry | None = None) -> tuple[float, float]:
    """Twenty random commands, each straight after the other: the errors of the left and the right wheel in mm."""
    rig = WheelsRig(noise=noise, geometry=geometry, start_mm=(seed * 5.3, seed * 3.7))
    chosen = random.Random(seed)
    rig.wait(0.5)
    for _ in range(20):
        rig.drive(chosen.uniform(0.2, 2.0), x=chosen.uniform(-1, 1), z=chosen.uniform(-1, 1))
    rig.stop()
    return rig.wheel_errors_mm()


def worst(power: float, *, geometry: WheelGeometry | None = None, noise: float = 0.0) -> str:
    """The errors of ten positions of the wheels at the start, forward and in reverse."""
    errors = [
        straight(way * power, geometry=geometry, noise=noise, start=start) for start in range(10) for way in (1, -1)
    ]
    distance, pose = (max(abs(error[index]) for error in errors) for index in (0, 1))
    return f"{distance:6.2f} {pose:6.2f}"


def _print(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")


def main() -> None:
    _print("2 m straight, worst of 20, mm: distance and pose; the same with one sensor per wheel; with 1 % noise")
    for power in POWERS:
        _print(f"{power:4.1f}  ", worst(power), "  ", worst(power, geometry=ONE_SENSOR), "  ", worst(power, noise=3.0))
    for side in (1, -1):
        for gyro in (False, True):
            for geometry in (None, ONE_SENSOR):
                rig = square(side, gyro=gyro, geometry=geometry)
                sensors = "one sensor" if geometry else "quadrature"
                way, source = ("left" if side > 0 else "right"), rig.odometry.value().get("heading_source", "wheels")
                _print(f"square {way:5} {sensors} {source:6}: {rig.error_mm():6.1f} mm {rig.error_deg():5.2f} degrees")
    for noise in (0.0, 3.0, 8.0):
        errors = [wander(seed, noise=noise) for seed in range(20)]
        left, right = (max(abs(error[wheel]) for error in errors) for wheel in (0, 1))
        _print(f"20 random commands, 20 seeds, noise {noise:g}: worst {left:.1f} mm (quadrature) {right:.1f} mm (one)")


if __name__ == "__main__":
    main()
