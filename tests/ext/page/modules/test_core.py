"""The page's driving modules: gestures, inputs, and the reasons why a control is off; in Node.js."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from pebble.extensions.operator.client.drive_reasons import WORDS
from tests.ext.page.in_node import STATIC, Rows, Script, evaluate, rows

# -- gestures: what is sent is listed as [gesture, z, final]

_GESTURE = """
const sent = [];
const gesture = new Gesture(({ g, z, final }) => sent.push([g, z, final]));
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
    "without a gesture nothing is sent": ("quiet(20);", []),
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
const pad = (x, z, timestamp = 1, buttons = []) =>
  ({ id: "pad", axes: [x, -z], buttons: [0, 1].map((i) => ({ pressed: buttons.includes(i) })), timestamp });
const seen = (...pads) => pads.forEach((one, i) => inputs.padSample(one, 1000 + 50 * i));
"""


inputs = Script({"core/inputs.js": "Inputs, balanced"}, _INPUTS)


#: Keys that are held, and what they ask for.
KEYS = {
    "KeyW": [0, 1, 0],
    "ArrowDown": [0, -1, 0],
    "KeyA": [-1, 0, 0],
    "ArrowRight": [1, 0, 0],
    "KeyW ArrowUp": [0, 1, 0],
    "KeyW KeyS": [0, 0, 0],
    "KeyW KeyD": [0.5, 0.5, 0],
    "KeyQ": [0, 0, 1],
    "KeyE": [0, 0, -1],
    "KeyX": [0, 0, 0],
}
INTERRUPTIONS = "inputs.clear()", "inputs.leave()", "inputs.padGone()", "seen(null)"
# fmt: off
INPUTS: Rows = {
    **{keys: (f"'{keys}'.split(' ').forEach((one) => inputs.keyDown(one)); result = vector();", expected)
        for keys, expected in KEYS.items()},
    **{f"a gamepad has to be seen in neutral again after {one}": (
        f"seen(pad(0, 0), pad(0, 1, 2)); {one}; seen(pad(0, 1, 3)); result = vector();", [0, 0, 0])
        for one in INTERRUPTIONS},
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
    "a gamepad counts after it was seen in neutral": (
        "seen(pad(0, 1)); result = [vector()]; seen(pad(0, 0, 2), pad(0, 1, 3)); result.push(vector());",
        [[0, 0, 0], [0, 1, 0]]),
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
    "the second button of a gamepad chooses the auxiliary axis":
        ("seen(pad(0, 0), pad(-1, 0, 2, [1])); result = vector();", [0, 0, -1]),
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


reasons = Script({"core/reasons.js": "driveReason, offReason"}, _SITUATION + f"situation.words = {json.dumps(WORDS)};")


def test_the_first_reason_counts() -> None:
    found = reasons("result = mends.map((mend) => driveReason(Object.assign(situation, mend)));")
    assert [None if one is None else one["code"] for one in found] == [
        "server", "broker", "reload", "plain", "role", "hidden", "silent", "stopped", "reset", "no-drive", "lease",
        "itself", "dialog", "script", "picture", "late", "pad", "focus", "release", "release", None,
    ]  # fmt: skip
    texts = {
        "server": "No connection to the server",
        "silent": "goob is silent for 12 s",
        "stopped": "Stopped by eve",
        "lease": "bob (phone) is driving",
        "itself": "Take control to drive",
        "picture": "The picture is 2.4 s old",
        "late": "Commands are late (640 ms)",
        "release": "Let go first",
    }
    assert {one["code"]: one["text"] for one in reversed(found) if one and one["code"] in texts} == texts
    assert found[-2]["text"] == "Let go first. It was: Commands are late"
    actions = {one["code"]: one["action"]["kind"] for one in found if one is not None and "action" in one}
    expected = {"reload": "reload", "role": "login", "lease": "take-over", "itself": "take", "picture": "see"}
    assert actions == expected | {"script": "stop-script"}


_GOOD = "mends.forEach((mend) => Object.assign(situation, mend));"
#: What is different while all is well, and why it is off then.
LIMITS = {
    "{ liveness: { online: null, silent_s: null } }": None,
    "{ liveness: undefined }": "silent",
    "{ capabilities: { drive: { available: true, controls: false } } }": "no-drive",
    "{ loading: true }": "loading",
    "{ pictureAgeMs: 1900, inSight: false }": None,
    "{ pictureAgeMs: null, inSight: false }": None,
    "{ pictureAgeMs: Infinity, inSight: false }": "picture",
    "{ pictureAgeMs: -1, inSight: false }": "picture",
    "{ pictureAgeMs: -1, inSight: true }": None,
    "{ focus: false, fromKeys: false }": None,
}
#: Of a driver and of further rights: why it is off, and what is offered.
KEPT = {
    ("{}", "[]"): ["lease", "bob (phone) has control", "ask", None],
    ("{}", "['take']"): ["lease", "bob (phone) has control", "ask", "take-over"],
    ("{ asking: true }", "['take']"): ["asked", "bob (phone) is asked for control", "give-up", "take-over"],
    ("{ by: '', device: '', asking: true }", "['take']"): ["free", "Take control to drive", "take", None],
}
#: Of a script that runs.
DRIVES = {
    "file: 'april-follow'": "april-follow is driving: stop it first",
    "file: 'april-follow', label: 'Follow a tag'": "Follow a tag is driving: stop it first",
    "file: 'x'.repeat(1000)": f"{'x' * 40} is driving: stop it first",
    "file: null": "A script is driving: stop it first",
    "file: 'wheel-odometry', drives: false": None,
}
STOPS = {"label": "Stop script", "kind": "stop-script"}
# fmt: off
REASONS: Rows = {
    **{f"limits of reasons: {change}": (
        f"{_GOOD} result = driveReason({{ ...situation, ...{change} }})?.code ?? null;", code)
        for change, code in LIMITS.items()},
    **{f"who drives a robot that keeps control is asked: {change} {rights}": (f"""{_GOOD}
        const driver = {{ by: "bob", device: "phone", you: false, keeps: true, ...{change} }};
        const found = driveReason({{ ...situation, driver, rights: ["drive", ...{rights}] }});
        result = [found.code, found.text, found.action.kind, found.also?.kind ?? null];""", expected)
        for (change, rights), expected in KEPT.items()},
    **{f"a script that drives can be stopped: {script}": (
        f"{_GOOD} result = driveReason({{ ...situation, script: {{ running: true, {script} }} }});",
        text and {"code": "script", "text": text, "action": STOPS}) for script, text in DRIVES.items()},
    "without server or broker everything is off": (
        "result = mends.map((mend) => offReason(Object.assign(situation, mend))?.code ?? null).slice(0, 4);",
        ["server", "broker", None, None]),
}
# fmt: on


# -- whose it is


def test_a_stop_by_request_has_the_name_of_the_person() -> None:
    steps = """
      const asked = [];
      globalThis.fetch = async (url) => (asked.push(url), { ok: true });
      new Estop({ send: () => false, you: { user: "Ann & Bo" } }).press("pebble/robots/goob");
      result = asked.map((url) => url.replace(ROOT, "/"));
    """
    assert evaluate({"core/estop.js": "Estop", "core/browser.js": "ROOT"}, steps) == ["/api/estop?name=Ann%20%26%20Bo"]


def test_the_sound_socket_has_the_name_and_device_of_the_person() -> None:
    steps = """
      const urls = [];
      const WebSocket = class { constructor(url) { urls.push(url); } };
      Object.assign(globalThis, { self: {}, location: { origin: "http://here" }, WebSocket });
      await import(given);
      self.onmessage({ data: { op: "open", ref: "a/b/c", port: null, name: "Ann & Bo", device: "phone" } });
      result = Object.fromEntries(new URL(urls[0]).searchParams);
    """
    worker = (STATIC / "media" / "sound-worker.js").as_uri()
    assert evaluate({}, steps, worker) == {"ref": "a/b/c", "can": "", "name": "Ann & Bo", "device": "phone"}


def test_what_rounds_to_zero_has_no_sign() -> None:
    steps = "result = [[-0.04, 1], [-0.06, 1], [0, 2], [-0.4, 0], [-10, 0], ['a', 1]].map((one) => number(...one));"
    assert evaluate({"ui/parts/words.js": "number"}, steps) == ["0.0", "-0.1", "0.00", "0", "-10", "–"]


@rows((gesture, GESTURE), (inputs, INPUTS), (reasons, REASONS))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
