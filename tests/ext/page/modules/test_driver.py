"""The page's driver with made-up events, gamepads and a socket, and the connection to the server; in Node.js."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from tests.ext.page.in_node import Rows, Script, evaluate, rows

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
const you = { drives: true, rights: ["drive"], words: {} };
const socket = { state: "open", you, roundTripMs: 5, restart() {}, send: (op) => done.push(op.op) };
const estop = { press: (_, why) => done.push(`estop: ${why}`) };
const driver = new Driver({ socket, store, estop });
driver.select(REF);
driver.pads = new Pads(driver);
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


_MODULES = {
    "core/driver.js": "Driver",
    "core/store.js": "Store",
    "core/actions.js": "Actions",
    "core/pads.js": "Pads",
}
_ALL = "await null;\nresult ??= done;"
#: What was done: ops that were sent, emergency stops, actions, and what ends a talk.
driver = Script(_MODULES, _DRIVER, _ALL)


# -- what else ends with a gesture, and gamepads

ENDS = [
    "driver.latch('button')",
    "driver.space()",
    "driver.leave()",
    "driver.take()",
    "driver.release()",
    "driver.select('')",
    "driver.lost()",
    "driver.clock.lookedAt -= 300; driver.tick()",
    "driver.clock.base -= 1000; driver.tick()",
    "key('MetaLeft', { key: 'Meta' })",
    "driver.refused({ cmd: 'drive', ref: REF, g: 1, why: 'Commands are late' })",
    "dialog = {}; driver.tick()",
    "socket.roundTripMs = 9999; driver.tick()",
]
#: What has the focus.
FOCUS = {
    "": "{}",
    "a field": "{ matches: (all) => all.includes('textarea') }",
    "a button": "{ matches: (all) => all.startsWith('button') }",
    "a slider": "{ matches: (all) => all.startsWith('input[type=range]') }",
}
#: Keys, what is held beside them, what has the focus, and what is done.
PRESSES = [
    ("Enter", "ctrlKey", "a field", ["estop: Ctrl+Enter", "ended"]),
    ("NumpadEnter", "metaKey", "", ["estop: Ctrl+Enter", "ended"]),
    ("Space", "ctrlKey", "a field", ["estop: Ctrl+Space", "ended"]),
    ("Space", "metaKey", "", ["stop", "ended"]),
    ("Space", "", "a field", []),
    ("KeyW", "", "a slider", ["drive"]),
    ("KeyW", "", "a field", []),
    ("KeyW", "ctrlKey", "", []),
    ("ArrowUp", "", "a slider", []),
    ("KeyT", "", "", ["talk down"]),
    ("KeyT", "altKey", "", []),
]
FREE = "store.set(REF, 'web/driver', { you: false, by: '' });"
# fmt: off
DRIVER: Rows = {
    **{f"{beside} {pressed} in {where or 'nothing'}": (
        f"key('{pressed}', {{ {beside or 'other'}: true, target: {FOCUS[where]} }});", expected)
        for pressed, beside, where, expected in PRESSES},
    "what fills in a field presses no key": (f"""
        const event = {{ target: {FOCUS["a field"]}, preventDefault() {{}} }};
        driver.keyDown(event); driver.keyUp(event);""", []),
    "Enter takes control that is free": (f"""
        {FREE} key("Enter", {{ repeat: true }}); key("Enter", {{ target: {FOCUS["a button"]} }}); await null;
        const before = [...done]; key("Enter"); await null; result = [before, done];""", [[], ["lease", "ended"]]),
    "a key without control is answered and drives nothing": (f"""
        {FREE} key("KeyW"); result = [done, Number.isFinite(driver.hintedAt), driver.gestureActive];""",
        [[], True, False]),
    "behind a dialog no key is held": (
        "dialog = {}; key('KeyW'); result = [done, driver.inputs.neutral];", [[], True]),
    "what is known of an earlier connection allows no driving": ("""
        socket.outdated = true; result = [driver.reason().code]; socket.state = "lost";
        result.push(driver.reason().code);""", ["connecting", "server"]),
    "after a reset a driver pauses": ("""
        store.set(REF, "web/estop", { latched: true, by: "eve" }); driver.tick(); result = [driver.reason().code];
        store.set(REF, "web/estop", { latched: false, by: "" }); driver.tick(); result.push(driver.reason().code);
        driver.latchedAt -= 1000; result.push(driver.reason());""", ["stopped", "reset", None]),
    "the space bar plays a replay where nothing is driven": (f"""
        driver.select(""); driver.onSpace = () => done.push("play"); await null; done.length = 0;
        key("Space"); key("Space", {{ repeat: true }}); key("Space", {{ target: {FOCUS["a button"]} }});""", ["play"]),
    "watchers are told of changes only": ("""
        let told = 0; driver.onChange(() => (told += 1)); driver.changed(); driver.changed();
        driver.sliders.speed = 0.9; driver.changed(); driver.changed(); result = told;""", 1),
    **{f"what ends a gesture lets go of what else is held: {end}": (f"""
        key('KeyW'); key('KeyT'); await null; result = [done.at(-1)]; done.length = 0; {end};
        await null; result.push(['talk up', 'ended'].every((one) => done.includes(one)));""", ["talk down", True])
        for end in ENDS},
    "the end of a gesture and a refusal of another one end nothing else": ("""
        key("KeyW"); key("KeyT");
        driver.refused({ cmd: "drive", ref: REF, g: 7, why: "" });
        driver.keyUp({ code: "KeyW", key: "w" }); driver.tick(); await null;
        result = [driver.gestureActive, done.filter((one) => one === "talk up" || one === "ended")];""", [False, []]),
    "what ends a talk cannot keep a stop from being sent": ("""
        process.on("uncaughtException", () => {});
        driver.onInterrupt = () => { throw new Error("no"); };
        driver.latch("button"); result = done;""", ["estop: button"]),
    "a list that closes without a choice was closed by Escape": ("""
        const list = { value: "a", matches: () => false, closest() { return this.open ? this : null; } };
        document.activeElement = list;
        const close = (value) => {
          list.open = true; driver.tick(); Object.assign(list, { open: false, value }); driver.tick(); };
        close("b"); key("Escape"); const chosen = done.length;
        driver.escapes.pressedAt = -Infinity; close("b"); key("Escape"); result = [chosen, ...done];""",
        [0, "estop: Escape twice"]),
    "full screen whose end is told twice was ended by one Escape": ("""
        driver.escapes.fullScreenChanged(); driver.escapes.fullScreenChanged(); const once = done.length;
        document.fullscreenElement = {}; driver.escapes.fullScreenChanged();
        document.fullscreenElement = null; driver.escapes.fullScreenChanged(); result = [once, ...done];""",
        [0, "estop: Escape twice"]),
    "a space bar that is held stops again and again, on a button once": ("""
        key('Space'); key('Space', { repeat: true }); const again = done.length;
        const target = { matches: (one) => one.includes("button") };
        key("Space", { target }); key("Space", { target, repeat: true }); result = [again, done.length];""", [2, 3]),
    "a space bar switches what has the focus as well": ("""
        let prevented = 0;
        const on = (selector) => key("Space", {
          target: { matches: (all) => all.split(", ").includes(selector) }, preventDefault: () => prevented++ });
        on("input[type=checkbox]"); on("button"); const pressed = prevented; on("div");
        await null; result = [pressed, prevented, done.filter((one) => one === "stop").length];""", [0, 1, 3]),
    "another gamepad has to be seen in neutral though the one before was": ("""
        const other = (z) => ({ ...pad(z), id: "other" });
        seen(pad(0), other(1)); result = [driver.inputs.pad.z];
        seen(other(0), other(1)); result.push(driver.inputs.pad.z);""", [0, 1]),
    "the emergency stop of a gamepad comes before all that may fail": ("""
        driver.pads.read = () => { throw new Error("no"); };
        console.error = () => {}; seen(pad(0, 8, 9));
        result = [...done];""", ["estop: gamepad"]),
    "the buttons of a gamepad stop once each time": ("""
        seen(pad(0), pad(1, 8, 9), pad(1, 8, 9), pad(1, 0), pad(0), pad(1, 0, 8, 9), pad(1, 0));
        seen(pad(0), pad(1, 0)); result = done.filter((one) => /stop/.test(one));""",
        ["estop: gamepad", "stop", "estop: gamepad", "stop"]),
    "until their mappings are here gamepads only stop": ("""
        driver.actions = driver.pads = null; seen(pad(0), pad(1), pad(1, 0));
        result = [done[0], driver.gestureActive, driver.inputs.pad];""", ["stop", False, {"x": 0, "z": 0, "y": 0}]),
    "an axis that never rests in the middle blocks no keys": ("""
        const lever = pad(1); seen(lever); driver.inputs.padMovedAt -= 10_000; seen(lever);
        key("KeyW"); result = [driver.inputs.padFrozen, driver.reason(), driver.gestureActive];""",
        [False, None, True]),
}
# fmt: on


# -- which gamepad drives, which stop, and what is said of those that are ignored

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
    "axes that cannot be read": "Object.defineProperty(odd(), 'axes', { get() { throw new Error('no'); } })",
    "axes at -1": "odd({ axes: [-1, -1, 0, 0] })",
    "a button held since before": "odd({ buttons: [{ pressed: false }, { pressed: true }] })",
    "a button that cannot be read": "odd({ buttons: [{ get pressed() { throw new Error('no'); } }] })",
    "its STOP held since before": "odd({ buttons: real(0, 8, 9).buttons })",
    "an id that is none": "odd({ id: null, index: undefined })",
    "a hole": "null",
    "one that has gone": "odd({ connected: false, axes: [1, 1] })",
}
LISTS = {"null": 0, "[7, 'x', , real(0)]": 1}
#: Why it drives, or does not: what is shown, and the axis.
WHICH = {
    "it was seen in neutral": ("show(real(0)); show(real(1));", 0.6),
    "it was not": ("show(real(1));", 0),
    "the layout of the one before it is not known": ("show(pad(0), real(0)); show(pad(1), real(1));", 0.6),
    "it has the layout of an Attack 3": ("show(joy(0), real(0)); show(joy(1), real(0));", 0.6),
    "no layout is known": ("show(pad(0), odd()); show(pad(1), odd());", 0.6),
    "the first one of two is pushed": ("show(real(0), second(0)); show(real(1), second(-1));", 0.6),
    "another one came before it": ("show(null, real(0)); show({ ...real(0), index: 0 }, real(1));", 0.6),
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
    "who loses control learns to whom, and how long it was not used": ("""
        const lost = [], of = (view) => { store.set(REF, "web/driver", view); show(); };
        driver.lease.onLost = (...why) => lost.push(why); of({ you: true, by: "anna", idle_s: 3 });
        socket.state = "lost"; of({ you: false, by: "bob" }); result = [lost.length];
        socket.state = "open"; show(); store.drop(REF, "web/driver"); show();
        result.push(lost, driver.failed.size);""", [0, [["bob", 3000]], 0]),
    "a gamepad in another window is reported and its stop counts": ("""
        document.hasFocus = () => false; show(real(0)); show(real(1)); result = [codes(), driver.output.z];
        show(real(1, 8, 9)); result.push(stops());""", [["focus"], 0, ["estop: gamepad"]]),
}
# fmt: on


# -- the connection to the server, and the end of a session

_SOCKET = """
let now = 0;
performance.now = Date.now = () => now;
globalThis.location = { origin: "http://127.0.0.1" };
globalThis.setTimeout = () => {};
const sockets = [], sent = [];
globalThis.WebSocket = class {
  static OPEN = 1;
  readyState = 1;
  constructor() { sockets.push(this); }
  send(text) { sent.push(JSON.parse(text).op); }
  close() {}
};
const socket = new ControlSocket({ store: { sync() {} }, version: "1" });
const welcome = () => sockets.at(-1).onmessage({ data: '{"op": "welcome"}' });
const after = (ms) => { now += ms; socket.check(); return socket.state; };
socket.connect();
"""
control = Script({"core/control-socket.js": "ControlSocket"}, _SOCKET)
# fmt: off
CONTROL: Rows = {
    "a connection has eight seconds to begin, and is lost without a word for 1.5": (
        "result = [after(7900)]; welcome(); result.push(after(1400), after(200));", ["connecting", "open", "lost"]),
    "it is lost since it was there last": ("""
        now = 1000; socket.lost(0); now = 2000; socket.lost(0); result = [socket.lostAt];
        socket.connect(); welcome(); now = 3000; socket.lost(0); result.push(socket.lostAt);""", [1000, 3000]),
    "nothing is sent before its begin and after its end": ("""
        const send = () => socket.send({ op: "drive" }); result = [send()]; welcome(); result.push(send());
        sockets[0].readyState = 2; result.push(send(), sent);""", [False, True, False, ["drive"]]),
}
# fmt: on


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


@rows((driver, DRIVER), (shown, SHOWN), (control, CONTROL))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
