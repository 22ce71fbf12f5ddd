"""The fit of wheels to runs, and the movement that a tape or a tag shows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pebble.extensions.calibrate.fit import NOISE, Fit, Run, fit
from pebble.extensions.calibrate.wheels import arc, between
from pebble.extensions.scripts.perception.tags import Place

BELIEVED = (19.164, 19.164), 130.5
LEFT, RIGHT, TRACK = 19.36, 18.97, 134.4


def runs_of(seed: int, truth: str, slip: float, left: float = LEFT, right: float = RIGHT) -> list[Run]:
    """Six straights and two spins of these wheels, with the errors of ``truth``; ``slip`` is a part of the way."""
    random, noise = np.random.default_rng(seed), NOISE[truth]

    def run(name: str, left_mm: float, right_mm: float, *, spin: bool) -> Run:
        left_steps, right_steps = (
            mm / step * (1 + random.normal(0, slip)) for mm, step in ((left_mm, left), (right_mm, right))
        )
        turn = (right_mm - left_mm) / TRACK + random.normal(0, noise.spin_rad if spin else noise.straight_rad)
        return Run(
            name, left_steps, right_steps, turn, None if spin else (left_mm + right_mm) / 2 + random.normal(0, 2)
        )

    ways = [
        (sign * 1500 - drift, sign * 1500 + drift)
        for sign, drift in zip((1, -1) * 3, random.normal(0, 5, 6), strict=True)
    ]
    spins = [sign * 3 * math.pi * TRACK for sign in (1, -1)]
    straights = [run(f"straight {number}", *way, spin=False) for number, way in enumerate(ways)]
    return straights + [run(f"spin {number}", -mm, mm, spin=True) for number, mm in enumerate(spins)]


def off_percent(result: Fit) -> tuple[float, float, float]:
    true = zip((result.left_step_mm, result.right_step_mm, result.track_mm), (LEFT, RIGHT, TRACK), strict=True)
    left, right, track = (100 * abs(value / wanted - 1) for value, wanted in true)
    return left, right, track


@pytest.mark.parametrize(("truth", "step", "track"), [("tape", 0.3, 0.47), ("gyro", 0.28, 0.42)])
def test_95_of_100_calibrations_are_as_exact_as_the_document_says(truth: str, step: float, track: float) -> None:
    off = [off_percent(fit(runs_of(seed, truth, 0.003), NOISE[truth], *BELIEVED)) for seed in range(400)]
    left, right, tracks = np.percentile(off, 95, axis=0)
    assert max(left, right) < step * 1.1
    assert tracks < track * 1.1


def test_a_run_that_does_not_fit_is_the_worst() -> None:
    runs = runs_of(1, "tape", 0.001)
    assert fit(runs, NOISE["tape"], *BELIEVED).worst is None
    assert runs[2].mm is not None
    wrong = [*runs[:2], runs[2]._replace(mm=runs[2].mm + 60), *runs[3:]]
    result = fit(wrong, NOISE["tape"], *BELIEVED)
    assert result.worst == 2
    assert result.mm[2] == max(result.mm)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("turn_deg", [0.0, 12.0, -12.0])
def test_the_arc_by_a_tape_and_by_a_tag_is_the_one_that_was_driven(sign: int, turn_deg: float) -> None:
    mm, turn = sign * 1500.0, math.radians(turn_deg)
    radius = mm / turn if turn else math.inf
    end = (radius * math.sin(turn), radius * (1 - math.cos(turn))) if turn else (mm, 0.0)
    by_tape = arc(*end)
    tag = (2300.0, 150.0)

    def place(x: float, y: float, heading: float) -> Place:
        ahead, left = tag[0] - x, tag[1] - y
        angle = heading - math.atan2(left, ahead)
        return Place(math.hypot(ahead, left, 80.0) / 1000, angle, -0.08)

    by_tag = between(place(0.0, 0.0, 0.0), place(*end, turn))
    for moved in (by_tape, by_tag):
        assert moved.mm == pytest.approx(mm)
        assert moved.turn_rad == pytest.approx(turn, abs=1e-9)
