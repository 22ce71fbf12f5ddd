"""What keys and gamepads do besides driving, how a gamepad is learned, and QR codes: the pure modules, in Node.js."""

from __future__ import annotations

import json
from typing import Any

import cv2
import numpy as np
import pytest

from tests.web.in_node import STATIC, evaluate
from tests.web.test_page_core import run

# -- actions: what is done is listed as [action, phase]

_ACTIONS = """
const done = [];
let open = true;
const actions = new Actions((id, phase) => done.push([id, phase]), () => open);
const usual = { x: { axis: 0, invert: false }, z: { axis: 1, invert: true }, deadZone: 0.1, buttons: {} };
const key = (code, { key = code, repeat = false } = {}) => actions.keyDown({ code, key, repeat });
const pad = (...pressed) => ({
  id: "pad", index: 0, axes: [0, 0], buttons: Array.from({ length: 16 }, (_, i) => ({ pressed: pressed.includes(i) })),
});
const seen = (...pads) => pads.forEach((one) => actions.padSample(one, usual));
"""


def actions(steps: str) -> Any:
    names = "Actions, ACTIONS, PAD_ACTIONS, keyName, buttonName, buttonOf"
    return run("actions.js", names, f"{_ACTIONS}{steps}\nawait null;\nresult ??= done;")


def test_each_key_has_its_action() -> None:
    presses = {
        'key("KeyF")': "flash",
        'key("KeyM")': "mute",
        'key("KeyP")': "repeat",
        'key("KeyT")': "talk",
        'key("Slash", { key: "?" })': "help",
        'key("Minus", { key: "?" })': "help",  # on a German keyboard
        'key("Slash", { key: "-" })': "slower",  # there, too
        'key("KeyM", { key: "?" })': "help",  # on a French keyboard
        'key("KeyM", { key: "," })': "mute",  # there, too
        'key("NumpadAdd", { key: "+" })': "faster",
        'key("Equal", { key: "=" })': "faster",
    }
    assert actions("; ".join(presses)) == [[action, "down"] for action in presses.values()]


def test_other_keys_have_none() -> None:
    presses = ['key("KeyX")', 'key("Slash", { key: "/" })', 'key("KeyW")', 'key("Space")']
    assert actions(f"result = [{', '.join(presses)}];") == [False] * 4


def test_what_is_held_ends_once_when_its_key_is_released() -> None:
    steps = 'key("KeyT"); key("KeyT", { repeat: true }); actions.keyUp("KeyF"); actions.keyUp("KeyT");'
    assert actions(f'{steps} actions.keyUp("KeyT");') == [["talk", "down"], ["talk", "up"]]


def test_what_is_held_ends_with_a_gesture_and_a_repetition_does_not_begin_it_again() -> None:
    steps = 'key("KeyT"); actions.clear(); key("KeyT", { repeat: true }); actions.keyUp("KeyT"); key("KeyF");'
    assert actions(steps) == [["talk", "down"], ["talk", "up"], ["flash", "down"]]


def test_only_the_speed_is_repeated() -> None:
    steps = 'key("NumpadAdd", { key: "+", repeat: true }); key("KeyF", { repeat: true });'
    assert actions(steps) == [["faster", "down"]]


def test_on_the_fleets_screen_there_is_only_the_help() -> None:
    assert actions('open = false; key("KeyT"); key("KeyF"); seen(pad(), pad(3)); key("Slash", { key: "?" });') == [
        ["help", "down"]
    ]


def test_an_action_that_fails_keeps_nothing_else_from_being_done() -> None:
    steps = """
    const failing = new Actions(() => { throw new Error("no"); });
    process.on("uncaughtException", () => {});
    failing.keyDown({ code: "KeyT", key: "t", repeat: false });
    failing.clear();
    result = "went on";"""
    assert actions(steps) == "went on"


def test_the_buttons_of_a_gamepad_act_when_they_are_pressed() -> None:
    assert actions("seen(pad(), pad(3), pad(3), pad(), pad(4), pad(5), pad(12), pad(13));") == [
        [one, "down"] for one in ("flash", "mute", "repeat", "faster", "slower")
    ]


