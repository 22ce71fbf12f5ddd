"""What plays a recording, without a browser: its messages, its time, its gaps, and the day around it."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from pebble.recordings.seek.segment import Flag
from tests.web.in_node import evaluate

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
const every = (from, to, step = 100) => Array.from({ length: (to - from) / step }, (_, i) => from + i * step);
"""


def run(steps: str, given: Any = None) -> Any:
    imports = {"core/replay/player.js": "* as player", "core/replay/archive.js": "RefusedError"}
    return evaluate(imports, PLAYER + f"result = await (async () => {{ {steps} }})();", given)


def packed(at: float, flags: int, metric: bytes, payload: bytes) -> bytes:
    body = struct.pack(">dBH", at, flags, len(metric)) + metric + payload
    return struct.pack(">I", len(body)) + body


def read(data: bytes) -> Any:
    steps = """const { frames, problem } = readFrames(Uint8Array.from(given).buffer);
    result = [frames.map(({ at, flags, metric, payload }) => [at, flags, metric, [...payload]]), problem];"""
    return evaluate({"core/replay/frames.js": "readFrames"}, steps, list(data))


TWO = packed(AT + 0.25, 12, b"front-camera", b"\0\xff") + packed(AT + 1, 0, "größe".encode(), b"")
BOTH = [[AT + 0.25, 12, "front-camera", [0, 255]], [AT + 1, 0, "größe", []]]


def test_messages_are_read_as_they_were_packed():
    assert read(TWO) == [BOTH, ""]
    assert read(b"") == [[], ""]


