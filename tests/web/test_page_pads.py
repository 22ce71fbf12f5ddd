"""Which gamepad drives, which stop, and what is said of those that are ignored; in Node.js."""

from __future__ import annotations

from typing import Any

import pytest

from tests.web.test_page_driver import driver

_REAL = """
const real = (z, ...pressed) => ({ ...pad(z, ...pressed), id: "Xbox", index: 1, mapping: "standard" });
const odd = (more) => ({ id: "Receiver", index: 0, axes: [0, 0], buttons: [], timestamp: 1, mapping: "", ...more });
const show = (...all) => { pads = all; driver.tick(); };
const codes = () => driver.pads.reasons().map(({ code }) => code.replace("pad-", ""));
let time = performance.now();
const began = Date.now() - time;
performance.now = () => time;
Date.now = () => began + time;
const pass = (ms, ...all) => { for (; ms > 0; ms -= 50) { time += 50; show(...all); } };
const stops = () => done.filter((op) => /stop/.test(op));
"""


def shown(steps: str) -> Any:
    return driver(_REAL + steps)


#: What a browser may list before the real one, and what is said of it; "" nothing needs to be said.
STRANGE = {
    "no axes": ("odd({ axes: [] })", "axes"),
    "one axis": ("odd({ axes: [0] })", "axes"),
    "no field of axes": ("odd({ axes: undefined })", "axes"),
    "axes that are no list": ("odd({ axes: 7 })", "axes"),
    "axes that are no numbers": ("odd({ axes: [NaN, NaN] })", "axes"),
    "infinite axes": ("odd({ axes: [Infinity, 0] })", "axes"),
    "axes with holes": ("odd({ axes: [, 0] })", "axes"),
    "axes that cannot be read": ("Object.defineProperty(odd(), 'axes', { get() { throw new Error('no'); } })", "axes"),
    "axes at -1": ("odd({ axes: [-1, -1, 0, 0] })", "off-centre"),
    "one axis at -1": ("odd({ axes: [0, -1] })", "off-centre"),
    "a worn stick": ("odd({ axes: [0.15, 0.12] })", "off-centre"),
    "a trembling stick within its dead zone": ("odd({ axes: [0.09, -0.08] })", ""),
    "a button held since before": ("odd({ buttons: [{ pressed: false }, { pressed: true }] })", "held"),
    "a button that is a number": ("odd({ buttons: [0, 0, 0, 1] })", "held"),
    "a button with only a value": ("odd({ buttons: [{ value: 0 }, { value: 0 }, { value: 1 }] })", "held"),
    "a button that cannot be read": ("odd({ buttons: [{ get pressed() { throw new Error('no'); } }] })", ""),
    "its STOP held since before": ("odd({ buttons: real(0, 8, 9).buttons })", "held"),
    "no buttons": ("odd({ buttons: undefined })", ""),
    "an id that is none": ("odd({ id: null, index: undefined })", ""),
    "a hole": ("null", ""),
    "nothing at all": ("undefined", ""),
    "one that has gone": ("odd({ connected: false, axes: [1, 1] })", ""),
}


@pytest.mark.parametrize("one", STRANGE)
def test_whatever_is_listed_first_the_one_that_is_touched_drives_and_stops(one: str) -> None:
    first, code = STRANGE[one]
    steps = f"""const first = () => ({first});
    show(first(), real(0)); const said = codes(); done.length = 0;
    show(first(), real(1)); const z = driver.output.z;
    show(first(), real(0)); show(first(), real(0, 8, 9)); show(first(), real(0)); show(first(), real(0, 0));
    result = [said, z, stops()];"""
    assert shown(steps) == [[code] if code else [], 0.6, ["estop: gamepad", "stop"]]


@pytest.mark.parametrize(
    "list_of", ["null", "undefined", "[null, undefined, , real(0)]", "{ length: 2, 1: real(0) }", "[7, 'x', real(0)]"]
)
def test_lists_of_gamepads_of_any_shape_are_taken(list_of: str) -> None:
    steps = f"pads = {list_of}; driver.tick(); result = [driver.failed.size, driver.pads.choice.here.length];"
    assert shown(steps) == [0, int("real" in list_of) + list_of.count("7, 'x'") * 2]


def test_a_browser_that_shows_no_gamepads_to_this_page_changes_nothing_else() -> None:
    for denied in ("undefined", "() => { throw new Error('denied'); }"):
        steps = f'navigator.getGamepads = {denied}; driver.tick(); key("KeyW");'
        assert shown(f"{steps} result = [driver.failed.size, driver.output.z];") == [0, 0.6]


# -- stops


def test_the_emergency_stop_of_each_gamepad_counts_whichever_drives() -> None:
    steps = """show(pad(0), real(0)); show(pad(1), real(0)); done.length = 0;
    show(pad(1), real(0, 8, 9)); const z = driver.output.z;
    show(pad(1), real(0)); show(pad(1, 8, 9), real(0)); result = [z, stops()];"""
    assert shown(steps) == [0, ["estop: gamepad", "estop: gamepad"]]


