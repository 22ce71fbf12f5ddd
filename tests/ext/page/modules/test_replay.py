"""What a page makes of a recording, without a browser: where its player is, what it sends, and the day around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.ext.page.in_node import Rows, Script, rows

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
run = Script({"core/replay/feed.js": "Feed"}, FEED + "result = (() => {", "})();")
timeline = Script(
    {"core/replay/timeline.js": "extentOf, firstOf, stretchesOf, stretchOf, startOf, whyOf"},
    """const start = startOf("2026-11-22");
    const day = (activity, sessions = []) => ({ from: start, step: 10_000, activity, gaps: [], outages: [], sessions });
    const steps = ({ since, until }) => [(since - start) / 10_000, (until - start) / 10_000];""",
)
# fmt: off
RUN: Rows = {
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
    "a stretch that was left out is shown for a while": ("""
        opened(); played(9000, { skipped: [6000, 9000] }); const { since, until } = feed.skipped; it.now = 5000;
        played(9100); const still = Boolean(feed.skipped); it.now = 7000; played(9200);
        return [since, until, still, feed.skipped];""", [6000, 9000, True, None]),
    "a lost socket is made anew where it was, as it was": ("""
        globalThis.setTimeout = (fn) => { it.later = fn; };
        opened(); played(6000, { on: true, speed: 2 }); it.sockets[0].onclose(); it.later(); it.sockets[1].onopen();
        return [it.sockets[1].path, it.sent];""",
        ["ws/replay?robot=a%2Fb%2Fc&at=6000", [{"op": "speed", "speed": 2}, {"op": "play", "on": True}]]),
    "what the server refuses is not asked again": ("""
        globalThis.setTimeout = () => { throw new Error("again"); };
        opened(); hear({ op: "bye", why: "too many", again: false }); it.sockets[0].onclose(); return feed.problem;""",
        "too many"),
    "it may only seek, play and change the speed": ("""
        opened(); feed.seek(1); feed.play(true); feed.setSpeed(8); feed.setSpeed(3);
        return it.sent.map((op) => op.op);""", ["seek", "play", "speed"]),
}
TIMELINE: Rows = {
    "a day is seen from its first to its last message": ("""
        result = [steps(extentOf(day([0, 0, 1, 0, 32]), "2026-11-22")), steps(extentOf(day([]), "2026-11-22"))];""",
        [[2, 5], [0, 8640]]),
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
        result = [first([1, 1, 65, 1]), first([1, 1, 65, 1], true), first([1, 1, 1, 1]), first([1, 1, 1, 1], true),
          first([1, 1, 1, 1, 65]), first([1, 1, 65, 1, 1, 1, 65, 65]), first([1, 65, 1, 1, 1, 1, 65, 65], true),
          first([1, 1, 1, 1, 1, 1, 1, 65]), first([64, 1, 64, 64, 1]),
          firstOf({ timeline: day([1]), name: "" }) - start,
          firstOf({ timeline: null, name: "2026-11-22" }) - start];""",
        [3, 3, 1.5, 6, 5, 3, 7, 7.5, 3, 0, 0]),
    "a gap has the reason that the recorder wrote down": ("""
        const gaps = [{ since: 5, until: 9, why: "disk" }];
        result = [whyOf(gaps, { since: 8, until: 20 }), whyOf(gaps, { since: 9, until: 20 })];""", ["disk", ""]),
    **{f"with marks at {since} and {until} is exported at {at}": (f"""
        const stretch = stretchOf({since}, {until}, [{{ since: 100, until: 200 }}], {at});
        result = [stretch.since, stretch.until];""", expected)
        for since, until, at, expected in (
            ("null", "null", 150, [100, 200]),  # the session
            ("null", "null", 500, [500, 60_500]),  # a minute
            (120, "null", 150, [120, 200]),
            (300, "null", 500, [300, 60_300]),
            ("null", 180, 150, [100, 180]),
            (120, 180, 999, [120, 180]),
        )},
}
# fmt: on


@rows((run, RUN), (timeline, TIMELINE))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
