"""The page's driver with events, gamepads and a socket that are made up, and the end of a session; in Node.js."""

from __future__ import annotations

from typing import Any

import pytest

from tests.web.in_node import evaluate

_DRIVER = """
let pads = [];
let dialog = null;
const define = (name, value) => Object.defineProperty(globalThis, name, { value, configurable: true });
define("document", { hidden: false, hasFocus: () => true, querySelector: () => dialog, activeElement: null });
define("navigator", { getGamepads: () => pads });
const done = [];
const REF = "pebble/robots/goob";
const store = new Store(undefined, (flush) => flush());
const facts = {
  "web/liveness": { online: true }, "web/driver": { you: true, by: "anna" },
  capabilities: { value: { drive: { available: true } } },
};
for (const [metric, value] of Object.entries(facts)) store.set(REF, metric, value);
const you = { drives: true, rights: ["drive"] };
const socket = { state: "open", you, roundTripMs: 5, restart() {}, send: (op) => done.push(op.op) };
const estop = { press: (_, why) => done.push(`estop: ${why}`) };
const driver = new Driver({ socket, store, estop, reload: () => false });
driver.ref = REF;
let mappingOf = () => USUAL;
driver.pads = new PadInput(driver, (id) => mappingOf(id));
driver.onInterrupt = () => done.push("ended");
driver.actions = new Actions((id, phase) => done.push(`${id} ${phase}`));
const pad = (z, ...pressed) => ({
  id: "pad", index: 0, connected: true, axes: [0, -z], timestamp: stamp++,
  buttons: Array.from({ length: 16 }, (_, i) => ({ pressed: pressed.includes(i) })),
});
let stamp = 0;
const seen = (...samples) => samples.forEach((one) => { pads = [one]; driver.tick(); });
const key = (code, more = {}) =>
  driver.keyDown({ code, key: code, target: {}, timeStamp: performance.now(), preventDefault() {}, ...more });
driver.tick();
await null;
done.length = 0;
"""


def driver(steps: str) -> Any:
    """What was done: ops that were sent, emergency stops, actions, and what ends a talk."""
    imports = {"core/driver.js": "Driver", "core/store.js": "Store", "core/actions.js": "Actions"}
    imports |= {"core/pad-input.js": "PadInput", "core/inputs.js": "USUAL"}
    return evaluate(imports, f"{_DRIVER}{steps}\nawait null;\nresult ??= done;")


# -- what else ends with a gesture


@pytest.mark.parametrize(
    "interruption",
    [
        "driver.latch('button')",
        "driver.space()",
        "driver.leave()",
        "driver.take()",
        "driver.release()",
        "driver.select('')",
        "driver.lost()",
        "driver.updatedAt -= 300; driver.tick()",
        "driver.clockBase -= 1000; driver.tick()",
        "key('MetaLeft', { key: 'Meta' })",
        "driver.refused({ cmd: 'drive', ref: REF, g: 1, why: 'Commands are late' })",
        "dialog = {}; driver.tick()",
        "socket.roundTripMs = 9999; driver.tick()",
    ],
)
def test_what_ends_a_gesture_lets_go_of_what_else_is_held(interruption: str) -> None:
    steps = f"key('KeyW'); key('KeyT'); await null; result = [done.at(-1)]; done.length = 0; {interruption};"
    steps += " await null; result.push(['talk up', 'ended'].every((one) => done.includes(one)));"
    assert driver(steps) == ["talk down", True]


def test_the_end_of_a_gesture_and_a_refusal_of_another_one_end_nothing_else() -> None:
    steps = """key("KeyW"); key("KeyT");
    driver.refused({ cmd: "drive", ref: REF, g: 7, why: "" });
    driver.keyUp({ code: "KeyW", key: "w" }); driver.tick(); await null;
    result = [driver.gestureActive, done.filter((one) => one === "talk up" || one === "ended")];"""
    assert driver(steps) == [False, []]


