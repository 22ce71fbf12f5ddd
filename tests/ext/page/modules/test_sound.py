"""The page's microphone, its talks, the worker of sound and its decoder, with a browser that is made up; in Node.js."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.ext.page.in_node import STATIC, Rows, Script, evaluate, rows

# -- the microphone and talks: a question of the browser is answered by ``answer()`` or ``answer(error)``

_BROWSER = """
const define = (name, value) => Object.defineProperty(globalThis, name, { value, configurable: true });
const questions = [];
const streams = [];
let sources = 0;
let broken = "";
const makeStream = () => {
  const track = { enabled: true, live: true, stop() { this.live = false; } };
  const stream = { track, getTracks: () => [track], get active() { return track.live; } };
  streams.push(stream);
  return stream;
};
const turn = () => new Promise((resolve) => setImmediate(resolve));
const answer = async (error) => {
  const { resolve, reject } = questions.shift();
  error ? reject(error) : resolve(makeStream());
  await turn();
};
const open = () => streams.filter((one) => one.active);
const heard = () => open().filter((one) => one.track.enabled).length;
define("window", globalThis);
define("document", { querySelector: () => null });
define("matchMedia", () => ({ matches: false }));
define("navigator", {
  mediaDevices: { getUserMedia: () => new Promise((resolve, reject) => questions.push({ resolve, reject })) },
});
define("AudioWorkletNode", class { port = { postMessage() {} }; connect() {} });
define("AudioContext", class {
  audioWorklet = { addModule: async () => {} };
  createGain() { return { gain: {}, connect() {} }; }
  createMediaStreamSource() {
    if (broken === "source") throw new Error("no source");
    sources += 1;
    return { connect() {}, disconnect: () => (sources -= 1) };
  }
  resume() {}
  suspend() {}
});
const told = [];
define("Worker", class {
  constructor() { if (broken === "worker") throw new Error("no worker"); }
  postMessage({ op, talk }) { if (op !== "alive") told.push(talk ? `${op} ${talk}` : op); }
  terminate() {}
});
"""

_SOUND = """
const REF = "pebble/robots/goob";
const changes = [];
const route = { ref: REF, onChange: (fn) => changes.push(fn) };
const go = (ref) => { route.ref = ref; changes.forEach((fn) => fn()); };
const shown = [];
const connection = {
  isOpen: true, may: () => true, you: { user: "anna" }, show: (text) => shown.push(text), onChange() {},
};
const store = new Store(undefined, (flush) => flush());
store.set(REF, "capabilities", { value: { audio: { available: true } } });
const sound = new Sound({ store, connection, route });
const talk = async (on) => { sound.talk(on); await turn(); };
"""


microphone = Script(
    {"media/microphone.js": "Microphone"}, f"{_BROWSER}const microphone = new Microphone(new AudioContext());\n"
)


sound = Script({"ui/robot/sound-model.js": "Sound", "core/store.js": "Store"}, _BROWSER + _SOUND, "sound.leave();")


# fmt: off
MICROPHONE: Rows = {
    "a microphone that is opened twice at a time is opened once": ("""
        const both = [microphone.open(), microphone.open()]; await turn();
        result = [questions.length]; await answer(); result.push(await Promise.all(both), streams.length);
        microphone.close(); result.push(open().length, sources);""", [1, ["", ""], 1, 0, 0]),
    "a microphone that cannot be joined is given back and the next attempt begins anew": ("""
        broken = "source"; const first = microphone.open(); await turn(); await answer();
        result = [await first, open().length];
        broken = ""; const second = microphone.open(); await turn(); await answer();
        result.push(await second, open().length, sources); microphone.close();""",
        ["The microphone cannot be opened: no source", 0, "", 1, 1]),
    "a device that was taken away leaves no source": ("""
        for (let i = 0; i < 3; i++) {
          const opened = microphone.open(); await turn(); await answer(); await opened;
          streams.at(-1).track.live = false;
        }
        result = sources;""", 1),
}
# fmt: on


# fmt: off
SOUND: Rows = {
    "a talk uses the microphone which is muted until the next one": ("""
        await talk(true); await answer(); result = [heard()];
        await talk(false); result.push(open().length, heard());
        await talk(true); result.push(heard(), questions.length, [...told]);""",
        [1, 1, 0, 1, 0, ["open", "talk 1", "end", "talk 2"]]),
    "a question that is answered during the next talk is of that talk": ("""
        await talk(true); await talk(false); await talk(true); await answer();
        result = [heard(), streams.length, told.at(-1), sound.talking?.number];""", [1, 1, "talk 2", 2]),
    **{f"a microphone that is granted after the talk is given back: {end}": (
        f"await talk(true); {end}; await answer(); result = [open().length, told.includes('talk 1')];", [0, False])
        for end in ("await talk(false)", "sound.interrupt()", "go('')")},
    **{f"what interrupts a gesture closes the microphone: {before}": (
        f"await talk(true); await answer(); {before} sound.interrupt(); result = [open().length, sound.talking];",
        [0, None]) for before in ("", "await talk(false);")},
    "why a talk has failed is known until the next one or another component": ("""
        const denied = () => Object.assign(new Error("no"), { name: "NotAllowedError" });
        await talk(true); await answer(denied()); result = [sound.problem, sound.talking];
        sound.voice.endedAt = -Infinity; sound.step(); result.push(sound.problem !== "");
        await talk(false); await talk(true); result.push(sound.problem);
        await talk(false); await answer(denied()); result.push(sound.problem !== "");
        go("pebble/robots/minilamp"); result.push(sound.problem);""",
        ['The microphone is blocked: allow it for this page in the browser', None, True, "", True, ""]),
    "a talk that cannot begin is no talk": (
        "broken = 'worker'; await talk(true); result = [sound.talking, sound.problem, questions.length];",
        [None, "Talking has failed: no worker", 0]),
    "a key that cannot talk shows why": (
        "connection.may = () => false; await talk(true); result = [shown, sound.talking];",
        [["Not done: Log in as driver to talk"], None]),
    "over a slow connection no microphone is asked for": (
        "store.set(REF, 'link', { level: 'narrow' }); await talk(true); result = [shown, questions.length];",
        [["Not done: The connection of goob is too slow for a voice"], 0]),
    "a talk that a slow connection ends has its reason beside the button": ("""
        await talk(true); await answer(); store.set(REF, "link", { level: "thin" });
        sound.take({ answer: { talk: 1, on: false, why: sound.talkReason() } });
        result = [sound.talking, sound.problem, sound.talkReason(), heard()];""",
        [None, "", "The connection of goob is too slow for a voice", 0]),
}
# fmt: on


# -- the worker


def test_a_page_that_stood_still_learns_that_its_talk_has_ended() -> None:
    steps = """const define = (name, value) => Object.defineProperty(globalThis, name, { value, configurable: true });
    const said = [];
    define("self", { postMessage: (message) => said.push(message) });
    define("location", { origin: "http://127.0.0.1" });
    define("WebSocket", class { static OPEN = 1; });
    let now = 0;
    performance.now = () => now;
    await import(given);
    self.onmessage({ data: { op: "open", ref: "pebble/robots/goob", port: null, rate: 48_000 } });
    const port = { close() {} };
    self.onmessage({ data: { op: "talk", talk: 3, rate: 16_000, port } });
    const feed = () => port.onmessage({ data: new Float32Array(1024) });
    feed(); now = 900; feed(); result = [said.length]; now = 1100; feed(); result.push(said);"""
    worker = (STATIC / "media" / "sound-worker.js").as_uri()
    assert evaluate({}, steps, worker) == [
        0, [{"answer": {"talk": 3, "on": False, "why": "The page stood still: talk again"}}],
    ]  # fmt: skip


def test_more_sound_than_was_asked_for_is_left_out_and_given_back() -> None:
    steps = """let output; let given_back = 0;
    globalThis.AudioDecoder = class { constructor(parts) { output = parts.output; } configure() {} };
    const packets = [];
    const decoder = new OpusDecoder((packet) => packets.push(packet), () => {});
    decoder.decoder = decoder.open(1);
    output({ close: () => (given_back += 1) });
    decoder.pending = [{ sound: {}, left: 1, parts: [], rate: 0 }];
    try { output({ close: () => (given_back += 1), numberOfFrames: -1 }); } catch {}
    result = [given_back, packets.length];"""
    assert evaluate({"media/opus.js": "OpusDecoder"}, steps) == [2, 0]


def test_the_lead_at_the_loudspeaker_grows_when_the_worker_is_late_and_shrinks_afterwards() -> None:
    """Packets come evenly; the worker stands still twice, then for a minute it does not."""
    steps = """let now = 0;
    performance.now = () => now;
    const RATE = 16_000;
    const port = { waiting: 0, postMessage({ left }) { this.waiting += left.length; } };
    const playout = new Playout(port, RATE);
    let played = 0;
    let removed = 0;
    let sequence = 0;
    const run = (seconds, works = true) => {
      for (const end = now + 1000 * seconds; now < end; now += 4) {
        const pulled = Math.min(64, port.waiting);
        port.waiting -= pulled;
        removed += pulled;
        played += 64;
        if (now % 20 === 0) {
          const samples = new Int16Array(320);
          const sound = { samples, rate: RATE, channels: 1, encoding: "pcm", sequence: ++sequence, capturedMs: now };
          playout.buffer.put(sound, playout.now());
        }
        if (works && now % 8 === 0) port.onmessage({ data: { played, removed } });
      }
      return Math.round(1000 * playout.lead);
    };
    const stats = () => playout.stats().bufferedMs;
    result = [run(5)];
    run(0.1, false);
    run(1);
    run(0.1, false);
    result.push(run(1));
    const many = stats();
    result.push(run(60), stats() < many);"""
    assert evaluate({"media/playout.js": "Playout"}, steps) == [20, 40, 20, True]


@rows((microphone, MICROPHONE), (sound, SOUND))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