def test_talking_lasts_as_long_as_its_button_is_held() -> None:
    assert actions("seen(pad(), pad(6), pad(6), pad());") == [["talk", "down"], ["talk", "up"]]


@pytest.mark.parametrize("end", ["seen(null)", "actions.clear()", "seen({ ...pad(6), index: 1 })"])
def test_talking_by_gamepad_ends_with_what_ends_a_gesture(end: str) -> None:
    assert actions(f"seen(pad(), pad(6)); {end}; seen(pad(6), pad(6));") == [["talk", "down"], ["talk", "up"]]


def test_a_button_that_is_pressed_when_a_gamepad_appears_does_nothing() -> None:
    assert actions("seen(pad(3), pad(3), pad(), null, pad(3), pad(3));") == []


def test_while_buttons_are_learned_they_do_nothing() -> None:
    assert actions("actions.padOff = true; seen(pad(), pad(3)); actions.padOff = false; seen(pad(3));") == []


def test_a_mapping_moves_an_action_to_another_button() -> None:
    assert actions("usual.buttons = { flash: 7, mute: -1 }; seen(pad(), pad(3, 4), pad(7));") == [["flash", "down"]]


def test_every_binding_is_in_the_table_once() -> None:
    steps = "result = ACTIONS.map(({ id, keys = [], button }) => [id, keys, button ?? null]);"
    table = actions(steps)
    keys = [key for _, used, _ in table for key in used]
    buttons = [button for _, _, button in table if button is not None]
    assert len(set(keys)) == len(keys)
    assert len(set(buttons)) == len(buttons)
    assert not {8, 9} & set(buttons)
    expected = {"KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE", "KeyF", "KeyM", "KeyP", "KeyT", "Space"}
    assert expected <= set(keys)


def test_keys_are_named_as_they_are_printed() -> None:
    steps = 'const azerty = new Map([["KeyW", "z"]]); result = [keyName("KeyW", azerty), keyName("KeyW"),'
    assert actions(f'{steps} keyName("ArrowUp", azerty), buttonName(3, true), buttonName(3, false)];') == [
        "Z", "W", "↑", "Y", "button 4",
    ]  # fmt: skip


# -- mappings of gamepads

_MAPPING = """
const swapped = { x: { axis: 3, invert: true }, z: { axis: 2, invert: false }, deadZone: 0.2,
  buttons: { auxiliary: 5, stop: 2 } };
const inputs = new Inputs();
const pad = (axes, ...pressed) => ({
  id: "pad", axes, buttons: Array.from({ length: 8 }, (_, i) => ({ pressed: pressed.includes(i) })), timestamp: stamp++,
});
let stamp = 0;
const shown = (mapping, ...pads) => {
  pads.forEach((one, i) => inputs.padSample(one, 50 * i, mapping));
  const { x, z, y } = inputs.pad;
  return [x + 0, z + 0, y + 0];
};
const rest = pad([0, 0, 0, 0]);
"""


def mapping(steps: str) -> Any:
    return evaluate({"core/inputs.js": "Inputs, USUAL", "core/pad-mapping.js": "validMapping"}, _MAPPING + steps)


def test_a_mapping_has_the_axes_and_their_directions() -> None:
    assert mapping("result = shown(swapped, rest, pad([1, 1, 1, 0]));") == [0, 1, 0]
    assert mapping("result = shown(swapped, rest, pad([1, 1, 0, 1]));") == [-1, 0, 0]
    assert mapping("result = shown(swapped, rest, pad([0, 0, 0, -1], 5));") == [0, 0, 1]
    assert mapping("result = shown(swapped, rest, pad([1, -1, 0, 0]));") == [0, 0, 0]
    assert mapping("result = shown(undefined, rest, pad([1, -1, 0, 0]));") == [1, 1, 0]


