"""The page's driving modules: gestures, inputs, and the reasons why a control is off; in Node.js."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.web.in_node import STATIC, evaluate


def run(module: str, names: str, steps: str) -> Any:
    return evaluate({f"core/{module}": names}, steps)


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


def gesture(steps: str) -> Any:
    return run("gesture.js", "Gesture", _GESTURE + steps + "\nresult ??= sent;")


def test_a_gesture_is_sent_every_50_ms_and_its_end_three_times() -> None:
    assert gesture("step(0.5); step(0.5); step(0); quiet(5);") == [
        [1, 0.5, False], [1, 0.5, False], [1, 0, False], [1, 0, False], [1, 0, False],
    ]  # fmt: skip


def test_a_change_is_sent_sooner_but_not_at_once_after_another() -> None:
    assert gesture("step(0.5); step(0.6, { wait: 10 }); step(0.7, { wait: 15 });") == [[1, 0.5, False], [1, 0.7, False]]


def test_without_a_gesture_nothing_is_sent() -> None:
    assert gesture("quiet(20);") == []


def test_an_interruption_is_final_and_holds_until_everything_is_released() -> None:
    assert gesture("step(0.5); gesture.interrupt(now); step(0.5); step(0.5); step(0); sent.length = 0; step(0.5);") == [
        [2, 0.5, False]
    ]
    assert gesture("step(0.5); gesture.interrupt(now); step(0.5); step(0.5);")[1:] == [[1, 0, True]] * 3


def test_what_is_not_allowed_interrupts() -> None:
    steps = "step(0.5); step(0.5, { allowed: false }); step(0.5, { wait: 500 }); result = sent.slice(0, 2);"
    assert gesture(steps) == [[1, 0.5, False], [1, 0, True]]


def test_what_was_held_before_it_was_allowed_moves_nothing() -> None:
    assert gesture("step(0.5, { allowed: false }); step(0.5); step(0.5); result = [sent, gesture.mustRelease];") == [
        [], True,
    ]  # fmt: skip


def test_a_page_that_stood_still_ends_its_gesture() -> None:
    assert gesture("step(0.5); step(0.5, { wait: 251 }); result = [sent, gesture.active];") == [
        [[1, 0.5, False], [1, 0, True]], False,
    ]  # fmt: skip


def test_a_zero_that_is_repeated_late_would_stop_another_driver() -> None:
    assert gesture("step(0.5); step(0); sent.length = 0; step(0, { wait: 1000 });") == []


def test_opposite_keys_are_no_release() -> None:
    assert gesture("gesture.interrupt(now); step(0, { neutral: false }); step(0.5); result = sent;") == []


def test_what_waits_to_be_released_begins_nothing() -> None:
    assert gesture("step(0.5, { waits: true }); step(0.5); result = sent;") == []


def test_a_refused_gesture_is_over_and_sends_nothing_more() -> None:
    assert gesture("step(0.5); gesture.refused(1); step(0.5); step(0.5);") == [[1, 0.5, False]]


def test_a_refusal_of_an_earlier_gesture_changes_nothing() -> None:
    assert gesture("step(0.5); step(0); step(0.5); gesture.refused(1); result = gesture.active;") is True


def test_the_next_gesture_ends_the_repetitions() -> None:
    assert gesture("step(0.5); step(0); step(0.5); step(0.5);")[2:] == [[2, 0.5, False], [2, 0.5, False]]


def test_a_new_connection_counts_from_the_beginning_and_needs_a_release() -> None:
    assert gesture("step(0.5); gesture.reset(); step(0.5); step(0); step(0.5); result = sent.slice(1);") == [
        [1, 0.5, False]
    ]


# -- inputs

_INPUTS = """
const inputs = new Inputs();
const full = { speed: 1, turn: 1, balance: 0 };
const vector = (sliders = full) => { const { x, z, y } = inputs.vector(sliders); return [x + 0, z + 0, y + 0]; };
const pad = (x, z, timestamp = 1, buttons = []) =>
  ({ id: "pad", axes: [x, -z], buttons: [0, 1].map((i) => ({ pressed: buttons.includes(i) })), timestamp });
