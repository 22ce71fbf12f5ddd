"""Fits two wheels to straight runs and spins by least squares: millimetres per step of each, and the track."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_SLIP = 0.003  # of the way of a wheel in one run, rms
_ITERATIONS = 8  # the fit is almost linear
LIMIT_SIGMA = 3.0  # a run with a larger residual is repeated


class Run(NamedTuple):
    """A run: the counted steps of both wheels (reverse negative), and the robot's true movement."""

    name: str
    left: float
    right: float
    turn_rad: float  # counter-clockwise
    mm: float | None = None  # along the arc, reverse negative; None: a spin


class Noise(NamedTuple):
    """The rms errors with which the true movement is measured."""

    mm: float
    straight_rad: float
    spin_rad: float


#: What the error of each truth is: of a tape and marks on the floor, of a tag in the camera, of a tape and a gyroscope.
NOISE = {
    "tape": Noise(3.0, math.radians(1.0), math.radians(2.0)),
    "tag": Noise(8.0, math.radians(0.5), math.radians(0.5)),
    "gyro": Noise(3.0, math.radians(0.3), math.radians(1.0)),
}


class Fit(NamedTuple):
    """The wheels that fit all runs best; ``mm`` and ``sigma``: each run's residual, in mm and relative to the noise."""

    left_step_mm: float
    right_step_mm: float
    track_mm: float
    mm: list[float]
    sigma: list[float]

    @property
    def residual_mm(self) -> float:
        return math.sqrt(sum(mm * mm for mm in self.mm) / len(self.mm))

    @property
    def worst(self) -> int | None:
        """Index of the run that fits worst, if noise does not explain it; else None."""
        worst = max(range(len(self.sigma)), key=self.sigma.__getitem__)
        return worst if self.sigma[worst] > LIMIT_SIGMA else None


def fit(runs: Sequence[Run], noise: Noise, step_mm: tuple[float, float], track_mm: float) -> Fit:
    """Return the wheels that fit ``runs``, starting from these lengths.

    A straight run gives two equations, for its way and its turn; a spin gives one, for its turn. Each is weighted by
    its noise.
    """
    wheels: NDArray[Any] = np.array([*step_mm, track_mm])
    for _ in range(_ITERATIONS):
        differences, slopes = _equations(runs, noise, wheels)
        wheels = wheels + np.linalg.lstsq(slopes, differences, rcond=None)[0]
    differences, _ = _equations(runs, noise, wheels)
    residuals = [float(abs(difference)) for difference in differences]
    sigma, mm = [], []
    for run in runs:
        way = 0.0 if run.mm is None else residuals.pop(0)  # in the order of the equations
        turn = residuals.pop(0)
        sigma.append(max(way, turn))
        turn_mm = turn * _turn_noise_rad(run, noise, wheels[2]) * wheels[2] / 2  # of each wheel
        mm.append(math.hypot(way * _way_noise_mm(run, noise), turn_mm))
    left, right, track = map(float, wheels)
    return Fit(left, right, track, mm, sigma)


def _equations(runs: Sequence[Run], noise: Noise, wheels: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the residuals of the equations, and the derivatives of the expected values by the three lengths.

    Both are divided by the noise.
    """
    left_mm, right_mm, track = wheels
    differences, slopes = [], []
    for run in runs:
        left, right = run.left * left_mm, run.right * right_mm
        if run.mm is not None:
            sigma = _way_noise_mm(run, noise)
            differences.append((run.mm - (left + right) / 2) / sigma)
            slopes.append([run.left / 2 / sigma, run.right / 2 / sigma, 0.0])
        turn, sigma = (right - left) / track, _turn_noise_rad(run, noise, track)
        differences.append((run.turn_rad - turn) / sigma)
        slopes.append([-run.left / track / sigma, run.right / track / sigma, -turn / track / sigma])
    return np.array(differences), np.array(slopes)


def _way_noise_mm(run: Run, noise: Noise) -> float:
    """Return the rms error of a straight run's way: that of measuring it and that of slipping wheels."""
    return math.hypot(noise.mm, _SLIP * (run.mm or 0.0) / math.sqrt(2))


def _turn_noise_rad(run: Run, noise: Noise, track_mm: float) -> float:
    if run.mm is None:
        return math.hypot(noise.spin_rad, _SLIP * run.turn_rad / math.sqrt(2))
    return math.hypot(noise.straight_rad, _SLIP * math.sqrt(2) * run.mm / track_mm)