def test_a_mapping_has_its_own_dead_zone() -> None:
    assert mapping("result = shown(swapped, rest, pad([0, 0, 0.2, 0.2]));") == [0, 0, 0]
    x, z, _ = mapping("result = shown(swapped, rest, pad([0, 0, 0.6, -0.6]));")
    assert (x, z) == (pytest.approx(0.5), pytest.approx(0.5))


def test_axes_and_buttons_that_a_gamepad_does_not_have_do_nothing() -> None:
    assert mapping("result = shown(swapped, pad([]), pad([1, 1]), { ...pad([]), buttons: [] });") == [0, 0, 0]
    assert mapping('result = shown(swapped, rest, pad([0, 0, NaN, "1"]));')[1] == 0


def test_with_another_mapping_a_gamepad_has_to_be_seen_in_neutral_again() -> None:
    steps = "shown(undefined, rest, pad([0, 0, 1, 0])); inputs.clear(); result = shown(swapped, pad([0, 0, 1, 0]));"
    assert mapping(steps) == [0, 0, 0]


def test_a_stored_mapping_is_read_as_it_was_written() -> None:
    steps = "result = [validMapping(JSON.parse(JSON.stringify(swapped))), swapped];"
    read, written = mapping(steps)
    assert read == written


_NO_MAPPINGS = """
null, 7, "x", [], {}, { ...swapped, x: null }, { ...swapped, x: { axis: 1.5 } }, { ...swapped, x: swapped.z },
{ ...swapped, z: { axis: 99 } }, { ...swapped, deadZone: 0 }, { ...swapped, deadZone: 1 },
{ ...swapped, deadZone: null }, { ...swapped, x: { axis: "constructor" } },
"""


def test_what_is_no_mapping_is_the_usual_one() -> None:
    assert mapping(f"result = [{_NO_MAPPINGS}].filter((one) => validMapping(one) !== USUAL);") == []


def test_no_mapping_has_the_buttons_of_the_emergency_stop() -> None:
    steps = """result = [8, 9, 99, -2, 1.5, "1", null, {}].map((index) =>
      validMapping({ ...swapped, buttons: { stop: index, flash: index, talk: -1 } }).buttons);"""
    assert mapping(steps) == [{"stop": 0, "auxiliary": 1, "talk": -1}] * 8


# -- learning a gamepad

_LEARNING = """
const pad = (axes, ...pressed) =>
  ({ axes, buttons: Array.from({ length: 16 }, (_, i) => ({ pressed: pressed.includes(i) })) });
const rest = [0.02, -0.03, 1, 0];
const learning = new Learning(pad(rest));
let now = 0;
const take = (...samples) => samples.forEach((one) => learning.take(one, (now += 50)));
const stay = (one) => take(...Array(14).fill(one));
const still = pad(rest);
const forward = () => take(pad([0.02, -0.03, 1, 0.9]), still);
const right = () => take(pad([-0.9, -0.03, 1, 0]), still);
const press = (...buttons) => buttons.forEach((button) => take(pad(rest, button), still));
"""


def learning(steps: str) -> Any:
    imports = {"core/pad-learning.js": "Learning, STEPS", "core/pad-mapping.js": "validMapping"}
    return evaluate(imports, _LEARNING + steps)


def test_a_gamepad_is_learned_from_what_is_moved() -> None:
    steps = "forward(); right(); press(2, 3, 4, 5); while (learning.step) learning.skip();"
    made = learning(f"{steps} result = learning.mapping(); result.valid = validMapping(result);")
    valid = made.pop("valid")
    assert made == valid
    assert made["z"] == {"axis": 3, "invert": False}
    assert made["x"] == {"axis": 0, "invert": True}
    assert made["deadZone"] == 0.1
    learned = {"stop": 2, "auxiliary": 3, "slower": 4, "faster": 5}
    assert made["buttons"] == {**dict.fromkeys(made["buttons"], -1), **learned}
    assert "talk" in made["buttons"]


def test_a_stick_that_does_not_rest_in_the_middle_gets_a_larger_dead_zone() -> None:
    steps = "rest[3] = 0.2; forward(); right(); while (learning.step) learning.skip(); result = learning.mapping();"
    assert learning(steps)["deadZone"] == 0.25


