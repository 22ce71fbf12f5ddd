"""What the page makes of manifests, of what is entered into their forms, and of capabilities; in Node.js."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from tests.ext.boards import mcu_wire as wire
from tests.ext.page.in_node import Rows, Script, rows
from tests.ext.page.states import described

_MODULES = {
    "ui/cards/manifest.js": "command, range, step, unsendable",
    "ui/cards/outlets.js": "outletsOf, obstacle",
    "ui/parts/models.js": "Offers",
}


script = Script(_MODULES)


def of(expression: str, *values: Any) -> str:
    """Steps: what ``expression`` makes of ``v``, the ``values``."""
    return f"const v = {json.dumps(values)}; result = {expression};"


PRIVATE = wire.M("m", (wire.I(1, "a", wire.IN, wire.KIND_COMMAND, (wire.F("x", wire.U8),), flags=wire.LOCAL_ONLY),))


def interface(*fields: dict[str, Any]) -> dict[str, Any]:
    return {"interfaces": [{"name": "a", "dir": "in", "encoding": {"fields": list(fields)}}]}


COMMAND = "command(v[0].interfaces[0], new Map(v[1]))"
#: Fields, what is entered, and the value of the field's type.
ENTERED: list[tuple[dict[str, Any], Any, Any]] = [
    ({"type": "bool"}, True, True),
    ({"type": "bool"}, None, False),
    ({"type": "u8"}, "255", 255),
    ({"type": "f32"}, "1.5e3", 1500),
    ({"type": "i16", "scale": -0.1, "offset": 10}, "3286.8", 3286.8),
]
#: Fields, and the least and the greatest value, and the step.
RANGES: list[tuple[dict[str, Any], Any, str]] = [
    ({"type": "u8"}, [0, 255], "1"),
    ({"type": "i32"}, [-2147483648, 2147483647], "1"),
    ({"type": "u8", "scale": 0.5}, [0, 127.5], "0.5"),
    ({"type": "i16", "scale": -0.1, "offset": 10}, [-3266.7, 3286.8], "any"),
    ({"type": "f32"}, None, "any"),
]


# -- what a robot offers

#: What its capabilities list of *drive*, and whether there are controls for an axis besides turning and going.
AXES: list[tuple[Any, bool]] = [
    ({"drive": {"available": True, "axes": ["x", "z"]}}, False),
    ({"drive": {"available": True, "axes": ["x", "y", "z"]}}, True),
    ({"drive": {"available": True, "axes": []}}, False),
    ({"drive": {"available": True}}, True),  # it does not list them: it may have any
    ({"drive": {"available": True, "axes": "xz"}}, True),
    (None, True),  # no capabilities
]
LISTED = {"value": {"outlets": {"available": True, "outlets": [{"name": "o1", "controls": False}, {"name": "o2"}]}}}
#: Capabilities, metrics, and the outlets, and whether each can be switched.
OUTLETS: list[tuple[Any, list[str], dict[str, bool]]] = [
    (LISTED, ["outlets/o1/status", "outlets/o9/status"], {"o1": False, "o2": True, "o9": False}),
    (None, ["outlets/o1/status", "outlets/o1/other", "outlets/x"], {"o1": True}),
]
NOT_TOPIC = "its name cannot be part of a topic"
#: Names of outlets, whether they can be switched, what they report, and why they cannot be switched on.
OBSTACLES: list[tuple[str, bool, dict[str, Any], str]] = [
    ("o1", True, {}, ""),
    ("o1", True, {"bound": True, "reachable": True, "on": False}, ""),
    ("o1", True, {"reachable": False}, "outlet is unreachable"),
    ("o1", True, {"bound": False, "reachable": False}, "no device is bound to this outlet"),
    ("o1", False, {}, "this outlet cannot be switched from here: its robot lists no control"),
    ("a/b", True, {}, NOT_TOPIC),
    ("x" * 65, True, {}, NOT_TOPIC),
    ("😀" * 64, True, {}, ""),
]
# fmt: off
ROWS: Rows = {
    "an interface that stays on the robot takes no commands": (
        of("unsendable(v[0].interfaces[0]).slice(0, 22)", described(PRIVATE)), "it takes commands from"),
    **{f"controls for an extra axis: {value}": (
        of("new Offers('pebble/robots/a', v[0]).hasExtraAxis", value and {"value": value}), expected)
        for value, expected in AXES},
    **{f"outlets are those that are listed and those that report: {metrics}": (of("""Object.fromEntries(
        outletsOf(new Offers('pebble/robots/a', v[0], v[1])).map(({ name, controls }) => [name, controls]))""",
        capabilities, metrics), expected) for capabilities, metrics, expected in OUTLETS},
    **{f"what is entered becomes JSON of the field's type: {field} {entered}": (of(
        COMMAND, interface({"name": "x", **field}), [["x", entered], ["y", "7"]]), {"x": value})
        for field, entered, value in ENTERED},
    **{f"what a field can hold: {field}": (of("[range(v[0]), step(v[0])]", field), [limits, step])
        for field, limits, step in RANGES},
    **{f"why {name[:8]} {controls} {report} cannot be switched": (
        of("obstacle(...v)", name, controls, report, True), why) for name, controls, report, why in OBSTACLES},
    **{f"an outlet can be switched off whatever it reports: {report}": (
        of("obstacle(...v)", "o1", True, report, False), "")
        for report in ({"reachable": False}, {"bound": False}, {"on": True})},
}
# fmt: on


@rows((script, ROWS))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