const seen = (...pads) => pads.forEach((one, i) => inputs.padSample(one, 1000 + 50 * i));
"""


def inputs(steps: str) -> Any:
    return run("inputs.js", "Inputs, balanced", _INPUTS + steps)


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        (["KeyW"], [0, 1, 0]),
        (["ArrowDown"], [0, -1, 0]),
        (["KeyA"], [-1, 0, 0]),
        (["ArrowRight"], [1, 0, 0]),
        (["KeyW", "ArrowUp"], [0, 1, 0]),
        (["KeyW", "KeyS"], [0, 0, 0]),
        (["KeyW", "KeyD"], [0.5, 0.5, 0]),
        (["KeyQ"], [0, 0, 1]),
        (["KeyE"], [0, 0, -1]),
        (["KeyX"], [0, 0, 0]),
    ],
)
def test_keys(codes: list[str], expected: list[float]) -> None:
    assert (
        inputs(f"for (const code of {json.dumps(codes)}) inputs.keyDown(code, false); result = vector();") == expected
    )


def test_sliders_scale_and_balance() -> None:
    assert inputs('inputs.keyDown("KeyW", false); result = vector({ speed: 0.5, turn: 1, balance: 0 });') == [0, 0.5, 0]
    assert inputs('inputs.keyDown("KeyD", false); result = vector({ speed: 0, turn: 0.5, balance: 0 });') == [0.5, 0, 0]
    assert inputs('inputs.keyDown("KeyW", false); result = vector({ speed: 1, turn: 1, balance: -1 });') == [
        -0.5,
        0.5,
        0,
    ]


def test_no_wheel_is_asked_for_more_than_full_speed() -> None:
    steps = """
    result = 0;
    for (let x = -1; x <= 1; x += 0.25) for (let z = -1; z <= 1; z += 0.25) for (let b = -1; b <= 1; b += 0.5) {
      const one = balanced(x, z, b);
      result = Math.max(result, Math.abs(one.x + one.z), Math.abs(one.z - one.x));
    }"""
    assert inputs(steps) <= 1 + 1e-9


def test_a_repeated_key_moves_nothing_and_waits_to_be_released() -> None:
    steps = 'inputs.keyDown("KeyW", true); result = [vector(), inputs.neutral]; inputs.keyUp("KeyW");'
    assert inputs(steps + "result.push(inputs.neutral);") == [[0, 0, 0], False, True]


def test_what_was_interrupted_counts_after_it_was_released() -> None:
    steps = """
    inputs.keyDown("KeyW", false); inputs.clear(); inputs.keyDown("KeyW", true);
    result = [vector(), inputs.neutral];
    inputs.keyUp("KeyW"); inputs.keyDown("KeyW", false);
    result.push(vector());"""
    assert inputs(steps) == [[0, 0, 0], False, [0, 1, 0]]


def test_a_release_that_was_lost_does_not_wait_for_ever() -> None:
    steps = """
    inputs.keyDown("KeyW", false); inputs.clear();
    inputs.keyDown("KeyD", false); inputs.keyUp("KeyD");
    result = inputs.neutral;"""
    assert inputs(steps) is True


def test_when_the_window_has_lost_the_keyboard_nothing_waits() -> None:
    assert inputs('inputs.keyDown("KeyW", false); inputs.leave(); result = [inputs.neutral, vector()];') == [
        True, [0, 0, 0],
    ]  # fmt: skip


def test_the_stick_belongs_to_one_finger() -> None:
    assert inputs("result = [inputs.stickStart(1), inputs.stickStart(2)];") == [True, False]


def test_the_stick_stays_in_its_circle_and_rests_in_the_middle() -> None:
    steps = """
    inputs.stickStart(1); inputs.stickMove(3, 4); result = [Math.hypot(inputs.stick.x, inputs.stick.z) < 1];
    inputs.stickMove(0.05, -0.09); result.push(vector());
    inputs.stickMove(0, 1); result.push(vector()); inputs.stickEnd(); result.push(vector());"""
    assert inputs(steps) == [True, [0, 0, 0], [0, 1, 0], [0, 0, 0]]


def test_a_finger_that_rests_on_the_stick_is_no_release() -> None:
    steps = "inputs.stickStart(1); inputs.stickMove(0, 0); result = [inputs.neutral]; inputs.stickEnd();"
    assert inputs(steps + "result.push(inputs.neutral);") == [False, True]


def test_a_button_moves_the_auxiliary_axis_while_it_is_held() -> None:
    assert inputs('inputs.hold("up", 1); result = [vector()]; inputs.hold("up", 0); result.push(vector());') == [
        [0, 0, 1], [0, 0, 0],
    ]  # fmt: skip


def test_a_gamepad_counts_after_it_was_seen_in_neutral() -> None:
    assert inputs("seen(pad(0, 1)); result = [vector()]; seen(pad(0, 0, 2), pad(0, 1, 3)); result.push(vector());") == [
        [0, 0, 0], [0, 1, 0],
    ]  # fmt: skip


@pytest.mark.parametrize("interruption", ["inputs.clear()", "inputs.leave()", "inputs.padGone()", "seen(null)"])
def test_after_an_interruption_a_gamepad_has_to_be_seen_in_neutral_again(interruption: str) -> None:
    steps = f"seen(pad(0, 0), pad(0, 1, 2)); {interruption}; seen(pad(0, 1, 3)); result = vector();"
    assert inputs(steps) == [0, 0, 0]


def test_a_gamepad_whose_time_stands_still_is_not_believed_for_long() -> None:
    steps = """
    inputs.padSample(pad(0, 0), 0); inputs.padSample(pad(0, 1, 2), 50);
    inputs.padSample(pad(0, 1, 2), 3000); result = [vector(), inputs.padFrozen];
    inputs.padSample(pad(0, 1, 2), 3100); result.push(vector(), inputs.padFrozen);
    inputs.padSample(pad(0, 1, 3), 3150); result.push(vector());
    inputs.padSample(pad(0, 0, 4), 3200); inputs.padSample(pad(0, 1, 5), 3250);
    result.push(vector(), inputs.padFrozen);"""
    assert inputs(steps) == [[0, 1, 0], False, [0, 0, 0], True, [0, 0, 0], [0, 1, 0], False]


def test_a_gamepad_that_never_was_in_neutral_is_no_frozen_one() -> None:
    steps = """
    inputs.padSample(pad(0, 1), 0); inputs.padSample(pad(0, 1), 10_000);
    result = [vector(), inputs.padFrozen];"""
    assert inputs(steps) == [[0, 0, 0], False]


def test_the_second_button_of_a_gamepad_chooses_the_auxiliary_axis() -> None:
    assert inputs("seen(pad(0, 0), pad(-1, 0, 2, [1])); result = vector();") == [0, 0, -1]


def test_keys_and_gamepad_need_the_focus_and_the_stick_does_not() -> None:
    steps = """
    inputs.stickStart(1); inputs.stickMove(0, 1); result = [inputs.fromKeys];
    inputs.keyDown("KeyW", false); result.push(inputs.fromKeys); inputs.keyUp("KeyW");
    seen(pad(0, 0), pad(0, 1, 2)); result.push(inputs.fromKeys);"""
    assert inputs(steps) == [False, True, True]


# -- reasons, in their order

#: Everything is wrong at once; each line mends what the reason before it was about.
_SITUATION = """
const situation = {
  name: "goob", open: false, broker: "refused", reload: true, drives: false, rights: [], hidden: true, focus: false,
  dialog: true,
  fromKeys: true, liveness: { online: false, silent_s: 12.3 }, estop: { latched: true, by: "eve" }, freeForMs: 100,
  capabilities: {}, driver: { by: "bob", device: "phone", server: "fair-2", you: false },
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


def reasons(steps: str) -> Any:
    return run("reasons.js", "driveReason, offReason", _SITUATION + steps)


def test_the_first_reason_counts() -> None:
    found = reasons("result = mends.map((mend) => driveReason(Object.assign(situation, mend)));")
    assert [None if one is None else one["code"] for one in found] == [
        "server", "broker", "reload", "plain", "role", "hidden", "silent", "stopped", "reset", "no-drive", "lease",
        "free", "dialog", "script", "picture", "late", "pad", "focus", "release", "release", None,
    ]  # fmt: skip
    texts = {one["code"]: one["text"] for one in reversed(found) if one is not None}
    assert texts["server"] == "No connection to the server"
    assert texts["silent"] == "goob is silent for 12 s"
    assert texts["stopped"] == "Stopped by eve"
    assert texts["lease"] == "bob (phone, fair-2) is driving"
    assert texts["free"] == "april-follow runs. Take control to drive"
    assert texts["picture"] == "The picture is 2.4 s old"
    assert texts["late"] == "Commands are late (640 ms)"
    assert texts["release"] == "Let go first"
    assert found[-2]["text"] == "Let go first. It was: Commands are late"
    actions = {one["code"]: one["action"]["kind"] for one in found if one is not None and "action" in one}
    expected = {"reload": "reload", "role": "login", "lease": "take-over", "free": "take", "picture": "see"}
    assert actions == expected | {"script": "stop-script"}


def test_without_server_or_broker_everything_is_off() -> None:
    steps = "result = mends.map((mend) => offReason(Object.assign(situation, mend))?.code ?? null).slice(0, 4);"
    assert reasons(steps) == ["server", "broker", None, None]


@pytest.mark.parametrize(
    ("file", "text", "label"),
    [
        ('"april-follow"', "april-follow is driving: stop it first", "Stop april-follow"),
        ('{ "x": 1 }', "A script is driving: stop it first", "Stop the script"),
        ('"x".repeat(1000)', f"{'x' * 40} is driving: stop it first", f"Stop {'x' * 40}"),
    ],
)
def test_a_script_that_drives_can_be_stopped(file: str, text: str, label: str) -> None:
    steps = f"{_GOOD} result = driveReason({{ ...situation, script: {{ running: true, file: {file} }} }});"
    assert reasons(steps) == {"code": "script", "text": text, "action": {"label": label, "kind": "stop-script"}}


_GOOD = "mends.forEach((mend) => Object.assign(situation, mend));"


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ("{ liveness: { online: null, silent_s: null } }", None),
        ("{ liveness: undefined }", "silent"),
        ("{ capabilities: { drive: { available: true, controls: false } } }", "no-drive"),
        ("{ loading: true }", "loading"),
        ("{ pictureAgeMs: 1900, inSight: false }", None),
        ("{ pictureAgeMs: null, inSight: false }", None),
        ("{ pictureAgeMs: Infinity, inSight: false }", "picture"),
        ("{ focus: false, fromKeys: false }", None),
    ],
)
def test_limits_of_reasons(change: str, code: str | None) -> None:
    assert reasons(f"{_GOOD} result = driveReason({{ ...situation, ...{change} }})?.code ?? null;") == code


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
