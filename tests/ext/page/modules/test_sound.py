"""Sound on the page: microphone and talks, its worker, buffers and resampler; in Node.js, with a made-up browser."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pebble.errors import PayloadError
from pebble.extensions.media import opus
from pebble.extensions.media.jitter import JitterBuffer
from pebble.extensions.media.packets import Codec, Sound
from pebble.extensions.media.pcm import Resampler
from pebble.extensions.media.sound import unpack
from tests.ext.media.test_jitter import play
from tests.ext.page.in_node import STATIC, Rows, Script, evaluate, rows
from tests.support import cases
from tests.vectors import vectors

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
const onChange = (fn) => changes.push(fn);
const route = { ref: REF, onChange };
const go = (ref) => { route.ref = ref; changes.forEach((fn) => fn()); };
const shown = [];
const connection = {
  isOpen: true, may: () => true, you: { user: "anna" }, show: (text) => shown.push(text), onChange,
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


#: What is different, and why no person can talk then.
WHY_NO_TALK = {
    "store.set(REF, 'capabilities', { value: {} })": "goob has no sound",
    "connection.may = () => false": "Log in as driver to talk",
    "navigator.mediaDevices = undefined": "Needs https",
    "store.set(REF, 'link', { level: 'narrow' })": "The connection of goob is too slow for a voice",
    "store.set(REF, 'web/sound', { talker: 'bob' })": "bob is talking",
}
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
    **{f"what interrupts a gesture closes the microphone, and to let go then begins no talk: {before}": (
        f"await talk(true); await answer(); {before} sound.interrupt(); await talk(false);"
        "result = [open().length, sound.talking];", [0, None]) for before in ("", "await talk(false);")},
    "a talk ends where another person uses the page": ("""
        await talk(true); await answer(); go(REF); result = [heard()];
        connection.you = { user: "bob" }; go(REF); result.push(heard(), told.length);""", [1, 0, 3]),
    "nothing is heard while a person talks": ("""
        await talk(true); result = [sound.speaker.gain.gain.value]; await talk(false);
        result.push(sound.speaker.gain.gain.value);""", [0, 1]),
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
    **{f"a key that cannot talk shows why and asks for no microphone: {why}": (
        f"{change}; await talk(true); result = [shown, sound.talking, questions.length];",
        [[f"Not done: {why}"], None, 0]) for change, why in WHY_NO_TALK.items()},
    "a talk that a slow connection ends has its reason beside the button": ("""
        await talk(true); await answer(); store.set(REF, "link", { level: "thin" });
        sound.take({ answer: { talk: 1, on: false, why: sound.talkReason() } });
        result = [sound.talking, sound.problem, sound.talkReason(), heard()];""",
        [None, "", "The connection of goob is too slow for a voice", 0]),
}
# fmt: on


# -- the worker


def test_the_socket_has_the_name_of_the_person_and_a_page_that_stood_still_learns_that_its_talk_has_ended() -> None:
    steps = """const define = (name, value) => Object.defineProperty(globalThis, name, { value, configurable: true });
    const said = [], urls = [];
    define("self", { postMessage: (message) => said.push(message) });
    define("location", { origin: "http://127.0.0.1" });
    let socket;
    define("WebSocket", class { static OPEN = 1; readyState = 1; sent = []; bufferedAmount = 0;
      constructor(url) { urls.push(url); socket = this; } send(piece) { this.sent.push(piece); } });
    let now = 0;
    performance.now = () => now;
    await import(given);
    self.onmessage({ data: { op: "open", ref: "a/b/c", port: null, rate: 48_000, name: "Ann & Bo", device: "phone" } });
    const port = { close() {} };
    self.onmessage({ data: { op: "talk", talk: 3, rate: 16_000, port } });
    const feed = () => port.onmessage({ data: new Float32Array(1024) });
    feed(); now = 900; feed(); result = [said.length]; const { length } = socket.sent;
    socket.bufferedAmount = 10_000; feed(); result.push(length, socket.sent.length); now = 1100; feed();
    result.push(said, Object.fromEntries(new URL(urls[0]).searchParams));"""
    worker = (STATIC / "media" / "sound-worker.js").as_uri()
    assert evaluate({}, steps, worker) == [
        0, 6, 6, [{"answer": {"talk": 3, "on": False, "why": "The page stood still: talk again"}}],
        {"ref": "a/b/c", "can": "", "name": "Ann & Bo", "device": "phone"},
    ]  # fmt: skip


# -- packets, buffer and resampler do exactly what those of pebble.extensions.media do, on the same packets

_UNPACK = """
result = given.map((hex) => {
  try {
    const { rate, channels, frames, sequence } = unpack(new Uint8Array(Buffer.from(hex, "hex")));
    return [rate, channels, frames, sequence];
  } catch { return null; }
});
"""


def unpacked(raw: bytes) -> list[int] | None:
    """Return what pebble.extensions.media.sound finds in a packet; None: it cannot be played."""
    try:
        one = unpack(raw)
    except PayloadError:
        return None
    return [one.rate, one.channels, one.samples, one.sequence]


def test_the_same_packets_can_be_played() -> None:
    """Packets of every kind, and short ones with any byte of their beginning changed."""
    bodies = [[bytes([first, 2, 0])] * count for first in range(256) for count in (1, 3, 4)]
    lasting = [(opus.join(body), 48 * sum(map(opus.milliseconds, body))) for body in bodies]
    packets = [Sound(Codec.OPUS, 1, 48000, int(samples), 1, 1, body).pack() for body, samples in lasting]
    packets += [Sound(Codec.OPUS, 2, 16000, 320, 7, 1, b"\1\1" + bytes([8] * 257)).pack()]
    for channels, rate, samples in itertools.product((8, 9), (3999, 4000), (1, 4000, 4001)):
        packets += [Sound(Codec.PCM16LE, channels, rate, samples, 1, 1, bytes(2 * channels * samples)).pack()]
    known = [bytes.fromhex(one["hex"]) for one in vectors("pbat.json")]
    packets += known
    for packet in [packet for packet in packets[::100] + known if len(packet) < 50]:
        packets += [packet[:at] + bytes([to]) + packet[at + 1 :] for at in range(30) for to in (0, 1, 2, 3, 9, 255)]
    found = evaluate({"media/sound-packet.js": "unpack"}, _UNPACK, [packet.hex() for packet in packets])
    assert found == list(map(unpacked, packets))


EPOCH_MS = 1_700_000_000_000
Arrival = tuple[float, bytes]

_PLAY = """
result = given.map(({ options, arrivals }) => {
  const buffer = new JitterBuffer(options);
  const chunks = [];
  let refused = 0;
  let now = 0;
  for (;;) {
    const wait = !buffer.playing && !buffer.waiting.size ? null : Math.max(0, buffer.due - now);
    if (wait === null && !arrivals.length) break;
    const due = wait === null ? Infinity : now + wait;
    if (arrivals.length && arrivals[0][0] <= due) {
      const [at, payload] = arrivals.shift();
      now = at;
      try {
        const sound = unpack(new Uint8Array(Buffer.from(payload, "hex")));
        buffer.put({ ...sound, samples: pcmOf(sound) }, now);
      } catch { refused++; }
      continue;
    }
    now = due;
    const chunk = buffer.take(now);
    if (chunk) chunks.push([now, chunk.rate, chunk.channels, chunk.concealed, [...chunk.samples]]);
  }
  return { chunks, lost: buffer.lost, refused };
});
"""


def expected_of(options: dict[str, int], arrivals: list[Arrival]) -> dict[str, Any]:
    """Does the same by pebble.extensions.media.jitter."""
    buffer = JitterBuffer(
        limit=options["limit"], concealment_ms=options["concealmentMs"], target_ms=options["targetMs"]
    )
    chunks = [
        [at, chunk.rate, chunk.channels, chunk.concealed, chunk.samples.reshape(-1).tolist()]
        for at, chunk in play(buffer, arrivals).chunks
    ]
    counters = buffer.counters
    return {"chunks": chunks, "lost": counters["lost"] + counters["overflow"], "refused": counters["refused"]}


def arrivals(randoms: random.Random) -> list[Arrival]:
    """What a network, and senders that restart, may make of some seconds of sound."""
    rate, channels = randoms.choice([(16000, 1), (16000, 2), (44100, 1), (8000, 3)])
    jitter, loss = randoms.choice([0.001, 0.03, 0.15, 0.4]), randoms.choice([0, 0.02, 0.2])
    noise = np.random.default_rng(randoms.randrange(1 << 30)).integers(-32768, 32768, 30_000).astype("<i2")
    sequence = randoms.choice([1, 4_294_967_200])
    found: list[Arrival] = []
    at, stalled_until = 0.0, 0.0
    for index in range(300):
        if randoms.random() < 0.01:
            sequence = randoms.choice([1, sequence + randoms.choice([5, 2000]), max(1, sequence - 30)])
        if randoms.random() < 0.01:
            stalled_until = at + randoms.uniform(0.1, 1.5)
        if randoms.random() < 0.005:
            rate, channels = randoms.choice([(16000, 1), (48000, 2), (rate, channels)])
        at += 0.02 if randoms.random() > 0.01 else randoms.uniform(0, 0.8)
        frames = rate // 50
        start = randoms.randrange(len(noise) - frames * channels)
        body = noise[start : start + frames * channels].tobytes()
        ms = EPOCH_MS + 20 * index - (randoms.randrange(2000) if randoms.random() < 0.02 else 0)
        number = (sequence - 1) % 0xFFFF_FFFF + 1
        payload = Sound(Codec.PCM16LE, channels, rate, frames, number, ms, body).pack()
        sequence += 1
        for _ in range(randoms.choice([1] * 50 + [2])):
            if randoms.random() >= loss:
                found.append((max(at + randoms.uniform(0, jitter), stalled_until), payload))
        if randoms.random() < 0.01:
            found.append((at, payload[: randoms.randrange(len(payload))]))
    return sorted(found, key=lambda one: one[0])


@pytest.mark.parametrize("seeds", [range(first, first + 6) for first in range(0, cases(6, 200), 6)], ids=str)
def test_the_jitter_buffer_plays_the_same_samples_at_the_same_times(seeds: range) -> None:
    given, expected = [], []
    for seed in seeds:
        randoms = random.Random(seed)
        options = {
            "limit": randoms.choice([48, 20]),
            "concealmentMs": randoms.choice([100, 0, 250]),
            "targetMs": randoms.choice([61, 37, 5]),  # no multiple of a packet: sums may differ in their last bit
        }
        coming = arrivals(randoms)
        given.append({"options": options, "arrivals": [[at, payload.hex()] for at, payload in coming]})
        expected.append(expected_of(options, coming))
    modules = {"media/jitter.js": "JitterBuffer", "media/sound-packet.js": "pcmOf, unpack"}
    assert evaluate(modules, _PLAY, given) == expected


@pytest.mark.parametrize(("rate", "rate_out"), [(16000, 44100), (48000, 16000), (11025, 48000)])
def test_the_resampler_makes_the_same_samples(rate: int, rate_out: int) -> None:
    sound = np.random.default_rng(7).integers(-8192, 8192, (rate // 2, 1))
    pieces = np.array_split(sound, 23)
    resampler = Resampler(rate, rate_out, 1)
    expected = np.concatenate([resampler.feed(piece) for piece in pieces])[:, 0]
    steps = f"""
const resampler = new Resampler({rate}, {rate_out});
result = given.flatMap((piece) => [...resampler.feed(Float32Array.from(piece))]);
"""
    made = evaluate({"media/resampler.js": "Resampler"}, steps, [piece[:, 0].tolist() for piece in pieces])
    assert len(made) == len(expected)
    assert np.abs(np.array(made) - expected).max() <= 1


@rows((microphone, MICROPHONE), (sound, SOUND))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
