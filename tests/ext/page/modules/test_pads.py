"""Which gamepad drives, which stop, and what is said of those that are ignored; in Node.js."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from tests.ext.page.in_node import Rows, rows
from tests.ext.page.modules.test_driver import driver

_REAL = """
const real = (z, ...pressed) => ({ ...pad(z, ...pressed), id: "Xbox", index: 1, mapping: "standard" });
const odd = (more) => ({ id: "Receiver", index: 0, axes: [0, 0], buttons: [], timestamp: 1, mapping: "", ...more });
const second = (z) => ({ ...real(z), index: 2 });
const joy = (z) => ({ ...pad(z), id: "Attack 3" });
const show = (...all) => { pads = all; driver.tick(); };
const codes = () => driver.pads.reasons().map(({ code }) => code.replace("pad-", ""));
let time = performance.now();
const began = Date.now() - time;
performance.now = () => time;
Date.now = () => began + time;
const pass = (ms, ...all) => { for (; ms > 0; ms -= 50) { time += 50; show(...all); } };
const stops = () => done.filter((op) => /stop/.test(op));
"""


shown = replace(driver, before=driver.before + _REAL)


#: What a browser may list before the real one.
STRANGE = {
    "no axes": "odd({ axes: [] })",
    "no field of axes": "odd({ axes: undefined })",
    "axes that are no numbers": "odd({ axes: [NaN, NaN] })",
    "axes that cannot be read": "Object.defineProperty(odd(), 'axes', { get() { throw new Error('no'); } })",
    "axes at -1": "odd({ axes: [-1, -1, 0, 0] })",
    "a button held since before": "odd({ buttons: [{ pressed: false }, { pressed: true }] })",
    "a button that cannot be read": "odd({ buttons: [{ get pressed() { throw new Error('no'); } }] })",
    "its STOP held since before": "odd({ buttons: real(0, 8, 9).buttons })",
    "no buttons": "odd({ buttons: undefined })",
    "an id that is none": "odd({ id: null, index: undefined })",
    "a hole": "null",
    "one that has gone": "odd({ connected: false, axes: [1, 1] })",
}
LISTS = {"null": 0, "undefined": 0, "[null, undefined, , real(0)]": 1, "[7, 'x', real(0)]": 1}
#: Why it drives, or does not: what is shown, and the axis.
WHICH = {
    "it was seen in neutral": ("show(real(0)); show(real(1));", 0.6),
    "it was not": ("show(real(1));", 0),
    "the layout of the one before it is not known": ("show(pad(0), real(0)); show(pad(1), real(1));", 0.6),
    "it has the layout of an Attack 3": ("show(joy(0), real(0)); show(joy(1), real(0));", 0.6),
    "no layout is known": ("show(pad(0), odd()); show(pad(1), odd());", 0.6),
    "the first one of two is pushed": ("show(real(0), second(0)); show(real(1), second(-1));", 0.6),
    "another one came before it": ("show(null, real(0)); show({ ...real(0), index: 0 }, real(1));", 0.6),
    "a worn stick rests beside the middle": ("show(real(0.14)); show(real(1));", 0.6),
    "another window": ("document.hasFocus = () => false; show(real(0)); show(real(1));", 0),
}
# fmt: off
SHOWN: Rows = {
    **{f"the real one drives and stops though first is listed {what}": (f"""
        const first = () => ({first});
        show(first(), real(0)); done.length = 0;
        show(first(), real(1)); const z = driver.output.z;
        show(first(), real(0)); show(first(), real(0, 8, 9)); show(first(), real(0)); show(first(), real(0, 0));
        result = [z, stops(), driver.failed.size];""", [0.6, ["estop: gamepad", "stop"], 0])
        for what, first in STRANGE.items()},
    **{f"a list of gamepads of any shape is taken: {given}": (
        f"pads = {given}; driver.tick(); result = [driver.failed.size, driver.pads.usable.length];", [0, count])
        for given, count in LISTS.items()},
    **{f"a browser that shows no gamepads changes nothing else: {denied}": (f"""
        navigator.getGamepads = {denied}; driver.tick(); key("KeyW");
        result = [driver.failed.size, driver.output.z];""", [0, 0.6])
        for denied in ("undefined", "() => { throw new Error('denied'); }")},
    **{f"which drives: {why}": (f"{steps} result = driver.output.z;", z) for why, (steps, z) in WHICH.items()},
    "the buttons of a mapping stop": ("""
        const f310 = (...pressed) => ({ ...pad(0, ...pressed), id: "Logitech Dual Action (046d-c216)" });
        show(f310()); show(f310(0)); result = [stops()]; show(f310(1)); result.push(stops());""", [[], ["stop"]]),
    **{f"it is reported and does not count: {what}": (
        f"{steps} driver.tick(); result = [driver.output.z, driver.reason().code];", [0, "release"])
        for what, steps in {
            "a key that is held in another window": "key('KeyW', { repeat: true });",
            "a key that was pressed while the page stood still": "key('KeyW', { timeStamp: time - 5000 });",
            "a second finger": "driver.stickStart(1); driver.stick(0, 1); driver.interrupt();",
            "a key before the space bar": "key('KeyW'); driver.space();",
        }.items()},
    **{f"a part that fails ends what is driven, is reported and keeps no stop back: {part}": (f"""
        console.error = () => {{}}; key("KeyW"); driver.tick(); const z = driver.output.z;
        const {{ {part} }} = {owner}; {owner}.{part} = () => {{ throw new Error("no"); }};
        driver.tick(); result = [z, driver.output.z, driver.reason().code];
        driver.latch("button"); result.push(stops());
        {owner}.{part} = {part}; driver.tick(); driver.keyUp({{ code: "KeyW", key: "w" }});
        driver.tick(); result.push(driver.reason());""", [0.6, 0, "failed", ["estop: button"], None])
        for owner, part in (("driver", "readPads"), ("driver", "update"), ("driver.lease", "watch"))},
    "the emergency stop of each gamepad counts whichever drives": ("""
        show(pad(0), real(0)); show(pad(1), real(0)); done.length = 0;
        show(pad(1), real(0, 8, 9)); const z = driver.output.z;
        show(pad(1), real(0)); show(pad(1, 8, 9), real(0)); result = [z, stops()];""",
        [0, ["estop: gamepad", "estop: gamepad"]]),
    "each of two stops while the other one is held for good": ("""
        const worn = () => ({ ...pad(0, 8, 9), id: "worn" });
        show(worn(), real(0)); done.length = 0; show(worn(), real(0)); const held = stops();
        show(worn(), real(0, 8, 9)); result = [held, stops()];""", [[], ["estop: gamepad"]]),
    "each of two stops before the rest of the page is here": ("""
        driver.pads = null; show(pad(0, 8, 9), real(0)); done.length = 0;
        show(pad(0, 8, 9), real(0, 8, 9)); result = stops();""", ["estop: gamepad"]),
    "a stop that is held for good is sent once: else no reset would last": ("""
        const worn = () => pad(0, 8, 9);
        pass(2500, worn()); time += 60_000; show(worn());
        result = [stops(), driver.reason()];""", [["estop: gamepad"], None]),
    "a gamepad that is gone stops again when it comes back with its button held": (
        "show(real(0, 8, 9)); show(null); show(real(0, 8, 9)); result = stops();", ["estop: gamepad"] * 2),
    "of two that are pushed the other one is named": (
        "show(real(0), second(0)); show(real(1), second(1)); result = codes();", ["other"]),
    "a stick that was interrupted is named until it is let go": (
        "show(real(0)); show(real(1)); driver.interrupt(); show(real(1)); const held = codes(); show(real(0));"
        "result = [held, codes()];", [["release"], []]),
    "a gamepad that stands still while it is deflected is given up and reported": ("""
        const frozen = real(1); show(real(0)); pass(2500, frozen); result = [driver.output.z];
        pass(1000, frozen); result.push(driver.output.z, driver.reason().code);""", [0.6, 0, "pad"]),
    "a gamepad in another window is reported and its stop counts": ("""
        document.hasFocus = () => false; show(real(0)); show(real(1)); result = [codes(), driver.output.z];
        show(real(1, 8, 9)); result.push(stops());""", [["focus"], 0, ["estop: gamepad"]]),
}
# fmt: on


# -- what fails in the page's own code


@rows((shown, SHOWN))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
