"""World files: all mistakes at once, each with its place and a remedy."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.errors import ConfigError
from pebble.extensions.lab.simulation.world.world_file import parse_world

GOOB = {"x": 0.0, "y": 0.0}


def problems(**keys: Any) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_world({"robots": {"goob": GOOB}} | keys)
    return caught.value.problems


def test_all_mistakes_are_reported_at_once_with_their_places() -> None:
    wrong = {
        "familie": 1,
        "camera": {"hfov": 60, "noise": -1},
        "tags": [{"id": 3, "x": "a", "y": 0.0}, {"x": 1, "y": 1}],
        "robots": {"goob": {"x": 0.0, "kind": "tank"}},
    }
    assert sorted(problems(**wrong)) == sorted(
        [
            'familie: unknown key, did you mean "family"?',
            'camera.hfov: unknown key, did you mean "hfov_deg"?',
            "camera.noise: must be a number from 0 to 100, not -1",
            "tags[0].x: must be a number from -100 to 100, not text",
            "tags[1].id: is missing, write a whole number from 0 to 2319",
            'robots.goob.kind: must be "goob" or "fred"',
            "robots.goob.y: is missing, write a number from -100 to 100",
        ]
    )


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"robots": {}}, "robots: must be 1 to 32 robots, not 0"),
        ({"robots": {"goob": GOOB, "fred": {"x": 0.1, "y": 0.0}}},
         "robots.fred: stands 0.10 m from goob, must be 0.2 m or more"),
        ({"robots": {"goob": GOOB | {"tag": 99}}},
         "robots.goob.tag: must be below 35, the number of tags in APRILTAG_25h9, not 99"),
        ({"drawings": [{"x": 1, "y": 0, "z": 0.3, "width_m": 1, "height_m": 1, "shapes": []}]},
         "drawings[0]: needs shapes of three points or more, each x and y"),
        ({"walls": [{"x1": 0.05, "y1": 1, "x2": 0.05, "y2": -1}]},
         "robots.goob: stands 0.05 m from a wall, its radius is 0.1"),
        ({"room": {"x_min": 1, "x_max": 0, "y_min": 0, "y_max": 1}},
         "room.x_min: must be below x_max, which is 0, not 1"),
    ],
)  # fmt: skip
def test_values_that_contradict_each_other_are_refused(keys: dict[str, Any], problem: str) -> None:
    assert problems(**keys) == [problem]


def test_a_robots_name_must_fit_into_a_topic() -> None:
    assert "the name must be a topic level" in problems(robots={"a/b": GOOB})[0]
