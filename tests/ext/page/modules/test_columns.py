"""Where the cards of a robot's page are placed, by how high they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.ext.page.in_node import Rows, Script, rows

#: ``cards``: their names and rows of 4 px, in a main column and, if it is another height, in the last one.
columns = Script(
    {"ui/robot/columns.js": "placed"},
    """
    const STAGE = ["picture", 164, 164, { span: "main" }], DRIVE = ["drive", 165, 165, { side: true }];
    const END = ["engineers", 30, 30, { span: "all" }];
    const at = (count, cards, hasSide = true, homes) => {
      const sizes = cards.map(([id, rows, sideRows = rows, more]) => ({ id, rows, sideRows, ...more }));
      const places = placed(sizes, count, hasSide, homes && new Map(Object.entries(homes)));
      return Object.fromEntries(places.map((place, n) => [sizes[n].id, place]).slice(hasSide ? 2 : 0, -1));
    };
    """,
)
PLOTS = '["plots", 92, 146, { wide: true }]'
STATE, MAP, SCRIPTS, LIGHTS = '["state", 68]', '["map", 108]', '["scripts", 58]', '["lights", 56, 81]'
USUAL = f"STAGE, DRIVE, {SCRIPTS}, {STATE}, {MAP}, {PLOTS}, {LIGHTS}, END"

# fmt: off
TABLE: Rows = {
    "a card goes where the columns end most alike": (
        f"result = at(2, [STAGE, DRIVE, {STATE}, {MAP}, END]);", {"state": [165, 1, 1], "map": [164, 0, 1]}),
    "what is wide spans columns that would stay empty": (
        f"result = at(3, [STAGE, DRIVE, {STATE}, {PLOTS}, END]);", {"state": [165, 2, 1], "plots": [164, 0, 2]}),
    "and only then": (
        f"result = at(3, [STAGE, DRIVE, {STATE}, {MAP}, {PLOTS}, END]);",
        {"state": [165, 2, 1], "map": [164, 0, 1], "plots": [164, 1, 1]}),
    "tops rise along the list": (
        f"result = ((tops) => tops.every((top, n) => !n || top >= tops[n - 1] - 6))"
        f"(Object.values(at(3, [{USUAL}])).map(([top]) => top));", True),
    "without one for driving all are alike": (
        f"result = at(2, [{STATE}, {MAP}, {STATE.replace('state', 'more')}, END], false);",
        {"state": [0, 0, 1], "map": [0, 1, 1], "more": [68, 0, 1]}),
    "one column has them one after another": (
        f"result = at(1, [{STATE}, {MAP}, {PLOTS}, END], false);",
        {"state": [0, 0, 1], "map": [68, 0, 1], "plots": [176, 0, 1]}),
    "a card keeps its column, and what is below it moves": (
        f"result = at(2, [STAGE, DRIVE, {STATE.replace('68', '200')}, {MAP}, END], true,"
        "{ state: [[0, 1]], map: [[0, 1]] });", {"state": [164, 0, 1], "map": [364, 0, 1]}),
    "a new one goes where the ends are most alike": (
        f"result = at(2, [STAGE, DRIVE, {STATE}, {MAP}, END], true, {{ map: [[1, 1]] }}).state;", [164, 0, 1]),
    "the same heights have the same places": (
        f"const first = at(4, [{USUAL}]); result = JSON.stringify(first) === JSON.stringify(at(4, [{USUAL}]));", True),
}
# fmt: on


@rows((columns, TABLE))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
