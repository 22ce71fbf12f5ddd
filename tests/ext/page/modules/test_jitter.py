"""The page's sound modules do exactly what those of pebble.extensions.media do, on the same packets; in Node.js."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest

from pebble.extensions.media.jitter import JitterBuffer
from pebble.extensions.media.packets import Codec, Sound
from pebble.extensions.media.pcm import Resampler
from pebble.extensions.media.speech import Speech
from tests.ext.media.test_jitter import play
from tests.ext.page.in_node import evaluate
from tests.support import cases

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
    return {"chunks": chunks, "counters": buffer.counters}


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
    played = []
    for seed in seeds:
        randoms = random.Random(seed)
        options = {
            "limit": randoms.choice([48, 20]),
            "concealmentMs": randoms.choice([100, 0, 250]),
            "targetMs": randoms.choice([61, 37, 5]),  # no multiple of a packet: sums may differ in their last bit
        }
        played.append((options, arrivals(randoms)))
    given = [
        {"options": options, "arrivals": [[at, payload.hex()] for at, payload in coming]} for options, coming in played
    ]
    modules = {"media/jitter.js": "JitterBuffer", "media/sound-packet.js": "pcmOf, unpack"}
    made = evaluate(modules, _PLAY, given)
    for (options, coming), one in zip(played, made, strict=True):
        expected = expected_of(options, coming)
        counters = expected["counters"]
        assert one["chunks"] == expected["chunks"]
        assert (one["lost"], one["refused"]) == (counters["lost"] + counters["overflow"], counters["refused"])


@pytest.mark.parametrize(("rate", "rate_out"), [(16000, 48000), (16000, 44100), (48000, 16000), (44100, 16000)])
def test_the_resampler_makes_the_same_samples(rate: int, rate_out: int) -> None:
    speech = Speech(rate).samples(0, rate // 2)
    pieces = np.array_split(speech, 23)
    resampler = Resampler(rate, rate_out, 1)
    expected = np.concatenate([resampler.feed(piece) for piece in pieces])[:, 0]
    steps = f"""
const resampler = new Resampler({rate}, {rate_out});
result = given.flatMap((piece) => [...resampler.feed(Float32Array.from(piece))]);
"""
    made = evaluate({"media/resampler.js": "Resampler"}, steps, [piece[:, 0].tolist() for piece in pieces])
    assert len(made) == len(expected)
    assert np.abs(np.array(made) - expected).max() <= 1
