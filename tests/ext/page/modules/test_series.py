"""Values over time: series, plots, the trail of an odometry, the page's store, and recordings; in Node.js."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.ext.page.in_node import Rows, Script, rows

_MODULES = {"core/series.js": "* as core", "core/plot-choices.js": "* as plots", "core/trail.js": "* as trail"}
_PREPARED = """
const series = (more = {}) => new core.Series(core.numbers, { spanMs: 120_000, most: 1000, ...more });
const shown = (one) => one.times.map((at, index) => [at, one.rows[index].value]);
const one = series();
"""


run = Script(_MODULES, _PREPARED)


#: What the numbers of a payload are.
NUMBERS = {
    "{ value: 7.9, unit: 'v', t: 5 }": {"value": 7.9},
    "{ value: { a: 1, b: { c: 2, d: { e: 3, f: { g: 4 } } } } }": {"a": 1, "b.c": 2, "b.d.e": 3},
    "{ value: [1, 'x', 2] }": {"0": 1, "2": 2},
    **dict.fromkeys(("{ value: null }", "{ value: Infinity }", "'7'"), None),
    "{ value: { ['x'.repeat(61)]: 1 } }": None,
    'JSON.parse(\'{"value": {"__proto__": 1, "constructor": 2}}\')': {"__proto__": 1, "constructor": 2},
}
#: Where a payload says that something is.
PLACES = {
    "{ value: { x_mm: 1500, y_mm: -500, heading_rad: 0.5 }, unit: 'mm' }": [1.5, -0.5, 0.5],
    "{ value: { x: 1.5, y: -0.5, theta_rad: 0.5 }, unit: 'M' }": [1.5, -0.5, 0.5],
    "{ value: { x_mm: 0, y_mm: 0, heading_deg: 180 } }": [0, 0, 3.14159],
    "{ value: { x: 1500, y: 0 }, unit: { toString: 0 } }": [1.5, 0, 0],
}
NO_PLACES = "null", "{ value: [1, 2] }", "{ value: { x_mm: '1', y_mm: 2 } }", "{ value: { x_mm: 1e300, y_mm: 0 } }"
_POSES = """
const pose = (x, run = -1) => ({ x, y: 0, heading: 0, run });
const cut = (times, poses) => trail.pieces(times, poses).map((piece) => piece.map(({ x }) => x));
"""
#: Times, poses, and the pieces of the trail.
TRAILS = {
    "one piece": ("[0, 100, 200]", "[pose(0), pose(0.1), pose(0.2)]", [[0, 0.1, 0.2]]),
    "a jump": ("[0, 100, 200]", "[pose(0), pose(2), pose(2.1)]", [[0], [2, 2.1]]),
    "a restart": ("[0, 100, 200]", "[pose(0.2, 5), pose(0.2, 0), pose(0.3, 0.1)]", [[0.2], [0.2, 0.3]]),
    "a silence": ("[0, 100, 9000]", "[pose(0), pose(0.1), pose(0.2)]", [[0, 0.1], [0.2]]),
    "nothing": ("[]", "[]", []),
}
# fmt: off
RUN: Rows = {
    "it is bounded in number and time": ("""
        for (let at = 0; at < 20_000; at++) one.push(at, at);
        const count = one.times.length;
        for (let at = 1; at < 400; at++) one.push(20_000 + at * 1000, at);
        result = [count, one.times.length <= 183, one.times.at(-1) - one.times[0] < 183_000];""",
        [pytest.approx(1000, abs=63), True, True]),
    "a component at rest leaves few poses": ("""
        const path = new core.Series(trail.poseOf, { spanMs: 3_600_000, most: 4000, differs: trail.differs });
        for (let at = 0; at < 100_000; at += 50) path.push(at, { value: { x_mm: 1, y_mm: 0 } });
        result = [path.times.length, trail.pieces(path.times, path.rows).length];""", [100, 1]),
    "a value that is sent again is no new one": (
        "one.push(1000, 1); one.push(990, 1); one.push(2700, 1); result = shown(one);", [[1000, 1], [2700, 1]]),
    "what is cleared does not come back": ("""
        one.push(1000, 1); one.push(2000, 2); one.clear(2500); one.push(3000, 3);
        result = shown(one);""", [[3000, 3]]),
    "gaps are gaps": ("""
        for (const at of [0, 500, 1000, 1500, 6000, 6500]) one.push(at, at);
        result = [one.columns(["value"], 600, 6400), one.gapMs];""",
        [[[500, 1000, 1500, 1501, 6000], [500, 1000, 1500, None, 6000]], 2000]),
    "a line ends where a payload lacks it": ("""
        one.push(0, { value: { a: 1, b: 2 } }); one.push(100, { value: { a: 3, b: "x" } });
        result = one.columns(["a", "b"], 0, 1000);""", [[0, 100], [1, 3], [2, None]]),
    **{f"the numbers of {payload}": (f"result = core.numbers({payload});", found)
        for payload, found in NUMBERS.items()},
    **{f"the pose of {payload}": (
        f"const pose = trail.poseOf({payload}); result = [pose.x, pose.y, pose.heading];", pytest.approx(at, abs=1e-4))
        for payload, at in PLACES.items()},
    **{f"{payload} is no pose": (f"result = trail.poseOf({payload});", None) for payload in NO_PLACES},
    **{f"a trail with {what}": (f"{_POSES} result = cut({times}, {poses});", pieces)
        for what, (times, poses, pieces) in TRAILS.items()},
}
# fmt: on


# -- the newest values, their ages and periods, subscriptions, and the server's clock

_STORE = """
let now = 1000;
const waiting = [];
const store = new Store(() => now, (fn) => waiting.push(fn));
const frame = () => waiting.splice(0).forEach((fn) => fn());
const calls = [];
"""
store = Script({"core/store.js": "Store"}, _STORE)
# fmt: off
STORE: Rows = {
    "components and new metrics are noticed": ("""
        store.subscribe(null, null, () => calls.push(store.refs().join()));
        store.subscribe("a", null, () => calls.push(store.metrics("a").join(" ")));
        store.set("", "web/broker", {}); store.set("a", "m", 1); frame();
        store.set("a", "m", 2); frame();
        store.set("a", "n", 2); frame();
        store.remove("a"); frame();
        result = calls;""", ["a", "m", "m n", "", ""]),
    "the period is the usual time between updates": ("""
        const periods = [];
        for (const wait of [0, 200, 210, 190, 5000, 200]) {
          now += wait; store.set("a", "m", 1); periods.push(store.get("a", "m").period);
        }
        result = periods;""", [0, 0, 0, 200, 210, 200]),
    "a value ages from its age at the server": (
        'store.set("a", "m", 7, 400); now += 100; const v = store.get("a", "m"); result = [v.value, v.age];',
        [7, 500]),
    "a metric of any component is noticed, also that it goes": ("""
        store.subscribe(null, "m", () => calls.push(store.refs().join()));
        store.set("a", "m", 1); store.set("b", "m", 1); frame();
        store.set("a", "n", 1); frame();
        store.drop("b", "m"); frame();
        store.remove("a"); frame();
        result = calls;""", ["a,b", "a,b", "b"]),
    "a subscriber that fails keeps no other from being called": ("""
        process.on("uncaughtException", (error) => calls.push(error.message));
        store.subscribe("a", "m", () => { throw new Error("bad"); });
        store.subscribe("b", "m", () => calls.push("b"));
        store.set("a", "m", 1); store.set("b", "m", 2); frame();
        await new Promise((done) => setTimeout(done, 1));
        result = calls;""", ["b", "bad"]),
    "late messages do not set the clock back": ("""
        store.sync(50_000, 20); const prompt = store.now();
        now += 500; store.sync(50_500 - 300, 20); const late = store.now();
        result = [prompt, late];""", [50_010, 50_510]),
    "a clock that was set is followed": ("""
        store.sync(50_000, 0);
        for (let i = 0; i < 60; i++) { now += 500; store.sync(20_000 + now, 0); }
        result = store.now() - now;""", 20_000),
}
# fmt: on


# -- recordings: where a player is, what it sends, and the day around it

#: A feed with a clock that only ``now`` moves, and a socket that notes what is asked for.
FEED = """
globalThis.WebSocket = class { static OPEN = 1; };
const it = { now: 0, sent: [], begun: 0, taken: [], media: [], sockets: [] };
const open = (path) => {
  const socket = { path, readyState: 1, send: (text) => it.sent.push(JSON.parse(text)), close() {} };
  it.sockets.push(socket);
  return socket;
};
const feed = new Feed("a/b/c", {
  clock: () => it.now, open, changed() {}, begin: () => it.begun++, take: (message) => it.taken.push(message.op),
  picture: (payload, at, shown) => it.media.push([[...payload], at, shown]),
  sound: (payload) => it.media.push([...payload]),
});
const hear = (message) => it.sockets.at(-1).onmessage({ data: typeof message === "object" && !(message instanceof
  ArrayBuffer) ? JSON.stringify(message) : message });