def test_each_movement_counts_once_and_only_when_it_is_large() -> None:
    steps = "take(pad([0.4, -0.03, 1, 0.5])); result = [learning.at];"
    steps += "take(pad([0, 0, 1, 0.9]), pad([0, 0, 1, 1]), pad([0.9, 0, 1, 1])); result.push(learning.at);"
    assert learning(f"{steps} take(still); right(); result.push(learning.at);") == [0, 1, 2]


@pytest.mark.parametrize(
    ("steps", "problem"),
    [
        ("take(pad([0, 0, -1, 0]));", "This axis does not rest in the middle"),
        ("forward(); take(pad([0, 0, 1, -1]));", "That is the axis that you pushed before"),
        ("forward(); right(); press(8);", "Button 9 and Button 10 together are STOP"),
        ("forward(); right(); press(3, 3);", "That button is taken: Stop for now"),
    ],
)
def test_what_cannot_be_used_is_refused_with_the_reason(steps: str, problem: str) -> None:
    assert learning(f"{steps} result = learning.problem;").startswith(problem)


def test_an_axis_that_rests_outside_of_every_dead_zone_is_refused() -> None:
    steps = "rest[3] = %s; take(pad([0.02, -0.03, 1, 1])); result = learning.problem !== '';"
    assert [learning(steps % at) for at in (0.29, 0.32)] == [False, True]


def test_a_lever_that_is_left_elsewhere_does_not_hold_up_the_next_step() -> None:
    steps = "take(pad([0.02, -0.03, 0.2, 0.9])); stay(pad([0.02, -0.03, 0.2, 0])); result = [learning.released];"
    steps += "take(pad([-0.9, -0.03, 0.2, 0])); take(pad([0.02, 1, 1, 0]), pad([0.02, 1, 1, 0], 3));"
    assert learning(f"{steps} result.push(learning.axes, learning.buttons);") == [
        True, {"z": {"axis": 3, "invert": False}, "x": {"axis": 0, "invert": True}}, {"stop": 3},
    ]  # fmt: skip


def test_a_stick_that_is_held_for_long_still_has_to_be_let_go() -> None:
    steps = "const held = pad([0.02, -0.03, 1, 1]); take(held); stay(held); result = [learning.released];"
    assert learning(f"{steps} take(still); right(); result.push(learning.released, learning.at);") == [False, True, 2]


def test_axes_cannot_be_left_out_and_values_may_be_no_numbers() -> None:
    assert learning("learning.skip(); take(pad([NaN, Infinity, null])); result = learning.at;") == 0


# -- the screen that stays on

_AWAKE = """
globalThis.document = { hidden: false };
let [asked, released, granted] = [0, 0, true];
const locks = { async request() {
  asked += 1;
  if (!granted) throw new Error("the battery is low");
  return { released: false, async release() { this.released = true; released += 1; } };
} };
const awake = new Awake(locks);
"""


def awake(steps: str) -> Any:
    return run("awake.js", "Awake", f"{_AWAKE}{steps}\nresult = [asked, released];")


def test_the_screen_stays_on_from_when_it_is_wanted_until_it_is_not() -> None:
    assert awake("for (const on of [false, true, true, false, false]) await awake.want(on);") == [1, 1]


def test_what_the_browser_has_taken_away_is_asked_for_again_when_the_page_is_seen() -> None:
    steps = "await awake.want(true); awake.lock.released = document.hidden = true; await awake.want(true);"
    assert awake(f"{steps} document.hidden = false; await awake.want(true);") == [2, 0]


def test_what_is_granted_too_late_is_given_back() -> None:
    assert awake("const late = awake.want(true); awake.want(true); await awake.want(false); await late;") == [1, 1]


def test_a_browser_that_refuses_is_asked_again_and_one_that_cannot_is_left_alone() -> None:
    assert awake("granted = false; await awake.want(true); granted = true; await awake.want(true);") == [2, 0]
    assert awake("await new Awake(undefined).want(true);") == [0, 0]
    assert awake("locks.request = () => { throw new Error('denied'); }; await awake.want(true);") == [0, 0]


