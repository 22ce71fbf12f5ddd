"""What keys and gamepads do besides driving, how a gamepad is learned, and QR codes: the pure modules, in Node.js."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from tests.web.in_node import STATIC, Rows, Script, evaluate, rows

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


actions = Script(
    {"core/actions.js": "Actions, ACTIONS, keyName, buttonName"}, _ACTIONS, "await null;\nresult ??= done;"
)


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


# fmt: off
ACTIONS: Rows = {
    "what is held ends once when its key is released": ("""
        key("KeyT"); key("KeyT", { repeat: true }); actions.keyUp("KeyF"); actions.keyUp("KeyT");
        actions.keyUp("KeyT");""", [["talk", "down"], ["talk", "up"]]),
    "what is held ends with a gesture and a repetition does not begin it again": (
        'key("KeyT"); actions.clear(); key("KeyT", { repeat: true }); actions.keyUp("KeyT"); key("KeyF");',
        [["talk", "down"], ["talk", "up"], ["flash", "down"]]),
    "only the speed is repeated":
        ('key("NumpadAdd", { key: "+", repeat: true }); key("KeyF", { repeat: true });', [["faster", "down"]]),
    "on the fleets screen there is only the help": (
        'open = false; key("KeyT"); key("KeyF"); seen(pad(), pad(3)); key("Slash", { key: "?" });',
        [["help", "down"]]),
    "an action that fails keeps nothing else from being done": ("""
        const failing = new Actions(() => { throw new Error("no"); });
        process.on("uncaughtException", () => {});
        failing.keyDown({ code: "KeyT", key: "t", repeat: false });
        failing.clear();
        result = "went on";""", "went on"),
    "the buttons of a gamepad act when they are pressed": (
        "seen(pad(), pad(3), pad(3), pad(), pad(4), pad(5), pad(12), pad(13));",
        [[one, "down"] for one in ("flash", "mute", "repeat", "faster", "slower")]),
    "talking lasts as long as its button is held":
        ("seen(pad(), pad(6), pad(6), pad());", [["talk", "down"], ["talk", "up"]]),
    **{f"talking by gamepad ends with what ends a gesture: {end}": (
        f"seen(pad(), pad(6)); {end}; seen(pad(6), pad(6));", [["talk", "down"], ["talk", "up"]])
        for end in ("seen(null)", "actions.clear()", "seen({ ...pad(6), index: 1 })")},
    "other keys have none":
        ('result = [key("KeyX"), key("Slash", { key: "/" }), key("KeyW"), key("Space")];', [False] * 4),
    "a button that is pressed when a gamepad appears does nothing":
        ("seen(pad(3), pad(3), pad(), null, pad(3), pad(3));", []),
    "while buttons are learned they do nothing":
        ("actions.padOff = true; seen(pad(), pad(3)); actions.padOff = false; seen(pad(3));", []),
    "a mapping moves an action to another button":
        ("usual.buttons = { flash: 7, mute: -1 }; seen(pad(), pad(3, 4), pad(7));", [["flash", "down"]]),
    "keys are named as they are printed": ("""
        const azerty = new Map([["KeyW", "z"]]); result = [keyName("KeyW", azerty), keyName("KeyW"),
        keyName("ArrowUp", azerty), buttonName(3, true), buttonName(3, false)];""", ["Z", "W", "↑", "Y", "button 4"]),
}
# fmt: on


def test_every_binding_is_in_the_table_once() -> None:
    steps = "result = ACTIONS.map(({ id, keys = [], button }) => [id, keys, button ?? null]);"
    table = actions(steps)
    keys = [key for _, used, _ in table for key in used]
    buttons = [button for _, _, button in table if button is not None]
    assert (len(set(keys)), len(set(buttons))) == (len(keys), len(buttons))
    assert not {8, 9} & set(buttons)
    expected = {"KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE", "KeyF", "KeyM", "KeyP", "KeyT", "Space"}
    assert expected <= set(keys)


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


mapping = Script({"core/inputs.js": "Inputs, USUAL", "core/pad-mapping.js": "validMapping"}, _MAPPING)


# fmt: off
MAPPING: Rows = {
    **{f"a mapping has the axes and their directions: {pushed}": (
        f"result = shown(swapped, rest, pad({pushed}));", seen)
        for pushed, seen in {
            "[1, 1, 1, 0]": [0, 1, 0], "[1, 1, 0, 1]": [-1, 0, 0], "[0, 0, 0, -1], 5": [0, 0, 1],
            "[1, -1, 0, 0]": [0, 0, 0],
            "[0, 0, 0.2, 0.2]": [0, 0, 0],  # within its own dead zone
            "[0, 0, 0.6, -0.6]": [pytest.approx(0.5), pytest.approx(0.5), 0],
        }.items()},
    "without a mapping it has the usual axes": ("result = shown(undefined, rest, pad([1, -1, 0, 0]));", [1, 1, 0]),
    "axes and buttons that a gamepad does not have do nothing":
        ("result = shown(swapped, pad([]), pad([1, 1]), { ...pad([]), buttons: [] });", [0, 0, 0]),
    "axes that are no numbers do nothing":
        ('result = shown(swapped, rest, pad([0, 0, NaN, "1"]))[1];', 0),
    "a stored mapping is read as it was written": (
        "result = validMapping(JSON.parse(JSON.stringify(swapped)));",
        {"x": {"axis": 3, "invert": True}, "z": {"axis": 2, "invert": False}, "deadZone": 0.2,
         "buttons": {"auxiliary": 5, "stop": 2}}),
    "what is no mapping is the usual one": ("""
        result = [
          null, 7, "x", [], {}, { ...swapped, x: null }, { ...swapped, x: { axis: 1.5 } },
          { ...swapped, x: swapped.z }, { ...swapped, z: { axis: 99 } }, { ...swapped, deadZone: 0 },
          { ...swapped, deadZone: 1 }, { ...swapped, deadZone: null }, { ...swapped, x: { axis: "constructor" } },
        ].filter((one) => validMapping(one) !== USUAL);""", []),
    "with another mapping a gamepad has to be seen in neutral again": (
        "shown(undefined, rest, pad([0, 0, 1, 0])); inputs.clear(); result = shown(swapped, pad([0, 0, 1, 0]));",
        [0, 0, 0]),
    "no mapping has the buttons of the emergency stop": ("""
        result = [8, 9, 99, -2, 1.5, "1", null, {}].map((index) =>
        validMapping({ ...swapped, buttons: { stop: index, flash: index, talk: -1 } }).buttons);""",
        [{"stop": 0, "auxiliary": 1, "talk": -1}] * 8),
}
# fmt: on


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


learning = Script({"core/pad-learning.js": "Learning", "core/pad-mapping.js": "validMapping"}, _LEARNING)


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


# fmt: off
LEARNING: Rows = {
    "a stick that does not rest in the middle gets a larger dead zone": ("""
        rest[3] = 0.2; forward(); right(); while (learning.step) learning.skip();
        result = learning.mapping().deadZone;""", 0.25),
    **{f"what cannot be used is refused: {problem}": (
        f"{steps} result = learning.problem.slice(0, {len(problem)});", problem)
        for steps, problem in {
            "take(pad([0, 0, -1, 0]));": "This axis does not rest in the middle",
            "forward(); take(pad([0, 0, 1, -1]));": "That is the axis that you pushed before",
            "forward(); right(); press(8);": "Button 9 and Button 10 together are STOP",
            "forward(); right(); press(3, 3);": "That button is taken: Stop for now",
        }.items()},
    **{f"an axis that rests at {at} is refused: {refused}": (
        f"rest[3] = {at}; take(pad([0.02, -0.03, 1, 1])); result = learning.problem !== '';", refused)
        for at, refused in ((0.29, False), (0.32, True))},
    "each movement counts once and only when it is large": ("""
        take(pad([0.4, -0.03, 1, 0.5])); result = [learning.at];
        take(pad([0, 0, 1, 0.9]), pad([0, 0, 1, 1]), pad([0.9, 0, 1, 1])); result.push(learning.at);
        take(still); right(); result.push(learning.at);""", [0, 1, 2]),
    "a lever that is left elsewhere does not hold up the next step": ("""
        take(pad([0.02, -0.03, 0.2, 0.9])); stay(pad([0.02, -0.03, 0.2, 0])); result = [learning.released];
        take(pad([-0.9, -0.03, 0.2, 0])); take(pad([0.02, 1, 1, 0]), pad([0.02, 1, 1, 0], 3));
        result.push(learning.axes, learning.buttons);""",
        [True, {"z": {"axis": 3, "invert": False}, "x": {"axis": 0, "invert": True}}, {"stop": 3}]),
    "a stick that is held for long still has to be let go": ("""
        const held = pad([0.02, -0.03, 1, 1]); take(held); stay(held); result = [learning.released]; take(still);
        right(); result.push(learning.released, learning.at);""", [False, True, 2]),
    "axes cannot be left out and values may be no numbers":
        ("learning.skip(); take(pad([NaN, Infinity, null])); result = learning.at;", 0),
}
# fmt: on


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


awake = Script({"core/awake.js": "Awake"}, _AWAKE, "result = [asked, released];")


# fmt: off
AWAKE: Rows = {
    "the screen stays on from when it is wanted until it is not":
        ("for (const on of [false, true, true, false, false]) await awake.want(on);", [1, 1]),
    "what the browser has taken away is asked for again when the page is seen": ("""
        await awake.want(true); awake.lock.released = document.hidden = true; await awake.want(true);
        document.hidden = false; await awake.want(true);""", [2, 0]),
    "what is granted too late is given back":
        ("const late = awake.want(true); awake.want(true); await awake.want(false); await late;", [1, 1]),
    "a browser that refuses is asked again":
        ("granted = false; await awake.want(true); granted = true; await awake.want(true);", [2, 0]),
    "a browser that cannot is left alone":
        ("await new Awake(undefined).want(true);", [0, 0]),
    "a browser that fails is left alone":
        ("locks.request = () => { throw new Error('denied'); }; await awake.want(true);", [0, 0]),
}
# fmt: on


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
    made: list[Any] = evaluate({"core/qr.js": "qrCode"}, "result = given.map(qrCode);", texts)
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


@rows((actions, ACTIONS), (mapping, MAPPING), (learning, LEARNING), (awake, AWAKE))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
