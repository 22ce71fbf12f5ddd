"""What keys and gamepads do besides driving: the pure modules, in Node.js."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.ext.page.in_node import STATIC, Rows, Script, evaluate, rows

# -- actions: what is done is listed as [action, phase]

_ACTIONS = """
const done = [];
let open = true;
const actions = new Actions((id, phase) => done.push([id, phase]), () => open);
const usual = { x: { axis: 0, invert: false }, z: { axis: 1, invert: true }, buttons: {} };
const key = (code, { key = code, repeat = false } = {}) => actions.keyDown({ code, key, repeat });
const pad = (...pressed) => ({
  id: "pad", index: 0, axes: [0, 0], buttons: Array.from({ length: 16 }, (_, i) => ({ pressed: pressed.includes(i) })),
});
const seen = (...pads) => pads.forEach((one) => actions.padSample(one, usual));
"""


actions = Script(
    {"core/actions.js": "Actions, ACTIONS, keyName, buttonName"}, _ACTIONS, "await null;\nresult ??= done;"
)


#: What is pressed, and the action.
PRESSES = {
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
# fmt: off
ACTIONS: Rows = {
    **{f"what {press} does": (press, [[action, "down"]]) for press, action in PRESSES.items()},
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
const swapped = { x: { axis: 3, invert: true }, z: { axis: 2, invert: false }, buttons: { auxiliary: 5, stop: 2 } };
const pad = (axes, ...pressed) =>
  ({ axes, buttons: Array.from({ length: 8 }, (_, i) => ({ pressed: pressed.includes(i) })) });
const seen = (pad, mapping = swapped) => Object.values(padVector(pad, mapping) ?? {});
"""


mapping = Script({"core/inputs.js": "USUAL, padVector"}, _MAPPING)


# fmt: off
MAPPING: Rows = {
    **{f"a mapping has the axes and their directions: {pushed}": (f"result = seen(pad({pushed}));", expected)
        for pushed, expected in {
            "[1, 1, 1, 0]": [0, 1, 0], "[1, 1, 0, 1]": [-1, 0, 0], "[0, 0, 0, -1], 5": [0, 0, 1],
            "[1, -1, 0, 0]": [0, 0, 0],
            "[0, 0, 0.15, 0.15]": [0, 0, 0],  # within the dead zone
            "[0, 0, 0.575, -0.575]": [pytest.approx(0.5), pytest.approx(0.5), 0],
        }.items()},
    "the usual one has the first two axes": ("result = seen(pad([1, -1, 0, 0]), USUAL);", [1, 1, 0]),
    "axes that a gamepad does not have are none": ("result = seen(pad([1, 1]));", []),
    "axes that are no numbers are none": ('result = seen(pad([0, 0, NaN, "1"]));', []),
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
const lock = { released: false, release() { seen.push("off"); this.released = true; } };
const request = async () => (seen.push("on"), Object.assign(lock, { released: false }));
define("navigator", { wakeLock: { request } });
define("setInterval", (run) => (later = run));
define("fetch", async () => ({ ok: healthy }));
performance.now = () => now;
let healthy = true;
const { install } = await import(given.more);
const driver = { ref: "pebble/robots/goob", lease: {}, onChange() {} };
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


def test_the_screen_stays_on_while_this_page_has_control() -> None:
    steps = """page.connection.isOpen = true; let you = false; page.store.get = () => ({ value: { you } });
    for (you of [false, true, true, false, false, true]) { later(); await turn(); }
    lock.released = true; later(); await turn();"""
    assert more(steps) == ["on", "off", "on", "on"]


def test_a_wall_screen_loads_itself_again_only_from_a_server_that_answers() -> None:
    steps = """page.connection.bye = { why: "" }; healthy = false;
    for (now = 0; now < 20_000; now += 1000) { later(); await turn(); }
    result = seen.length; healthy = true;
    for (; now < 27_000; now += 1000) { later(); await turn(); }
    result = [result, seen];"""
    assert more(steps, "?watch") == [1, ["on", "reload"]]


@rows((actions, ACTIONS), (mapping, MAPPING))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