# -- what is joined to the page later; ``later`` runs what it does each second

_MORE = """
const define = (name, value) => Object.defineProperty(globalThis, name, { value, configurable: true });
let dialog = null;
let later;
let now = 0;
const seen = [];
define("location", { search: given.search, reload: () => seen.push("reload") });
define("document", {
  querySelector: () => dialog, createElement: () => ({}), head: { append() {} }, addEventListener() {},
  documentElement: { toggleAttribute() {} },
});
define("navigator", {});
define("setInterval", (run) => (later = run));
define("fetch", async () => ({ ok: healthy }));
performance.now = () => now;
let healthy = true;
const { install } = await import(given.more);
const driver = { ref: "pebble/robots/goob" };
const panels = { toggle: (name) => seen.push(name) };
const page = { driver, connection: { show() {} }, store: { get: () => undefined }, panels, commands: {} };
install(page);
page.sound = { toggleMute: () => seen.push("mute") };
const key = (code, key = code) => driver.actions.keyDown({ code, key, repeat: false });
const turn = () => new Promise((resolve) => setImmediate(resolve));
"""


def more(steps: str, search: str = "") -> Any:
    given = {"more": (STATIC / "ui" / "more.js").as_uri(), "search": search}
    return evaluate({}, f"{_MORE}{steps}\nawait turn();\nresult ??= seen;", given)


def test_behind_an_open_panel_there_is_only_the_help() -> None:
    assert more('key("KeyM"); dialog = {}; key("KeyM"); key("Slash", "?");') == ["mute", "help"]


def test_a_wall_screen_loads_itself_again_only_from_a_server_that_answers() -> None:
    steps = """page.connection.bye = { why: "" }; healthy = false;
    for (now = 0; now < 20_000; now += 1000) { later(); await turn(); }
    result = seen.length; healthy = true;
    for (; now < 27_000; now += 1000) { later(); await turn(); }
    result = [result, seen];"""
    assert more(steps, "?watch") == [0, ["reload"]]


# -- QR codes, read by OpenCV


def decoded(grid: list[list[int]]) -> str:
    """What OpenCV reads in it, four pixels for each module, with the quiet zone. It does not find all larger ones."""
    pixels = np.pad(255 * (1 - np.array(grid, np.uint8)), 4, constant_values=255)
    text, _, _ = cv2.QRCodeDetector().detectAndDecode(np.kron(pixels, np.ones((4, 4), np.uint8)))
    return str(text)


def codes(*texts: str) -> list[Any]:
    made: list[Any] = run("qr.js", "qrCode, pathOf", f"result = {json.dumps(texts)}.map(qrCode);")
    return made


def test_codes_of_all_lengths_are_read_by_an_independent_decoder() -> None:
    whole = "https://lab-pc.local:8080/r/pebble/robots/" + "goob-9_" * 12
    texts = [whole[:length] for length in (1, 14, 15, 26, 27, 42, 43, 62, 63, 84, 85, 100, 106)]
    made = codes(*texts)
    assert [len(grid) for grid in made] == [21, 21, 25, 25, 29, 29, 33, 33, 37, 37, 41, 41, 41]
    assert [decoded(grid) for grid in made] == texts


def test_a_code_may_have_other_letters_and_is_still_read_when_it_is_dirty() -> None:
    text = "https://münchen.example/r/pebble/robots/ö"
    (grid,) = codes(text)
    assert decoded(grid) == text
    dirty = [list(row) for row in grid]
    for y in range(12, 16):
        dirty[y][14:17] = [0, 0, 0]
    assert decoded(dirty) == text


def test_a_text_that_is_too_long_has_no_code() -> None:
    assert codes("x" * 106, "x" * 107, "ö" * 53, "ö" * 54)[1::2] == [None, None]


def test_the_path_draws_each_dark_module() -> None:
    assert run("qr.js", "pathOf", "result = pathOf([[0, 1], [1, 0]]);") == "M1 0h1v1h-1zM0 1h1v1h-1z"
