"""What plays a recording, without a browser: its messages, its time, its gaps, and the day around it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import pytest

from pebble.recordings.seek.segment import Flag
from tests.web.in_node import Rows, Script, evaluate, rows

AT = 1_795_341_600_000.0

#: A player over made-up messages every 100 ms, with a clock that only ``pass`` moves, and a server that only
#: ``answer`` is.
PLAYER = """
const { Player } = player;
const bytes = (n) => new Uint8Array(n);
function make({ frames = every(0, 60_000), gaps = [], size = 10, extra = [] } = {}) {
  const it = { now: 0, asked: [], delivered: [], resets: [], fail: null, busy: false, lead: 0, hold: false, held: [] };
  it.answer = (at, lasts, seek) => {
    const until = at + lasts;
    const mine = frames.filter((t) => t >= at && t < until).map((t) => ({ at: t, flags: 0, metric: "m", payload:
    bytes(size) }));
    const before = seek ? extra.map((flags) => ({ at: at - 10, flags, metric: "b", payload: bytes(1) })) : [];
    const next = frames.find((t) => t >= until);
    const total = size * mine.length;
    return { frames: [...before, ...mine], problem: "", until, next: next === undefined ? null : Math.max(until, next),
      complete: true, bytes: total };
  };
  it.player = new Player({
    clock: () => it.now,
    load: async (at, lasts, seek, signal) => {
      it.asked.push([at, lasts, seek, signal]);
      if (it.hold) await new Promise((resolve) => it.held.push(resolve));
      if (it.fail) throw it.fail;
      return it.answer(at, lasts, seek);
    },
    deliver: (list) => it.delivered.push(...list.map((one) => one.at)),
    reset: (at) => { it.resets.push(at); it.delivered = []; },
    busy: () => it.busy,
    soundLead: () => it.lead,
  });
  it.pass = async (ms, step = 20) => {
    for (let gone = 0; gone < ms; gone += step) {
      it.now += step;
      it.player.tick();
      for (let i = 0; i < 6; i++) await null;
    }
  };
  return it;
}
const playing = async (options) => {
  const it = make(options);
  it.player.seek(1000);
  await it.pass(60);
  it.player.play();
  return it;
};
const every = (from, to, step = 100) => Array.from({ length: (to - from) / step }, (_, i) => from + i * step);
const GAPPED = { frames: [...every(0, 3000), ...every(203_000, 220_000)] };
"""


run = Script(
    {"core/replay/player.js": "* as player", "core/replay/archive.js": "RefusedError"},
    PLAYER + "result = await (async () => {",
    "})();",
)


def packed(at: float, flags: int, metric: bytes, payload: bytes) -> bytes:
    body = struct.pack(">dBH", at, flags, len(metric)) + metric + payload
    return struct.pack(">I", len(body)) + body


TWO = packed(AT + 0.25, 12, b"front-camera", b"\0\xff") + packed(AT + 1, 0, "größe".encode(), b"")
BOTH = [[AT + 0.25, 12, "front-camera", [0, 255]], [AT + 1, 0, "größe", []]]


def test_flags_are_those_of_the_server() -> None:
    names = "STATE, CHAIN, INCOMING, PICTURE, SOUND"
    found = evaluate({"core/replay/frames.js": names}, f"result = [{names}];")
    assert found == [Flag.STATE, Flag.CHAIN, Flag.INCOMING, Flag.PICTURE, Flag.SOUND]


reading = Script(
    {"core/replay/frames.js": "readFrames"},
    "const read = (hex) => { const { frames, problem } = readFrames(new Uint8Array(Buffer.from(hex, 'hex')).buffer);"
    "return [frames.map(({ at, flags, metric, payload }) => [at, flags, metric, [...payload]]), problem]; };",
)
FIRST = len(packed(AT, 0, b"front-camera", b"\0\xff"))
GARBAGE = {
    "too short": struct.pack(">I", 3) + b"abc",
    "too long": struct.pack(">I", 1 << 31) + b"a" * 40,
    "cut short": packed(AT, 0, b"m", b"")[:-1],
    "its metric is longer than it": struct.pack(">I", 11) + struct.pack(">dBH", AT, 0, 500),
    **{f"time {at}": packed(at, 0, b"m", b"") for at in (float("nan"), float("inf"), -1.0)},
}
# fmt: off
READ: Rows = {
    "messages are read as they were packed": (f"result = [read('{TWO.hex()}'), read('')];", [[BOTH, ""], [[], ""]]),
    **{f"what is whole of the first {size} bytes is read": (f"""
        const [frames, problem] = read('{TWO[:size].hex()}'); result = [frames, problem === ''];""",
        [BOTH[: size // FIRST], size == FIRST]) for size in range(1, len(TWO))},
    **{f"garbage ends the reading with a reason: {what}": (f"""
        const [frames, problem] = read('{(TWO + garbage).hex()}');
        result = [frames, problem.includes("at byte {len(TWO)} of")];""", [BOTH, True])
        for what, garbage in GARBAGE.items()},
}
RUN: Rows = {
    **{f"speed {speed}": (f"""
        const it = make(); it.player.seek(1000); await it.pass(100); it.player.setSpeed({speed});
        it.player.play(); await it.pass(2000); return it.player.position;""",
        pytest.approx(1000 + 2000 * speed, abs=25 * speed)) for speed in (0.25, 0.5, 1, 2, 4, 8)},
    "what is due is delivered in order and once": ("""
        const it = make(); it.player.seek(1000); await it.pass(20); it.player.play(); await it.pass(3000);
        return it.delivered;""", [1000 + 100 * n for n in range(31)]),
    "little is loaded ahead": ("""
        const it = await playing(); let most = 0;
        for (let i = 0; i < 200; i++) { await it.pass(20); most = Math.max(most, it.player.ahead); }
        return [most <= 12_000, most > 9000, it.asked.length < 11];""", [True, True, True]),
    "less is loaded ahead of what is large": ("""
        const it = await playing({ size: 400_000 });
        let most = 0;
        for (let i = 0; i < 200; i++) { await it.pass(20); most = Math.max(most, it.player.bytes); }
        return [most <= 16_000_000, it.player.position > 4500];""", [True, True]),
    "a seek forgets what was and begins with the state and the pictures before": ("""
        const it = await playing({ extra: [1, 2 | 8] });
        await it.pass(500); it.player.seek(30_000); const first = it.asked.at(-1)[3].aborted; await it.pass(40);
        return [it.resets, it.delivered.slice(0, 4), it.asked.filter((one) => one[2]).map((one) => one[0]),
        it.player.playing, first];""", [[1000, 30_000], [29_990, 29_990, 30_000], [1000, 30_000], True, False]),
    "only the last of many seeks arrives": ("""
        const it = make(); it.hold = true;
        for (let n = 0; n < 50; n++) it.player.seek(1000 * n);
        it.hold = false; it.held.forEach((go) => go()); await it.pass(40);
        return [it.resets, it.asked.filter((one) => !one[3].aborted).length];""", [[49_000], 1]),
    "a gap is left out and shown": ("""
        const it = await playing(GAPPED); await it.pass(2700);
        const { since, until } = it.player.skipped; const at = it.player.position; await it.pass(1000);
        const on = it.delivered.at(-1);
        await it.pass(6000); return [since, until, at >= 203_000 && at < 204_000, on > 203_400, it.player.skipped];""",
        [2900, 203_000, True, True, None]),
    # A segment that has messages says where it ends, not where the next one is.
    "a gap is known by what came before it even if the server first answers with nothing": ("""
        const it = make(GAPPED); const plain = it.answer;
        it.answer = (...all) => { const made = plain(...all);
        return made.frames.length ? { ...made, next: made.until } : made; };
        it.player.seek(1000); await it.pass(60); it.player.play(); await it.pass(4500);
        const { since, until } = it.player.skipped; return [since, until];""", [2900, 203_000]),
    "a seek into a gap plays from its end": ("""
        const it = make(GAPPED);
        it.player.seek(50_000); await it.pass(60); const before = it.player.position; it.player.play();
        await it.pass(60);
        return [before, it.player.position >= 203_000];""", [50_000, True]),
    "a short silence is played": ("""
        const it = await playing({ frames: [...every(0, 3000), ...every(4500, 9000)] }); await it.pass(3000);
        return [it.player.skipped, it.player.position < 4200];""", [None, True]),
    "it ends and goes on when more was recorded": ("""
        const frames = every(0, 3000); const it = await playing({ frames });
        await it.pass(3000); const ended = [it.player.ended, it.player.playing, it.player.position];
        frames.push(...every(3000, 9000)); it.player.play(); await it.pass(2000);
        return [...ended, it.player.playing, it.player.position > 4000];""", [True, False, 2900, True, True]),
    "a failure is shown and tried again while the time stands still": ("""
        const it = await playing(); await it.pass(200);
        it.fail = new Error("network"); await it.pass(20_000);
        const during = [it.player.problem, it.player.waiting, it.player.playing, it.asked.length < 20];
        const at = it.player.position;
        await it.pass(2000); const still = it.player.position === at; it.fail = null; await it.pass(6000);
        return [...during, still, it.player.problem, it.player.position > at];""",
        ["network", True, True, True, True, "", True]),
    "what the server refuses is not asked again": ("""
        const it = make(); it.fail = new RefusedError("log in"); it.player.seek(1000); it.player.play();
        await it.pass(9000);
        const asked = it.asked.length; it.fail = null; it.player.play(); await it.pass(500);
        return [asked, it.player.problem, it.player.position > 1000];""", [1, "", True]),
    "the time stands still while pictures are behind": ("""
        const it = await playing(); await it.pass(100);
        it.busy = true;
        const at = it.player.position; await it.pass(1000); const still = it.player.position === at; it.busy = false;
        await it.pass(1000); return [still, it.player.position - at];""", [True, 1000]),
    "sound is delivered earlier by its lead": ("""
        const it = make(); const plain = it.answer;
        it.answer = (...all) => { const made = plain(...all);
          return { ...made, frames: made.frames.map((one) => ({ ...one, flags: 16 })) }; };
        it.lead = 100; it.player.seek(1000); await it.pass(60); const paused = it.delivered.at(-1); it.player.play();
        await it.pass(200);
        return [paused, it.delivered.at(-1)];""", [1000, 1300]),
}
# fmt: on


def test_a_recording_of_heartbeats_shows_when_the_robot_was_silent() -> None:
    steps = """const beats = new Heartbeats(); const views = [beats.view(1000)];
    for (let t = 1000; t <= 3000; t += 250) beats.receive(t, { t: t - 42 });
    views.push(beats.view(3100), beats.view(9000)); beats.receive(9100, { t: 9090, online: false });
    views.push(beats.view(9100));
    result = views.map(({ online, latency_ms, interval_ms }) => [online, latency_ms, interval_ms]);"""
    found = evaluate({"core/replay/liveness.js": "Heartbeats"}, steps)
    assert found[:3] == [[None, None, None], [True, 42, 250], [False, 42, 250]]
    assert found[3][0] is False


def test_what_was_sent_is_listed_without_a_line_for_each_command() -> None:
    steps = """const incoming = new Incoming();
    for (let t = 0; t < 2000; t += 100) incoming.take(t, "drive-values", { x: 0.25, z: t / 1e9 + 3 }, 9);
    incoming.take(2000, "lights", { r: 1 }, 9); incoming.take(2100, "lights", { r: 0 }, 9);
    incoming.take(2200, "audio-stream", undefined, 664);
    for (let n = 0; n < 400; n++) incoming.take(9000 + 2000 * n, "estop", {}, 2);
    result = [incoming.drive, incoming.lines.length]; incoming.clear(); incoming.take(1, "x", undefined, 5);
    result.push(incoming.lines.map(({ text, count }) => [text, count]));"""
    drive, lines, last = evaluate({"core/replay/incoming.js": "Incoming"}, steps)
    assert drive == {"at": 1900, "x": 0.25, "z": 1}
    assert lines == 100
    assert last == [["5 bytes", 1]]


def test_answers_of_the_server() -> None:
    steps = """const answers = [
      new Response(new Uint8Array(0), { headers: { "x-next": "2500.5", "x-complete": "0" } }),
      new Response(new Uint8Array(0), { headers: { "x-next": "" } }),
      new Response("robot: none\\nmore", { status: 400 }), new Response("", { status: 503 }), new Response("", {
      status: 401 }),
    ];
    const asked = []; const archive = new Archive(async (url) => { asked.push(url); return answers.shift(); });
    const never = new AbortController().signal; result = [];
    for (let n = 0; n < 5; n++) await archive.segment("a/b/c", 1000.7, 500, n === 0, never).then(
      ({ next, complete, until }) => result.push([next, complete, until]),
      (error) => result.push([error instanceof RefusedError, error.message]));
    result.push(asked[0].replace(ROOT, "/"));"""
    imports = {"core/replay/archive.js": "Archive, RefusedError", "core/browser.js": "ROOT"}
    assert evaluate(imports, steps) == [
        [2500.5, False, 1500],
        [None, True, 1500],
        [True, "robot: none"],
        [False, "the server failed (503)"],
        [True, "log in again: the session has ended"],
        "/archive/segment?robot=a%2Fb%2Fc&at=1000&for=500&seek=1",
    ]


timeline = Script(
    {"core/replay/timeline.js": "View, columns, extentOf, stretchOf"},
    "const view = new View('2026-11-22'), start = view.start;",
)
# fmt: off
TIMELINE: Rows = {
    "a day is zoomed and moved within its bounds": ("""
        const state = () => [(view.from - start) / 3.6e6, (view.to - start) / 3.6e6];
        result = [state()]; view.zoom(2, start + 6 * 3.6e6); result.push(state());
        view.move(-99e9); result.push(state()); view.move(99e9); result.push(state());
        view.zoom(1e9, view.to); result.push(view.span); view.zoom(1e-9, view.to); result.push(state());
        view.zoom(24, start); result.push(view.follow(start + 5 * 3.6e6), view.follow(start + 5 * 3.6e6));""",
        [[0, 24], [3, 15], [0, 12], [12, 24], 60_000, [0, 24], True, False]),
    "columns show what happened in any of their steps": ("""
        const timeline = { from: start, step: 10_000, activity: new Array(8640).fill(0) };
        timeline.activity[0] = 1; timeline.activity[4321] = 32;
        const bits = columns(timeline, view, 100);
        result = [bits[0], bits[1], bits[50], extentOf(timeline, view)[1] / 10_000];""",
        [1, 0, 32, pytest.approx(4322 * 1.08)]),
    "ticks are round in the time of the wall": ("""
        view.show(start + 600_000, 3_600_000); const ticks = view.ticks(600, 90, 5.5 * 3.6e6);
        const rests = ticks.map(({ at }) => (at - start + 5.5 * 3.6e6) % ticks[0].step);
        result = [rests, ticks[0].step];""", [[0] * 6, 600_000]),
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


@rows((reading, READ), (run, RUN), (timeline, TIMELINE))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