@pytest.mark.parametrize("size", range(1, len(TWO)))
def test_what_is_whole_is_read_of_an_answer_that_is_cut_short(size: int):
    frames, problem = read(TWO[:size])
    first = len(packed(AT, 0, b"front-camera", b"\0\xff"))
    assert frames == BOTH[: size // first]
    assert (problem == "") == (size == first)


@pytest.mark.parametrize(
    "garbage",
    [
        struct.pack(">I", 3) + b"abc",
        struct.pack(">I", 1 << 31) + b"a" * 40,
        packed(AT, 0, b"m", b"")[:-1] + b"",
        struct.pack(">I", 11) + struct.pack(">dBH", AT, 0, 500),
        packed(float("nan"), 0, b"m", b""),
        packed(float("inf"), 0, b"m", b""),
        packed(-1.0, 0, b"m", b""),
    ],
)
def test_garbage_ends_the_reading_with_a_reason(garbage: bytes):
    frames, problem = read(TWO + garbage)
    assert frames == BOTH
    assert f"at byte {len(TWO)} of" in problem


def test_flags_are_those_of_the_server():
    names = "STATE, CHAIN, INCOMING, PICTURE, SOUND"
    found = evaluate({"core/replay/frames.js": names}, f"result = [{names}];")
    assert found == [Flag.STATE, Flag.CHAIN, Flag.INCOMING, Flag.PICTURE, Flag.SOUND]


def test_what_is_due_is_delivered_in_order_and_once():
    assert run("""const it = make(); it.player.seek(1000); await it.pass(20); it.player.play(); await it.pass(3000);
        return it.delivered;""") == [1000 + 100 * n for n in range(31)]


@pytest.mark.parametrize("speed", [0.25, 0.5, 1, 2, 4, 8])
def test_speed(speed: float):
    position = run(f"""const it = make(); it.player.seek(1000); await it.pass(100); it.player.setSpeed({speed});
        it.player.play(); await it.pass(2000); return it.player.position;""")
    assert position == pytest.approx(1000 + 2000 * speed, abs=25 * speed)


def test_little_is_loaded_ahead_and_less_of_what_is_large():
    assert run("""const it = make(); it.player.seek(1000); await it.pass(60); it.player.play(); let most = 0;
        for (let i = 0; i < 200; i++) { await it.pass(20); most = Math.max(most, it.player.ahead); }
        return [most <= 6000, most > 3000, it.asked.length < 8];""") == [True, True, True]
    assert run("""const it = make({ size: 400_000 }); it.player.seek(1000); await it.pass(60); it.player.play();
    let most = 0;
        for (let i = 0; i < 200; i++) { await it.pass(20); most = Math.max(most, it.player.bytes); }
        return [most <= 16_000_000, it.player.position > 4500];""") == [True, True]


def test_a_seek_forgets_what_was_and_begins_with_the_state_and_the_pictures_before():
    assert run("""const it = make({ extra: [1, 2 | 8] }); it.player.seek(1000); await it.pass(60); it.player.play();
        await it.pass(500); it.player.seek(30_000); const first = it.asked.at(-1)[3].aborted; await it.pass(40);
        return [it.resets, it.delivered.slice(0, 4), it.asked.filter((one) => one[2]).map((one) => one[0]),
        it.player.playing, first];
        """) == [[1000, 30_000], [29_990, 29_990, 30_000], [1000, 30_000], True, False]


def test_only_the_last_of_many_seeks_arrives():
    assert run("""const it = make(); it.hold = true;
        for (let n = 0; n < 50; n++) it.player.seek(1000 * n);
        it.hold = false; it.held.forEach((go) => go()); await it.pass(40);
        return [it.resets, it.asked.filter((one) => !one[3].aborted).length];""") == [[49_000], 1]


def test_a_gap_is_left_out_and_shown():
    assert run("""const it = make({ frames: [...every(0, 3000), ...every(203_000, 220_000)] });
        it.player.seek(1000); await it.pass(60); it.player.play(); await it.pass(2700);
        const { since, until } = it.player.skipped; const at = it.player.position; await it.pass(1000);
        const on = it.delivered.at(-1);
        await it.pass(6000); return [since, until, at >= 203_000 && at < 204_000, on > 203_400, it.player.skipped];
        """) == [2900, 203_000, True, True, None]


def test_a_gap_is_known_by_what_came_before_it_even_if_the_server_first_answers_with_nothing():
    """A segment that has messages says where it ends, not where the next one is."""
    assert run("""const it = make({ frames: [...every(0, 3000), ...every(203_000, 220_000)] }); const plain = it.answer;
        it.answer = (...all) => { const made = plain(...all);
        return made.frames.length ? { ...made, next: made.until } : made; };
        it.player.seek(1000); await it.pass(60); it.player.play(); await it.pass(4500);
        const { since, until } = it.player.skipped; return [since, until];""") == [2900, 203_000]


def test_a_seek_into_a_gap_plays_from_its_end():
    assert run("""const it = make({ frames: [...every(0, 3000), ...every(203_000, 220_000)] });
        it.player.seek(50_000); await it.pass(60); const before = it.player.position; it.player.play();
        await it.pass(60);
        return [before, it.player.position >= 203_000];""") == [50_000, True]


def test_a_short_silence_is_played():
    assert run("""const it = make({ frames: [...every(0, 3000), ...every(4500, 9000)] });
        it.player.seek(1000); await it.pass(60); it.player.play(); await it.pass(3000);
        return [it.player.skipped, it.player.position < 4200];""") == [None, True]


def test_it_ends_and_goes_on_when_more_was_recorded():
    assert run("""const frames = every(0, 3000); const it = make({ frames }); it.player.seek(1000); await it.pass(60);
        it.player.play(); await it.pass(3000); const ended = [it.player.ended, it.player.playing, it.player.position];
        frames.push(...every(3000, 9000)); it.player.play(); await it.pass(2000);
        return [...ended, it.player.playing, it.player.position > 4000];""") == [True, False, 2900, True, True]


def test_a_failure_is_shown_and_tried_again_while_the_time_stands_still():
    assert run("""const it = make(); it.player.seek(1000); await it.pass(60); it.player.play(); await it.pass(200);
        it.fail = new Error("network"); await it.pass(20_000);
        const during = [it.player.problem, it.player.waiting, it.player.playing, it.asked.length < 20];
        const at = it.player.position;
        await it.pass(2000); const still = it.player.position === at; it.fail = null; await it.pass(6000);
        return [...during, still, it.player.problem, it.player.position > at];
        """) == ["network", True, True, True, True, "", True]


def test_what_the_server_refuses_is_not_asked_again():
    assert run("""const it = make(); it.fail = new RefusedError("log in"); it.player.seek(1000); it.player.play();
    await it.pass(9000);
        const asked = it.asked.length; it.fail = null; it.player.play(); await it.pass(500);
        return [asked, it.player.problem, it.player.position > 1000];""") == [1, "", True]


def test_the_time_stands_still_while_pictures_are_behind():
    assert run("""const it = make(); it.player.seek(1000); await it.pass(60); it.player.play(); await it.pass(100);
    it.busy = true;
        const at = it.player.position; await it.pass(1000); const still = it.player.position === at; it.busy = false;
        await it.pass(1000); return [still, it.player.position - at];""") == [True, 1000]


def test_sound_is_delivered_earlier_by_its_lead():
    assert run("""const it = make(); const plain = it.answer;
        it.answer = (...all) => { const made = plain(...all);
          return { ...made, frames: made.frames.map((one) => ({ ...one, flags: 16 })) }; };
        it.lead = 100; it.player.seek(1000); await it.pass(60); const paused = it.delivered.at(-1); it.player.play();
        await it.pass(200);
        return [paused, it.delivered.at(-1)];""") == [1000, 1300]


def test_a_recording_of_heartbeats_shows_when_the_robot_was_silent():
    steps = """const beats = new Heartbeats(); const views = [beats.view(1000)];
    for (let t = 1000; t <= 3000; t += 250) beats.receive(t, { t: t - 42 });
    views.push(beats.view(3100), beats.view(9000)); beats.receive(9100, { t: 9090, online: false });
    views.push(beats.view(9100));
    result = views.map(({ online, latency_ms, interval_ms }) => [online, latency_ms, interval_ms]);"""
    found = evaluate({"core/replay/liveness.js": "Heartbeats"}, steps)
    assert found[:3] == [[None, None, None], [True, 42, 250], [False, 42, 250]]
    assert found[3][0] is False


def test_what_was_sent_is_listed_without_a_line_for_each_command():
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


VIEW = "const view = new View('2026-11-22');"


def test_a_day_is_zoomed_and_moved_within_its_bounds():
    steps = f"""{VIEW} const start = view.start;
    const state = () => [(view.from - start) / 3.6e6, (view.to - start) / 3.6e6];
    result = [state()]; view.zoom(2, start + 6 * 3.6e6); result.push(state()); view.move(-99e9); result.push(state());
    view.move(99e9); result.push(state()); view.zoom(1e9, view.to); result.push(view.span); view.zoom(1e-9, view.to);
    result.push(state());
    view.zoom(24, start); result.push(view.follow(start + 5 * 3.6e6), view.follow(start + 5 * 3.6e6));"""
    found = evaluate({"core/replay/timeline.js": "View"}, steps)
    assert found == [[0, 24], [3, 15], [0, 12], [12, 24], 60_000, [0, 24], True, False]


def test_columns_show_what_happened_in_any_of_their_steps():
    steps = f"""{VIEW} const n = 8640, zero = () => new Array(n).fill(0);
    const timeline = {{ from: view.start, step: 10_000, activity: zero(), video: zero(), audio: zero(), rest: zero() }};
    timeline.activity[0] = 1; timeline.activity[4321] = 32; timeline.video[4321] = 200; timeline.rest[4321] = 12;
    const {{ bits, kbits }} = columns(timeline, view, 100);
    result = [bits[0], bits[1], bits[50], kbits[50], mostKbits(timeline), extentOf(timeline, view)[1] / 10_000];"""
    found = evaluate({"core/replay/timeline.js": "View, columns, mostKbits, extentOf"}, steps)
    assert found == [1, 0, 32, 212, 212, pytest.approx(4322 * 1.08)]


def test_ticks_are_round_in_the_time_of_the_wall():
    steps = f"""{VIEW} view.show(view.start + 600_000, 3_600_000); const ticks = view.ticks(600, 90, 5.5 * 3.6e6);
    result = [ticks.length, ticks.map(({{ at }}) => (at - view.start + 5.5 * 3.6e6) % ticks[0].step), ticks[0].step];"""
    count, rests, step = evaluate({"core/replay/timeline.js": "View"}, steps)
    assert (count, set(rests), step) == (6, {0}, 600_000)


@pytest.mark.parametrize(
    ("marks", "at", "expected"),
    [
        (("null", "null"), 150, [100, 200]),  # the session
        (("null", "null"), 500, [500, 60_500]),  # a minute
        ((120, "null"), 150, [120, 200]),
        ((300, "null"), 500, [300, 60_300]),
        (("null", 180), 150, [100, 180]),
        ((120, 180), 999, [120, 180]),
    ],
)
def test_what_is_exported(marks: tuple[Any, Any], at: int, expected: list[int]):
    steps = f"const {{ since, until }} = stretchOf({marks[0]}, {marks[1]}, [{{ since: 100, until: 200 }}], {at});"
    assert evaluate({"core/replay/timeline.js": "stretchOf"}, steps + "result = [since, until];") == expected


def test_answers_of_the_server():
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