def test_what_ends_a_talk_cannot_keep_a_stop_from_being_sent() -> None:
    steps = """process.on("uncaughtException", () => {});
    driver.onInterrupt = () => { throw new Error("no"); };
    driver.latch("button"); result = done;"""
    assert driver(steps) == ["estop: button"]


def test_a_space_bar_that_is_held_stops_again_and_again_but_on_a_button_once() -> None:
    steps = "key('Space', {more}); key('Space', {{ ...{more}, repeat: true }}); await null; result = done;"
    assert driver(steps.format(more="{}")) == ["stop", "stop", "ended", "ended"]
    assert driver(steps.format(more="{ target: { matches: (one) => one.includes('button') } }")) == ["stop", "ended"]


def test_a_space_bar_switches_what_has_the_focus_as_well() -> None:
    steps = """let prevented = 0;
    const on = (selector) => key("Space", {
      target: { matches: (all) => all.split(", ").includes(selector) }, preventDefault: () => prevented++ });
    on("input[type=checkbox]"); on("button"); const pressed = prevented; on("div");
    await null; result = [pressed, prevented, done.filter((one) => one === "stop").length];"""
    assert driver(steps) == [0, 1, 3]


# -- gamepads


def test_another_gamepad_has_to_be_seen_in_neutral_though_the_one_before_was() -> None:
    steps = """const other = (z) => ({ ...pad(z), index: 1 });
    seen(pad(0), other(1)); result = [driver.inputs.pad.z];
    seen(other(0), other(1)); result.push(driver.inputs.pad.z);"""
    assert driver(steps) == [0, 1]


def test_the_emergency_stop_of_a_gamepad_comes_before_all_that_may_fail() -> None:
    steps = """mappingOf = () => { throw new Error("no"); };
    try { seen(pad(0, 8, 9)); } catch {}
    result = [...done];"""
    assert driver(steps) == ["estop: gamepad"]


def test_the_buttons_of_a_gamepad_stop_once_each_time() -> None:
    steps = "seen(pad(0), pad(1, 8, 9), pad(1, 8, 9), pad(1, 0), pad(0), pad(1, 0, 8, 9), pad(1, 0));"
    assert driver(f"{steps} seen(pad(0), pad(1, 0)); result = done.filter((one) => /stop/.test(one));") == [
        "estop: gamepad", "estop: gamepad", "stop",
    ]  # fmt: skip


def test_until_their_mappings_are_here_gamepads_only_stop() -> None:
    steps = "driver.actions = driver.pads = null; seen(pad(0), pad(1), pad(1, 0));"
    assert driver(f"{steps} result = [done[0], driver.gestureActive, driver.inputs.pad];") == [
        "stop", False, {"x": 0, "z": 0, "y": 0},
    ]  # fmt: skip


def test_an_axis_that_never_rests_in_the_middle_blocks_no_keys() -> None:
    steps = """const lever = pad(1); seen(lever); driver.inputs.padMovedAt -= 10_000; seen(lever);
    key("KeyW"); result = [driver.inputs.padFrozen, driver.reason(), driver.gestureActive];"""
    assert driver(steps) == [False, None, True]


# -- a session that has ended


@pytest.mark.parametrize(("answer", "reloads"), [("opaqueredirect", 1), ("basic", 0)])
def test_a_session_that_has_ended_leads_to_the_login_which_leads_back(answer: str, reloads: int) -> None:
    """The server redirects each screen to the login, which then opens that screen."""
    steps = """let reloads = 0;
    const define = (name, value) => Object.defineProperty(globalThis, name, { value, configurable: true });
    define("location", { reload: () => (reloads += 1) });
    define("fetch", async () => ({ type: given }));
    const socket = new ControlSocket({ store: {}, version: "1" });
    socket.lost(4401);
    await new Promise((resolve) => setImmediate(resolve));
    result = reloads;"""
    assert evaluate({"core/control-socket.js": "ControlSocket"}, steps, answer) == reloads
