"""What the page has of a metric over time, what it plots of it, and the trail of its odometry; in Node.js."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.ext.page.in_node import Rows, Script, rows

_MODULES = {"core/series.js": "* as core", "core/plot-choices.js": "* as plots", "core/trail.js": "* as trail"}
_PREPARED = """
const series = (more = {}) => new core.Series(core.numbers, { spanMs: 120_000, most: 1000, ...more });
const shown = (one) => one.times.map((at, index) => [at, one.rows[index].value]);
const one = series();
"""


run = Script(_MODULES, _PREPARED)


#: What the numbers of a payload are.
NUMBERS = {
    "7": {"value": 7},
    "{ value: 7.9, unit: 'v', t: 5 }": {"value": 7.9},
    "{ value: { a: 1, b: { c: 2, d: { e: 3, f: { g: 4 } } } } }": {"a": 1, "b.c": 2, "b.d.e": 3},
    "{ t: 1, seq: 2, speed: 3 }": {"speed": 3},
    "{ value: [1, 'x', 2] }": {"0": 1, "2": 2},
    **dict.fromkeys(("{ value: null }", "{ value: NaN }", "{ value: Infinity }", "null", "'7'"), None),
    "{ value: { ['x'.repeat(61)]: 1 } }": None,
    'JSON.parse(\'{"value": {"__proto__": 1, "constructor": 2}}\')': {"__proto__": 1, "constructor": 2},
}
#: Where a payload says that something is.
PLACES = {
    "{ value: { x_mm: 1500, y_mm: -500, heading_rad: 0.5 }, unit: 'mm' }": [1.5, -0.5, 0.5],
    "{ value: { x: 1.5, y: -0.5, theta_rad: 0.5 }, unit: 'm' }": [1.5, -0.5, 0.5],
    "{ value: { x: 1500, y: -500, heading: 0.5 } }": [1.5, -0.5, 0.5],
    "{ value: { x: 150, y: -50, yaw_rad: 0.5, unit: 'cm' } }": [1.5, -0.5, 0.5],
    "{ x_m: 1.5, y_m: -0.5, z_m: 0, yaw_rad: 0.5 }": [1.5, -0.5, 0.5],
    "{ value: { x_mm: 0, y_mm: 0, heading_deg: 180 } }": [0, 0, 3.14159],
    "{ value: { x_mm: 0, y_mm: 0 } }": [0, 0, 0],
    "{ value: { x: 1500, y: 0 }, unit: { toString: 0 } }": [1.5, 0, 0],
}
NO_PLACES = (
    *("null", "7", "[]", "{}", "{ value: [1, 2] }", "{ value: { x_mm: '1', y_mm: 2 } }"),
    *("{ value: { x_mm: 1e300, y_mm: 0 } }", "{ value: { x: {} }, unit: { toString: 0 } }"),
)
_POSES = """
const pose = (x, run = -1) => ({ x, y: 0, heading: 0, run });
const cut = (times, poses) => trail.pieces(times, poses).map((piece) => piece.map(({ x }) => x));
"""
#: Times, poses, and the pieces of the trail.
TRAILS = {
    "one piece": ("[0, 100, 200]", "[pose(0), pose(0.1), pose(0.2)]", [[0, 0.1, 0.2]]),
    "a jump": ("[0, 100, 200]", "[pose(0), pose(2), pose(2.1)]", [[0], [2, 2.1]]),
    "a restart": ("[0, 100, 200]", "[pose(0.2, 5), pose(0.2, 0), pose(0.3, 0.1)]", [[0.2], [0.2, 0.3]]),
    "a silence": ("[0, 100, 9000]", "[pose(0), pose(0.1), pose(0.2)]", [[0, 0.1], [0.2]]),
    "nothing": ("[]", "[]", []),
}
# fmt: off
RUN: Rows = {
    "a value that is sent again is no new one": (
        "one.push(1000, 1); one.push(990, 1); one.push(2700, 1); result = shown(one);", [[1000, 1], [2700, 1]]),
    "it is bounded in number and time": ("""
        for (let at = 0; at < 20_000; at++) one.push(at, at);
        const count = one.times.length;
        for (let at = 1; at < 400; at++) one.push(20_000 + at * 1000, at);
        result = [count, one.times.length <= 183, one.times.at(-1) - one.times[0] < 183_000];""",
        [pytest.approx(1000, abs=63), True, True]),
    "what is cleared does not come back": ("""
        one.push(1000, 1); one.push(2000, 2); one.clear(2500); one.push(3000, 3);
        result = shown(one);""", [[3000, 3]]),
    "a slow metric has longer gaps":
        ("for (let at = 0; at < 60_000; at += 5000) one.push(at, 1); result = one.gapMs;", 17_500),
    "gaps are gaps": ("""
        for (const at of [0, 500, 1000, 1500, 6000, 6500]) one.push(at, at);
        result = [one.columns(["value"], 600, 6400), one.gapMs];""",
        [[[500, 1000, 1500, 1501, 6000], [500, 1000, 1500, None, 6000]], 2000]),
    "a line ends where a payload lacks it": ("""
        one.push(0, { value: { a: 1, b: 2 } }); one.push(100, { value: { a: 3, b: "x" } });
        result = one.columns(["a", "b"], 0, 1000);""", [[0, 100], [1, 3], [2, None]]),
    "a payload of a thousand numbers is cut": ("""
        const value = Object.fromEntries(Array.from({ length: 1000 }, (_, i) => [`n${i}`, i]));
        result = [{ value }, Array(1000).fill(1)].map((one) => Object.keys(core.numbers(one)).length);""", [24, 8]),
    "the plots of all numbers of a metric": ("""
        const payload = { value: { temp_c: 31, gyro: { x: 1, y: 2, z: 3 }, text: "x" } };
        result = plots.plotsOf("sensors/imu", payload).map(({ title, fields }) => [title, fields.join()]);""",
        [["sensors/imu temp_c", "temp_c"], ["sensors/imu gyro", "gyro.x,gyro.y,gyro.z"]]),
    "a component at rest leaves few poses": ("""
        const path = new core.Series(trail.poseOf, { spanMs: 3_600_000, most: 4000, differs: trail.differs });
        for (let at = 0; at < 100_000; at += 50) path.push(at, { value: { x_mm: 1, y_mm: 0 } });
        result = [path.times.length, trail.pieces(path.times, path.rows).length];""", [100, 1]),
    **{f"the numbers of {payload}": (f"result = core.numbers({payload});", found)
        for payload, found in NUMBERS.items()},
    **{f"the range of {low} to {high} has room": (
        f"result = plots.spread({low}, {high}, {least});", pytest.approx(seen)) for low, high, least, seen in (
        ("7.9", "7.9", "0.2", [7.8, 8.0]), ("0", "100", "20", [-8, 108]), ("null", "null", "1", [0, 1]))},
    **{f"the pose of {payload}": (
        f"const pose = trail.poseOf({payload}); result = [pose.x, pose.y, pose.heading];", pytest.approx(at, abs=1e-4))
        for payload, at in PLACES.items()},
    **{f"{payload} is no pose": (f"result = trail.poseOf({payload});", None) for payload in NO_PLACES},
    **{f"a trail with {what}": (f"{_POSES} result = cut({times}, {poses});", pieces)
        for what, (times, poses, pieces) in TRAILS.items()},
}
# fmt: on


@rows((run, RUN))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
