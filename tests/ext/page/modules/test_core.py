"""Gestures, inputs, the reasons why a control is off, and what else keys and gamepads do; in Node.js."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from pebble.extensions.operator.client.drive_reasons import WORDS
from tests.ext.page.in_node import STATIC, Rows, Script, evaluate, rows

# -- gestures: what is sent is listed as [gesture, sum of the axes, final]; all but z are 0

_GESTURE = """
const sent = [];
const gesture = new Gesture(({ g, x, z, y, final }) => sent.push([g, x + z + y, final]));
let now = 1000;
const at = (z) => ({ x: 0, z, y: 0 });
const step = (z, { wait = 50, allowed = true, neutral, waits } = {}) =>
  gesture.update(at(z), allowed, (now += wait), neutral ?? z === 0, waits);
const quiet = (times) => { for (let i = 0; i < times; i += 1) step(0); };
"""


gesture = Script({"core/gesture.js": "Gesture"}, _GESTURE, "result ??= sent;")


# fmt: off
GESTURE: Rows = {
    "a gesture is sent every 50 ms and its end three times": (
        "step(0.5); step(0.5); step(0); quiet(5);",
        [[1, 0.5, False], [1, 0.5, False], [1, 0, False], [1, 0, False], [1, 0, False]]),
    "a change is sent sooner but not at once after another":
        ("step(0.5); step(0.6, { wait: 10 }); step(0.7, { wait: 15 });", [[1, 0.5, False], [1, 0.7, False]]),
    "an interruption is final": (
        "step(0.5); gesture.interrupt(now); step(0.5); step(0.5); result = sent.slice(1);", [[1, 0, True]] * 3),
    "an interruption holds until everything is released": (
        "step(0.5); gesture.interrupt(now); step(0.5); step(0.5); step(0); sent.length = 0; step(0.5);",
        [[2, 0.5, False]]),
    "the next gesture ends the repetitions": (
        "step(0.5); step(0); step(0.5); step(0.5); result = sent.slice(2);", [[2, 0.5, False], [2, 0.5, False]]),
    "what is not allowed interrupts": (
        "step(0.5); step(0.5, { allowed: false }); step(0.5, { wait: 500 }); result = sent.slice(0, 2);",
        [[1, 0.5, False], [1, 0, True]]),
    "what was held before it was allowed moves nothing":
        ("step(0.5, { allowed: false }); step(0.5); step(0.5); result = [sent, gesture.mustRelease];", [[], True]),
    "a page that stood still ends its gesture": (
        "step(0.5); step(0.5, { wait: 251 }); result = [sent, gesture.active];",
        [[[1, 0.5, False], [1, 0, True]], False]),
    "a zero that is repeated late would stop another driver":
        ("step(0.5); step(0); sent.length = 0; step(0, { wait: 1000 });", []),
    "opposite keys are no release":
        ("gesture.interrupt(now); step(0, { neutral: false }); step(0.5); result = sent;", []),
    "what waits to be released begins nothing": ("step(0.5, { waits: true }); step(0.5); result = sent;", []),
    "a refused gesture is over and sends nothing more":
        ("step(0.5); gesture.refused(1); step(0.5); step(0.5);", [[1, 0.5, False]]),
    "a refusal of an earlier gesture changes nothing":
        ("step(0.5); step(0); step(0.5); gesture.refused(1); result = gesture.active;", True),
    "a new connection counts from the beginning and needs a release":
        ("step(0.5); gesture.reset(); step(0.5); step(0); step(0.5); result = sent.slice(1);", [[1, 0.5, False]]),
}
# fmt: on


# -- inputs

_INPUTS = """
const inputs = new Inputs();
const full = { speed: 1, turn: 1, balance: 0 };
const vector = (sliders = full) => { const { x, z, y } = inputs.vector(sliders); return [x + 0, z + 0, y + 0]; };
const pad = (x, z, timestamp = 1) => ({ id: "pad", axes: [x, -z], buttons: [], timestamp });
const seen = (...pads) => pads.forEach((one, i) => inputs.padSample(one, 1000 + 50 * i));
"""


inputs = Script({"core/inputs.js": "Inputs, balanced"}, _INPUTS)


#: Keys that are held, and what they ask for.
KEYS = {
    "KeyW": [0, 1, 0],
    "KeyA": [-1, 0, 0],
    "KeyD": [1, 0, 0],
    "ArrowUp": [0, 1, 0],
    "ArrowDown": [0, -1, 0],
    "ArrowLeft": [-1, 0, 0],
    "ArrowRight": [1, 0, 0],
    "KeyW KeyS": [0, 0, 0],
    "KeyW KeyD": [0.5, 0.5, 0],
    "KeyE": [0, 0, -1],
    "KeyX": [0, 0, 0],
}
# fmt: off
INPUTS: Rows = {
    **{keys: (f"'{keys}'.split(' ').forEach((one) => inputs.keyDown(one)); result = vector();", expected)
        for keys, expected in KEYS.items()},
    **{f"a gamepad has to be seen in neutral again after {one}": (
        f"seen(pad(0, 0), pad(0, 1, 2)); {one}; seen(pad(0, 1, 3)); result = vector();", [0, 0, 0])
        for one in ("inputs.clear()", "seen(null)")},
    "sliders scale and balance": ("""
        inputs.keyDown("KeyW", false); result = [vector({ speed: 0.5, turn: 1, balance: 0 })];
        result.push(vector({ speed: 1, turn: 1, balance: -1 })); inputs.leave();
        inputs.keyDown("KeyD", false); result.push(vector({ speed: 0, turn: 0.5, balance: 0 }));""",
        [[0, 0.5, 0], [-0.5, 0.5, 0], [0.5, 0, 0]]),
    "no wheel is asked for more than full speed": ("""
        let most = 0;
        for (let x = -1; x <= 1; x += 0.25) for (let z = -1; z <= 1; z += 0.25) for (let b = -1; b <= 1; b += 0.5) {
          const one = balanced(x, z, b);
          most = Math.max(most, Math.abs(one.x + one.z), Math.abs(one.z - one.x));
        }
        result = most <= 1 + 1e-9;""", True),
    "a repeated key moves nothing and waits to be released": ("""
        inputs.keyDown("KeyW", true); result = [vector(), inputs.neutral];
        inputs.keyUp("KeyW"); result.push(inputs.neutral);""", [[0, 0, 0], False, True]),
    "what was interrupted counts after it was released": ("""
        inputs.keyDown("KeyW", false); inputs.clear(); inputs.keyDown("KeyW", true);
        result = [vector(), inputs.neutral];
        inputs.keyUp("KeyW"); inputs.keyDown("KeyW", false);
        result.push(vector());""", [[0, 0, 0], False, [0, 1, 0]]),
    "a release that was lost does not wait for ever": ("""
        inputs.keyDown("KeyW", false); inputs.clear();
        inputs.keyDown("KeyD", false); inputs.keyUp("KeyD");
        result = inputs.neutral;""", True),
    "when the window has lost the keyboard nothing waits":
        ('inputs.keyDown("KeyW", false); inputs.leave(); result = [inputs.neutral, vector()];', [True, [0, 0, 0]]),
    "the stick belongs to one finger": ("result = [inputs.stickStart(1), inputs.stickStart(2)];", [True, False]),
    "the stick stays in its circle and rests in the middle": ("""
        inputs.stickStart(1); inputs.stickMove(3, 4); result = [Math.hypot(inputs.stick.x, inputs.stick.z) < 1];
        inputs.stickMove(0.05, -0.09); result.push(vector());
        inputs.stickMove(0, 1); result.push(vector()); inputs.stickEnd(); result.push(vector());""",
        [True, [0, 0, 0], [0, 1, 0], [0, 0, 0]]),
    "a finger that rests on the stick is no release": ("""
        inputs.stickStart(1); inputs.stickMove(0, 0); result = [inputs.neutral];
        inputs.stickEnd(); result.push(inputs.neutral);""", [False, True]),
    "a button moves the auxiliary axis while it is held": (
        'inputs.hold("up", 1); result = [vector()]; inputs.hold("up", 0); result.push(vector());',
        [[0, 0, 1], [0, 0, 0]]),
    "a gamepad whose time stands still is not believed for long": ("""
        inputs.padSample(pad(0, 0), 0); inputs.padSample(pad(0, 1, 2), 50);
        inputs.padSample(pad(0, 1, 2), 3000); result = [vector(), inputs.padFrozen];
        inputs.padSample(pad(0, 1, 2), 3100); result.push(vector(), inputs.padFrozen);
        inputs.padSample(pad(0, 1, 3), 3150); result.push(vector());
        inputs.padSample(pad(0, 0, 4), 3200); inputs.padSample(pad(0, 1, 5), 3250);
        result.push(vector(), inputs.padFrozen);""", [[0, 1, 0], False, [0, 0, 0], True, [0, 0, 0], [0, 1, 0], False]),
    "a gamepad that never was in neutral is no frozen one": ("""
        inputs.padSample(pad(0, 1), 0); inputs.padSample(pad(0, 1), 10_000);
        result = [vector(), inputs.padFrozen];""", [[0, 0, 0], False]),
    "keys and gamepad need the focus and the stick does not": ("""
        inputs.stickStart(1); inputs.stickMove(0, 1); result = [inputs.fromKeys];
        inputs.keyDown("KeyW", false); result.push(inputs.fromKeys); inputs.keyUp("KeyW");
        seen(pad(0, 0), pad(0, 1, 2)); result.push(inputs.fromKeys);""", [False, True, True]),
}
# fmt: on


# -- reasons, in their order

#: Everything is wrong at once; each line mends what the reason before it was about.
_SITUATION = """
const situation = {
  name: "goob", open: false, broker: "refused", reload: true, drives: false, rights: [], hidden: true, focus: false,
  dialog: true,
  fromKeys: true, liveness: { online: false, silent_s: 12.3 }, estop: { latched: true, by: "eve" }, freeForMs: 100,
  capabilities: {}, driver: { by: "bob", device: "phone", you: false },
  script: { running: true, file: "april-follow" }, pictureAgeMs: 2400, inSight: false, roundTripMs: 640,
  padFrozen: true, mustRelease: true,
};
const mends = [
  {}, { open: true }, { broker: "" }, { reload: false }, { drives: true }, { rights: ["drive"] }, { hidden: false },
  { liveness: { online: true, silent_s: 0 } }, { estop: { latched: false, by: "" } }, { freeForMs: Infinity },
  { capabilities: { drive: { available: true } } }, { driver: undefined }, { driver: { you: true, by: "anna" } },
  { dialog: false },
  { script: undefined }, { inSight: true }, { roundTripMs: 4 }, { padFrozen: false }, { focus: true },
  { refusal: "Commands are late" }, { mustRelease: false },
];
"""


#: Afterwards all is well.
_ALL = f"""situation.words = {json.dumps(WORDS)};
const all = mends.map((mend) => driveReason(Object.assign(situation, mend)));"""
reasons = Script({"core/reasons.js": "driveReason"}, _SITUATION + _ALL)
#: What is different while all is well, and why it is off then.
LIMITS = {
    "{ liveness: { online: null, silent_s: null } }": None,
    "{ liveness: undefined }": "silent",
    "{ capabilities: { drive: { available: true, controls: false } } }": "no-drive",
    "{ loading: true }": "loading",
    "{ pictureAgeMs: null, inSight: false }": None,
    "{ pictureAgeMs: Infinity, inSight: false }": "picture",
    "{ pictureAgeMs: -1, inSight: false }": "picture",
    "{ focus: false, fromKeys: false }": None,
}
#: Of a driver and of further rights: why it is off, and what is offered.
KEPT = {
    ("{}", "[]"): ["lease", "bob (phone) has control", "ask", None],
    ("{ asking: true }", "['take']"): ["asked", "bob (phone) is asked for control", "give-up", "take-over"],
    ("{ by: '', device: '', asking: true }", "['take']"): ["free", "Take control to drive", "take", None],
}
#: Of a script that runs.
DRIVES = {
    "file: 'april-follow', label: 'Follow a tag'": "Follow a tag is driving: stop it first",
    "file: 'x'.repeat(1000)": f"{'x' * 40} is driving: stop it first",
    "file: 'wheel-odometry', drives: false": None,
}
STOPS = {"label": "Stop script", "kind": "stop-script"}
# fmt: off
REASONS: Rows = {
    "the first reason counts": ("result = all.map((one) => one?.code ?? null);", [
        "server", "broker", "reload", "plain", "role", "hidden", "silent", "stopped", "reset", "no-drive", "lease",
        "itself", "dialog", "script", "picture", "late", "pad", "focus", "release", "release", None]),
    "a reason says more where that helps": (
        "result = [6, 10, 14, 15, 19].map((at) => all[at].text);",
        ["goob is silent for 12 s", "bob (phone) is driving", "The picture is 2.4 s old", "Commands are late (640 ms)",
         "Let go first. It was: Commands are late"]),
    "what can be done against a reason": (
        "result = Object.fromEntries(all.filter((one) => one?.action).map(({ code, action }) => [code, action.kind]));",
        {"reload": "reload", "role": "login", "lease": "take-over", "itself": "take", "picture": "see",
         "script": "stop-script"}),
    **{f"limits of reasons: {change}": (
        f"result = driveReason({{ ...situation, ...{change} }})?.code ?? null;", code)
        for change, code in LIMITS.items()},
    **{f"who drives a robot that keeps control is asked: {change} {rights}": (f"""
        const driver = {{ by: "bob", device: "phone", you: false, keeps: true, ...{change} }};
        const found = driveReason({{ ...situation, driver, rights: ["drive", ...{rights}] }});
        result = [found.code, found.text, found.action.kind, found.also?.kind ?? null];""", expected)
        for (change, rights), expected in KEPT.items()},
    **{f"a script that drives can be stopped: {script}": (
        f"result = driveReason({{ ...situation, script: {{ running: true, {script} }} }});",
        text and {"code": "script", "text": text, "action": STOPS}) for script, text in DRIVES.items()},
}
# fmt: on


# -- whose it is


def test_a_stop_has_an_id_and_by_request_the_name_of_the_person_also_if_the_page_is_left() -> None:
    steps = """
      const asked = [], reached = [];
      const answers = [() => ({ ok: true }), () => ({ ok: false }), () => { throw new Error("no connection"); }];
      globalThis.fetch = async (...request) => (asked.push(request), answers.shift()());
      for (const isSent of [true, false, false, false]) {
        const estop = new Estop({ send: () => isSent, you: { user: "Ann & Bo" } });
        estop.press("pebble/robots/goob");
        reached.push([/^[0-9a-f]{16}$/.test(estop.pressed.stop), estop.pressed.reached]);
        await new Promise((resolve) => setImmediate(resolve));
        reached.at(-1).push(estop.pressed.reached);
      }
      const [[url, { keepalive }]] = asked;
      result = [url.replace(ROOT, "/"), keepalive, reached];
    """
    assert evaluate({"core/estop.js": "Estop", "core/browser.js": "ROOT"}, steps) == [
        "/api/estop?name=Ann%20%26%20Bo",
        True,
        [[True, True, True], [True, False, True], [True, False, False], [True, False, False]],
    ]


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
    'key("Minus", { key: "?" })': "help",  # on a German keyboard
    'key("KeyM", { key: "?" })': "help",  # on a French keyboard
    'key("KeyM", { key: "," })': "mute",  # there, too
}
# fmt: off
ACTIONS: Rows = {
    "what is not held is done each time": ('key("KeyF"); key("KeyF");', [["flash", "down"]] * 2),
    "only the speed is repeated":
        ('key("NumpadAdd", { key: "+", repeat: true }); key("KeyF", { repeat: true });', [["faster", "down"]]),
    "keys are named as they are printed": ("""
        const azerty = new Map([["KeyW", "z"]]); result = [keyName("KeyW", azerty), keyName("KeyW"),
        keyName("ArrowUp", azerty), buttonName(3, true), buttonName(3, false)];""", ["Z", "W", "↑", "Y", "button 4"]),
    **{f"what {press} does": (press, [[action, "down"]]) for press, action in PRESSES.items()},
    "what is held ends with a gesture and a repetition does not begin it again": (
        'key("KeyT"); actions.clear(); key("KeyT", { repeat: true }); actions.keyUp("KeyT"); key("KeyF");',
        [["talk", "down"], ["talk", "up"], ["flash", "down"]]),
    "on the fleets screen there is only the help": (
        'open = false; key("KeyT"); key("KeyF"); seen(pad(), pad(3)); key("Slash", { key: "?" });',
        [["help", "down"]]),
    "an action that fails keeps nothing else from being done": ("""
        const failing = new Actions(() => { throw new Error("no"); });
        process.on("uncaughtException", () => {});
        failing.keyDown({ code: "KeyT", key: "t", repeat: false });
        failing.clear();
        result = "went on";""", "went on"),
    "talking lasts as long as its button is held":
        ("seen(pad(), pad(6), pad(6), pad());", [["talk", "down"], ["talk", "up"]]),
    **{f"talking by gamepad ends with what ends a gesture: {end}": (
        f"seen(pad(), pad(6)); {end}; seen(pad(6), pad(6));", [["talk", "down"], ["talk", "up"]])
        for end in ("seen(null)", "actions.clear()", "seen({ ...pad(6), index: 1 })")},
    "a button that is pressed when a gamepad appears does nothing":
        ("seen(pad(3), pad(3), pad(), null, pad(3), pad(3));", []),
    "every binding is in the table once, and none is a stop's": ("""
        const keys = ACTIONS.flatMap((one) => one.keys ?? []), buttons = ACTIONS.flatMap((one) => one.button ?? []);
        result = [new Set(keys).size - keys.length, new Set([...buttons, 8, 9]).size - buttons.length];""", [0, 2]),
}
# fmt: on


# -- what browsers lack, deny or take away

denying = Script({"core/browser.js": "fullScreen, local", "core/browser-more.js": "isLoopback, microphone"})
HERE = ["127.0.0.1", "0.0.0.0", "[::1]", "[::]", "localhost", "robots.localhost"]
# fmt: off
DENYING: Rows = {
    "what it does not keep is remembered until the page is left": ("""
        const kept = new Map(), setItem = (key, text) => text.length < 9 && kept.set(key, text);
        globalThis.localStorage = { setItem, getItem: (key) => kept.get(key) ?? null };
        result = ["short", "very long", "anew"].map((text) => [local.set("a", text), local.get("a")]);""",
        [[True, "short"], [False, "very long"], [True, "anew"]]),
    "what it denies is not offered": (
        "result = [fullScreen.possible, fullScreen.on, microphone.possible];", [False] * 3),
    "no other machine reaches some addresses": (
        f"result = {[*HERE, '192.168.1.7', '127.0.0.1.nip.io', '[fd00::1]']}.map(isLoopback);",
        [True] * len(HERE) + [False] * 3),
}
# fmt: on


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
            "[0, 0, 0.15, 0.15]": [0, 0, 0],  # within the dead zone
            "[0, 0, 0.575, -0.575]": [pytest.approx(0.5), pytest.approx(0.5), 0],
        }.items()},
    "axes that are no numbers are none": ('result = seen(pad([0, 0, NaN, "1"]));', []),
}
# fmt: on


# -- what is joined to the page later; ``later`` runs what it does each second

_MORE = """
const define = (name, value) => Object.defineProperty(globalThis, name, { value, configurable: true });
let dialog = null;
let later;
const seen = [];
define("location", { search: "" });
define("document", {
  querySelector: () => dialog, createElement: () => ({}), head: { append() {} }, addEventListener() {},
  documentElement: { toggleAttribute() {} },
});
const lock = { released: false, release() { seen.push("off"); this.released = true; } };
const request = async () => (seen.push("on"), Object.assign(lock, { released: false }));
define("navigator", { wakeLock: { request } });
define("setInterval", (run) => (later = run));
define("fetch", async () => seen.push("reload"));
const driver = { ref: "pebble/robots/goob", lease: {}, sliders: { speed: 0.5 }, changed() {}, onChange() {} };
const panels = { toggle: (name) => seen.push(name) };
const connection = { isOpen: true, show() {}, socket: { send: () => false } };
const page = { driver, connection, store: { get: () => undefined }, panels, commands: {} };
const key = (code, key = code) => driver.actions.keyDown({ code, key, repeat: false });
const turn = () => new Promise((resolve) => setImmediate(resolve));
"""
_INSTALL = f"""
const {{ install }} = await import("{(STATIC / "ui" / "more.js").as_uri()}");
install(page);
page.sound.model = {{ toggleMute: () => seen.push("mute") }};
"""


more = Script({}, _MORE + _INSTALL, "await turn();\nresult = seen;")


# fmt: off
MORE: Rows = {
    "behind an open panel there is only the help":
        ('key("KeyM"); dialog = {}; key("KeyM"); key("Slash", "?");', ["mute", "help"]),
    "the screen stays on while this page has control": ("""
        let you = false; page.store.get = () => ({ value: { you } });
        for (you of [false, true, true, false, false, true]) { later(); await turn(); }
        lock.released = true; later();""", ["on", "off", "on", "on"]),
    "keys change the speed": ("""
        for (const [code, times] of [["NumpadAdd", 1], ["NumpadAdd", 9], ["Minus", 1], ["Minus", 9]]) {
          for (let n = 0; n < times; n++) key(code, code === "Minus" ? "-" : "+");
          await turn(); seen.push(driver.sliders.speed);
        }""", [0.6, 1, 0.9, 0.05]),
    "a page that a person uses is not loaded anew by itself": (
        "connection.isOld = true; for (const now of [1e6, 2e6]) { performance.now = () => now; later(); }", []),
}
# fmt: on


@rows(
    (gesture, GESTURE), (inputs, INPUTS), (reasons, REASONS), (actions, ACTIONS), (denying, DENYING),
    (mapping, MAPPING), (more, MORE),
)  # fmt: skip
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