const played = (at, more = {}) => hear({ op: "played", at, on: false, speed: 1, ...more });
const medium = (what, at) => {
  const view = new DataView(new ArrayBuffer(11));
  view.setUint8(0, what); view.setFloat64(1, at); view.setUint8(9, 7); view.setUint8(10, 255);
  hear(view.buffer);
};
const opened = () => { feed.seek(5000); it.sockets[0].onopen(); played(5000, { begins: true }); };
"""
feed = Script({"core/replay/feed.js": "Feed"}, FEED + "result = (() => {", "})();")
timeline = Script(
    {"core/replay/timeline.js": "extentOf, firstOf, stretchesOf, stretchOf, startOf, whyOf"},
    """const start = startOf("2026-11-22");
    const day = (activity, sessions = []) => ({ from: start, step: 10_000, activity, gaps: [], outages: [], sessions });
    const steps = ({ since, until }) => [(since - start) / 10_000, (until - start) / 10_000];""",
)
# fmt: off
PLAYED: Rows = {
    "it may only seek, play and change the speed": ("""
        opened(); feed.seek(1); feed.play(true); [0.25, 3, 8].forEach((speed) => feed.setSpeed(speed));
        return it.sent.map((op) => op.speed ?? op.op);""", ["seek", "play", 0.25, 8]),
    "the first seek opens the socket there, and what follows goes on from it": ("""
        opened(); return [it.sockets[0].path, it.begun, feed.position, feed.seeking, feed.seeks];""",
        ["ws/replay?robot=a%2Fb%2Fc&at=5000", 1, 5000, False, 1]),
    "the time goes on by itself for a second at its speed": ("""
        opened(); played(5000, { on: true, speed: 4 }); it.now = 500; const soon = feed.position; it.now = 9000;
        return [soon, feed.position];""", [7000, 9000]),
    "of many seeks the first and the last are asked for": ("""
        opened(); for (let n = 1; n <= 50; n++) feed.seek(1000 * n);
        const before = feed.position; played(1000, { begins: true }); const still = feed.seeking;
        played(50_000, { begins: true });
        return [it.sent.map((op) => op.at), before, still, feed.seeking, it.begun];""",
        [[1000, 50_000], 50_000, True, False, 2]),
    "what was sent before a seek arrives is void": ("""
        opened(); feed.seek(9000); medium(1, 5100); hear({ op: "state", now: 5100, set: [] }); played(5100);
        const during = [it.media.length, it.taken.length, feed.position];
        played(9000, { begins: true }); medium(1, 8990); hear({ op: "state", now: 9000, set: [] });
        return [during, it.media, it.taken];""", [[0, 0, 9000], [[[7, 255], 8990, True]], ["state"]]),
    "pictures for the decoder are not shown, and sound is sound": ("""
        opened(); medium(0, 1); medium(1, 2); medium(2, 3); return it.media;""",
        [[[7, 255], 1, False], [[7, 255], 2, True], [7, 255]]),
    "a lost socket is made anew where it was, as it was": ("""
        globalThis.setTimeout = (fn) => { it.later = fn; };
        opened(); played(6000, { on: true, speed: 2 }); it.sockets[0].onclose(); it.later(); it.sockets[1].onopen();
        return [it.sockets[1].path, it.sent];""",
        ["ws/replay?robot=a%2Fb%2Fc&at=6000", [{"op": "speed", "speed": 2}, {"op": "play", "on": True}]]),
}
TIMELINE: Rows = {
    "what happened is in stretches, and only what is seen": ("""
        const all = day([2, 2, 0, 2, 64, 2, 0, 0, 2]), seen = (since, until) => ({ since: start + since, until: start +
          until });
        result = [stretchesOf(all, 2, seen(0, 90_000)).map(steps), stretchesOf(all, 2, seen(25_000, 45_000)).map(steps),
          stretchesOf(all, 2, seen(0, 7_000_000)).map(steps)];""",
        [[[0, 2], [3, 4], [5, 6], [8, 9]], [[3, 4]], [[0, 6], [8, 9]]]),
    "a day begins where it has pictures": ("""
        const sessions = [{ since: start + 15_000, until: start + 30_000 }, { since: start + 60_000, until: start +
          75_000 }];
        const first = (steps, last) =>
          (firstOf({ timeline: day(steps, sessions), name: "2026-11-22" }, last) - start) / 10_000;
        result = [first([1, 1, 65, 1]), first([1, 1, 1, 1]), first([1, 1, 1, 1], true),
          first([1, 65, 1, 1, 1, 1, 65, 65], true), first([1, 1, 1, 1, 1, 1, 1, 65]), first([64, 1, 64, 64, 1]),
          firstOf({ timeline: null, name: "2026-11-22" }) - start];""",
        [3, 1.5, 6, 7, 7.5, 3, 0]),
    **{f"with marks at {since} and {until} is exported at {at}": (f"""
        const stretch = stretchOf({since}, {until}, [{{ since: 100, until: 200 }}], {at});
        result = [stretch.since, stretch.until];""", expected)
        for since, until, at, expected in (
            ("null", "null", 150, [100, 200]),  # the session
            ("null", "null", 200, [200, 60_200]),  # a minute
            (120, "null", 150, [120, 200]),
            ("null", 180, 150, [100, 180]),
        )},
}
# fmt: on


@rows((run, RUN), (store, STORE), (feed, PLAYED), (timeline, TIMELINE))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