def test_each_of_two_stops_while_the_other_one_is_held_for_good() -> None:
    steps = """const worn = () => ({ ...pad(0, 8, 9), id: "worn" });
    show(worn(), real(0)); done.length = 0; show(worn(), real(0)); const held = stops();
    show(worn(), real(0, 8, 9)); result = [held, stops()];"""
    assert shown(steps) == [[], ["estop: gamepad"]]


def test_each_of_two_stops_before_the_rest_of_the_page_is_here() -> None:
    steps = """driver.pads = null; show(pad(0, 8, 9), real(0)); done.length = 0;
    show(pad(0, 8, 9), real(0, 8, 9)); result = stops();"""
    assert shown(steps) == ["estop: gamepad"]


def test_a_stop_that_is_held_for_good_is_sent_once_and_reported() -> None:
    """Else no reset would last."""
    steps = """const worn = () => pad(0, 8, 9);
    pass(2500, worn()); pass(500, null); show(worn()); // a loose contact
    time += 60_000; show(worn()); time += 60_000; show(null); time += 60_000; show(worn()); // a tab in the background
    result = [stops(), codes(), driver.reason()];"""
    assert shown(steps) == [["estop: gamepad"], ["stop-held"], None]


# -- which drives


@pytest.mark.parametrize(
    ("steps", "z"),
    [
        ("show(pad(0), real(0)); show(pad(0), real(1));", 0.6),  # it was touched last
        ("show(pad(1), real(0)); show(pad(1), real(1));", 0.6),  # the other one was never touched
        ("show(pad(0), real(1));", 0),  # it was not seen in neutral
        ("show(pad(0), real(0)); show(pad(1), real(0)); pass(300, pad(1), real(0.3));", 0.6),  # brushed
        ("show(pad(0), real(0)); show(pad(1), real(0)); show(pad(1), real(1));", 0.6),  # one device, listed twice
        ("show(pad(0), real(0, 5)); show(pad(0), real(1));", 0.6),  # pressed, then pushed
        ("document.hasFocus = () => false; show(pad(0), real(0)); show(pad(0), real(1));", 0),  # another window
    ],
)
def test_which_gamepad_drives(steps: str, z: float) -> None:
    assert shown(f"{steps} result = driver.output.z;") == z


def test_a_takeover_stops_and_drives_only_after_a_release() -> None:
    steps = """show(pad(0), real(0)); pass(500, pad(-1), real(0)); pass(500, pad(-1), real(1));
    result = [driver.pads.pad.id, driver.output.z];
    show(pad(0), real(0)); show(pad(0), real(1)); result.push(driver.output.z);"""
    assert shown(steps) == ["Xbox", 0, 0.6]


def test_one_that_cannot_be_used_can_be_chosen_and_reports_why_it_does_not_drive() -> None:
    steps = """const worn = odd({ axes: [0, -1] });
    show(worn, real(0)); driver.pads.pick("0 Receiver"); show(worn, real(0));
    result = [codes(), driver.output.z];"""
    assert shown(steps) == [["off-centre"], 0]


def test_a_gamepad_that_stands_still_while_it_is_deflected_is_given_up_and_reported() -> None:
    steps = """const frozen = real(1); show(real(0)); pass(2500, frozen); result = [driver.output.z];
    pass(1000, frozen); result.push(driver.output.z, driver.reason().code);"""
    assert shown(steps) == [0.6, 0, "pad"]


@pytest.mark.parametrize(
    "steps",
    [
        "key('KeyW', { repeat: true }); driver.tick();",  # held in another window
        "key('KeyW', { timeStamp: time - 5000 }); driver.tick();",  # pressed while the page stood still
        "driver.stickStart(1); driver.stick(0, 1); driver.interrupt(); driver.tick();",  # by a second finger
        "key('KeyW'); driver.space();",
    ],
)
def test_keys_and_fingers_that_do_not_count_are_reported(steps: str) -> None:
    assert shown(f"{steps} result = [driver.output.z, driver.reason().code];") == [0, "release"]


def test_a_gamepad_in_another_window_is_reported_and_its_stop_counts() -> None:
    steps = """document.hasFocus = () => false; show(real(0)); show(real(1)); result = [codes(), driver.output.z];
    show(real(1, 8, 9)); result.push(stops());"""
    assert shown(steps) == [["focus"], 0, ["estop: gamepad"]]


# -- what fails in the page's own code


@pytest.mark.parametrize("part", ["readPads", "update", "watchLease"])
def test_a_part_that_fails_ends_what_is_driven_is_reported_and_keeps_no_stop_back(part: str) -> None:
    steps = f"""console.error = () => {{}}; key("KeyW"); driver.tick(); const z = driver.output.z;
    const {{ {part} }} = driver; driver.{part} = () => {{ throw new Error("no"); }};
    driver.tick(); result = [z, driver.output.z, driver.reason().code];
    driver.latch("button"); result.push(stops());
    driver.{part} = {part}; driver.tick(); driver.keyUp({{ code: "KeyW", key: "w" }});
    driver.tick(); result.push(driver.reason());"""
    assert shown(steps) == [0.6, 0, "failed", ["estop: button"], None]
