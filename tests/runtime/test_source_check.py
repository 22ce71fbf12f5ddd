"""A source that repeats itself, or comes at another rate than asked, is found; one at rest or a little off is not."""

from __future__ import annotations

import pytest

from pebble.runtime.source_check import SourceCheck
from pebble.services.serial_mcu_bridge.moving_sensors import MovingSensors

#: Contents, ten in a second, each letter for a second: how many repeat in the end.
CONTENTS = {
    "each differs": ("?" * 10, False),
    "the same": ("a" * 7, True),
    "it moved again": ("aaaaaaaab", False),
    "while it need not change": ("AAAAAAAAA", False),
    "at rest, then not long": ("AAAAAAAAAaaaa", False),
    "between rests": ("aaAAaaAAaaA", True),
}


@pytest.mark.parametrize(("seconds", "repeats"), CONTENTS.values(), ids=CONTENTS)
def test_contents(seconds: str, repeats: bool) -> None:
    check = SourceCheck()
    for number in range(10 * len(seconds)):
        letter = seconds[number // 10]
        content = number if letter == "?" else letter.lower()
        check.take(content, number / 10, counts=not letter.isupper())
    assert check.repeats is repeats


@pytest.mark.parametrize(("hz", "asked", "found"), [(13, 15, None), (10, 15, 10), (19, 15, 19), (3, 0, None)])
def test_rates(hz: int, asked: float, found: float | None) -> None:
    check = SourceCheck(asked)
    for number in range(2 * hz):
        check.count(1, 100 + number / hz / 10)  # a start in a hurry
    for number in range(13 * hz):
        check.count(1, 102 + number / hz)
    assert check.wrong_hz == (None if found is None else pytest.approx(found, rel=0.05))


#: Values of three sensors, each letter for a second at 50 Hz: x changes, others stay; and who is found.
SENSORS = {
    "at rest": (["aaaaaaaaaa", "bbbbbbbbbb", "cccccccccc"], ".........", ""),
    "all still while driven": (["aaaaaaaaaa", "bbbbbbbbbb", "cccccccccc"], "dddddddddd", "left, right, third repeat"),
    "one of them stops": (["xxaaaaaaaaa", "xxxxxxxxxxx", "xxxxxxxxxxx"], "ddddddddddd", "left repeats its value"),
    "driven in short moves": (
        ["aaaaaaaaaaaaa", "bbbbbbbbbbbbb", "ccccccccccccc"],
        "dd.dd.dd.dd.dd",
        "left, right, third",
    ),
}


@pytest.mark.parametrize(("values", "drives", "found"), SENSORS.values(), ids=SENSORS)
def test_sensors_change_while_the_wheels_turn(values: list[str], drives: str, found: str) -> None:
    sensors = MovingSensors()
    for number in range(50 * len(values[0])):
        second, now = number // 50, number / 50
        sensors.drive(now + 0.75 if drives[second : second + 1] == "d" else 0.0)
        letters = zip(("left", "right", "third"), (each[second] for each in values), strict=True)
        sensors.take({name: number if letter == "x" else letter for name, letter in letters}, now)
    assert sensors.problem.startswith(found)
    assert bool(sensors.problem) is bool(found)
