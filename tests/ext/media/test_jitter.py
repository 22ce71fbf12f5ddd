"""The jitter buffer on a clock of its own: what an ear gets to hear when packets come as they like."""

from __future__ import annotations

import random
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from pebble.extensions.media.jitter import Chunk, JitterBuffer
from pebble.extensions.media.packets import Codec, Sound
from pebble.extensions.media.pcm import to_bytes
from pebble.extensions.media.sound import make_sound_encoder
from pebble.extensions.media.speech import Speech

RATE = 16000
LAST = 0xFFFFFFFF
EPOCH_MS = 1_700_000_000_000


@dataclass
class Played:
    """What came out of the buffer, and when."""

    chunks: list[tuple[float, Chunk]]

    @property
    def real(self) -> list[int]:
        """Which packets were heard: each carries its index as its samples."""
        return [int(chunk.samples[len(chunk.samples) // 2, 0]) for _, chunk in self.chunks if not chunk.concealed]

    @property
    def concealed_s(self) -> float:
        return sum(chunk.seconds for _, chunk in self.chunks if chunk.concealed)

    @property
    def stutters(self) -> int:
        """How often the next chunk came later than the one before it ended."""
        return sum(
            later - earlier > chunk.seconds + 1e-6
            for (earlier, chunk), (later, _) in zip(self.chunks, self.chunks[1:], strict=False)
        )


def packet(
    index: int, *, sequence: int | None = None, ms: int | None = None, rate: int = RATE, channels: int = 1
) -> bytes:
    """20 ms in which every sample is ``index``."""
    samples = rate // 50
    body = np.full(samples * channels, index, "<i2").tobytes()
    number = index + 1 if sequence is None else sequence
    return Sound(
        Codec.PCM16LE, channels, rate, samples, number, EPOCH_MS + 20 * index if ms is None else ms, body
    ).pack()


def play(buffer: JitterBuffer, arrivals: Iterable[tuple[float, bytes]]) -> Played:
    """Everything that happens until nothing more is due."""
    chunks = []
    coming = sorted(arrivals, key=lambda arrival: arrival[0])
    now = 0.0
    while True:
        wait = buffer.wait(now)
        if wait is None and not coming:
            return Played(chunks)
        due = now + wait if wait is not None else float("inf")
        if coming and coming[0][0] <= due:
            now, payload = coming.pop(0)
            buffer.put(payload, now)
            continue
        now = due
        chunk = buffer.take(now)
        if chunk is not None:
            chunks.append((now, chunk))


def on_time(count: int, *, first: int = 0, **more: Any) -> list[tuple[float, bytes]]:
    return [(0.02 * index, packet(index, **more)) for index in range(first, first + count)]


# -- all is well


@pytest.mark.parametrize("seed", range(2))
def test_jitter_below_the_target_is_inaudible(seed: int) -> None:
    """Also where numbers wrap to 1, and where packets come twice or in another order."""
    randoms = random.Random(seed)
    numbers = [*range(LAST - 199, LAST + 1), *range(1, 301)]
    arrivals = [
        (0.02 * index + randoms.uniform(0, 0.039), packet(index, sequence=number))
        for index, number in enumerate(numbers)
        for _ in range(randoms.choice((1, 1, 2)))
    ]
    buffer = JitterBuffer(concealment_ms=0)
    played = play(buffer, arrivals)
    assert played.real == list(range(500))
    assert played.stutters == 0
    assert buffer.counters["duplicates"] + buffer.counters["late"] == len(arrivals) - 500
    assert buffer.counters["lost"] == buffer.counters["restarts"] == 0


def test_jitter_above_the_target_is_learnt() -> None:
    randoms = random.Random(3)
    arrivals = [(at + randoms.choice([0, 0.01, 0.13]), raw) for at, raw in on_time(2000)]
    buffer = JitterBuffer()
    played = play(buffer, arrivals)
    late = [at for at, chunk in played.chunks if chunk.concealed and at < 39.9]
    assert sum(at > 20 for at in late) <= sum(at < 20 for at in late)
    assert len(set(played.real)) > 1900
    assert buffer.counters["overflow"] == 0
    stalls = [(max(at, 2 * (at // 2) + 0.12), raw) for at, raw in on_time(2000)]  # every two seconds
    assert [at for at, chunk in play(JitterBuffer(), stalls).chunks if chunk.concealed and 20 < at < 39.9] == []


# -- gaps


@pytest.mark.parametrize("lost", [1, 5])
def test_a_short_gap_is_filled_and_costs_no_time(lost: int) -> None:
    buffer = JitterBuffer()
    arrivals = [arrival for index, arrival in enumerate(on_time(60)) if not 20 <= index < 20 + lost]
    played = play(buffer, arrivals)
    assert played.real == [*range(20), *range(20 + lost, 60)]
    first_after, chunk = next(played_at for played_at in played.chunks if played_at[1].samples[-1, 0] == 20 + lost)
    assert first_after == pytest.approx(0.06 + 0.02 * (20 + lost))
    assert chunk.samples[0, 0] == 0, "it fades in"
    assert played.stutters == 0
    assert buffer.counters["lost"] == lost


@pytest.mark.parametrize("concealment_ms", [0, 50, 130])
def test_when_the_sender_stops_there_is_an_end(concealment_ms: int) -> None:
    buffer = JitterBuffer(concealment_ms=concealment_ms)
    played = play(buffer, on_time(20))
    assert played.concealed_s == pytest.approx(concealment_ms / 1000, abs=1e-4)
    assert buffer.wait(1000.0) is None
    assert buffer.take(1000.0) is None


def test_what_is_made_up_begins_where_the_sound_ended_and_fades_to_nothing() -> None:
    recorded = Speech(RATE).samples(0, 30 * RATE // 50)
    encoder = make_sound_encoder("pcm", rate=RATE, channels=1)
    raw = encoder.encode(to_bytes(recorded), EPOCH_MS)
    played = play(JitterBuffer(), [(0.02 * index, one) for index, one in enumerate(raw)])
    made = np.concatenate([chunk.samples for _, chunk in played.chunks if chunk.concealed])[:, 0].astype(int)
    assert made[0] == pytest.approx(recorded[-1, 0], abs=1)
    assert len(made) == RATE // 10
    assert np.abs(made[-32:]).max() < np.abs(made[:320]).max() / 20 + 1


def test_opus_conceals_with_its_own_means_and_no_longer_than_allowed() -> None:
    encoder = make_sound_encoder("opus", rate=RATE, channels=1, bundle=3)
    recorded = Speech(RATE).samples(0, 2 * RATE)
    raw = encoder.encode(to_bytes(recorded), EPOCH_MS)
    buffer = JitterBuffer()
    played = play(buffer, [(0.06 * index, one) for index, one in enumerate(raw) if index not in (10, 20, 21, 22)])
    assert played.concealed_s == pytest.approx(0.06 + 0.1 + 0.1)
    assert buffer.counters["lost"] == 4
    whole = np.concatenate([chunk.samples for _, chunk in played.chunks])
    assert np.abs(np.diff(whole[:, 0].astype(int))).max() < 12_000


# -- the sender


@pytest.mark.parametrize("before", [3, 50])
def test_a_restarted_sender_is_played_at_once(before: int) -> None:
    again = [
        (0.02 * before + 0.5 + at, packet(index + before, sequence=index + 1))
        for index, (at, _) in enumerate(on_time(30))
    ]
    buffer = JitterBuffer()
    played = play(buffer, [*on_time(before), *again])
    assert played.real == list(range(before + 30))
    assert buffer.counters["restarts"] == 1


@pytest.mark.parametrize(("before", "after", "step"), [(None, 1000, 1), (0, 0, 0)], ids=["another clock", "none"])
def test_a_restarted_sender_whose_clock_tells_nothing_is_played_soon(before: int | None, after: int, step: int) -> None:
    first = [(0.02 * index, packet(index, ms=before)) for index in range(50)]
    again = [
        (1.5 + 0.02 * index, packet(50 + index, sequence=index + 1, ms=after + step * index)) for index in range(30)
    ]
    assert play(JitterBuffer(), [*first, *again]).real == [*range(50), *range(54, 80)]


def test_a_change_of_format_keeps_its_place() -> None:
    first, second = on_time(20), on_time(20, first=20, rate=48000, channels=2)
    played = play(JitterBuffer(), [*first, *second])
    assert played.real == list(range(40))
    assert [(chunk.rate, chunk.channels) for _, chunk in played.chunks[19:21]] == [(16000, 1), (48000, 2)]
    assert played.stutters == 0


# -- too much


def test_the_limit_counts_while_playing_too() -> None:
    buffer = JitterBuffer(limit=10, concealment_ms=0)
    burst = [(0.5, packet(index)) for index in range(20, 100)]
    played = play(buffer, [*on_time(20), *burst])
    assert played.real == [*range(20), *range(90, 100)]


def test_large_packets_are_limited_by_their_bytes() -> None:
    buffer = JitterBuffer()
    for number in range(1, 100):
        buffer.put(Sound(Codec.PCM16LE, 8, 48000, 48000, number, EPOCH_MS + number, bytes(768_000)).pack(), 0.0)
    assert len(buffer) == 5


def test_a_sender_whose_clock_is_fast_adds_no_latency() -> None:
    drift, count = 0.001, 6_000  # two minutes
    arrivals = [(at / (1 + drift), raw) for at, raw in on_time(count)]
    buffer = JitterBuffer()
    played = play(buffer, arrivals)
    indices = [(at, int(chunk.samples[-1, 0])) for at, chunk in played.chunks if not chunk.concealed]
    latency = [at - 0.02 * index / (1 + drift) for at, index in indices]
    assert max(latency) < 0.12
    assert 0 < buffer.counters["skipped"] <= drift * count + 2
    assert buffer.counters["overflow"] == 0


def test_a_player_that_takes_late_is_not_flooded() -> None:
    buffer = JitterBuffer(concealment_ms=0)
    for index in range(40):
        buffer.put(packet(index), 0.0)
    assert buffer.take(0.0) is None
    assert buffer.take(0.06) is not None
    assert buffer.take(5.0) is not None  # it hung for five seconds
    assert buffer.take(5.0) is None
    assert buffer.take(5.02) is not None


# -- rubbish


def test_a_far_number_does_not_silence_the_sender() -> None:
    arrivals = [*on_time(100), (0.5, packet(999, sequence=2_000_000_000, ms=2**62))]
    played = play(JitterBuffer(), arrivals)
    received = [index for index in played.real if index != 999]
    assert len(received) > 90
    assert received[-1] == 99


def hostile(randoms: random.Random, good: list[bytes]) -> bytes:
    choice = randoms.random()
    if choice < 0.2:
        return randoms.randbytes(randoms.randrange(80))
    if choice < 0.4:
        return Sound(
            randoms.choice([1, 1, 2, 7]),
            randoms.randrange(10),
            randoms.choice([0, 1, 4000, 8000, 16000, 48000, 65535]),
            randoms.choice([0, 1, 160, 320, 65535]),
            randoms.choice([0, 1, 2, LAST, randoms.randrange(LAST)]),
            randoms.choice([0, EPOCH_MS, 2**64 - 1]),
            randoms.randbytes(randoms.randrange(700)),
        ).pack()
    raw = bytearray(randoms.choice(good))
    for _ in range(randoms.randrange(4)):
        raw[randoms.randrange(len(raw))] = randoms.randrange(256)
    return bytes(raw[: randoms.randrange(len(raw) + 1)] if choice > 0.9 else raw)


def test_hostile_packets() -> None:
    """They come into a buffer that is being played; afterwards an honest sender must be heard."""
    randoms = random.Random(1)
    recorded = to_bytes(Speech(RATE).samples(0, RATE))
    good = make_sound_encoder("pcm", rate=RATE, channels=1).encode(recorded, EPOCH_MS)
    good += make_sound_encoder("opus", rate=RATE, channels=1, bundle=2).encode(recorded, EPOCH_MS)
    buffer = JitterBuffer(limit=20)
    now = 0.0
    for _ in range(1500):
        now += randoms.choice([0, 0.001, 0.02, 0.3])
        buffer.put(hostile(randoms, good), now)
        assert len(buffer) <= 20
        chunk = buffer.take(now)
        assert chunk is None or (chunk.samples.dtype == np.int16 and chunk.samples.shape[1] == chunk.channels)
        assert chunk is None or 0 < chunk.seconds <= 1
    honest = [(now + 0.02 * index, packet(index, ms=2**63)) for index in range(200)]
    played = play(buffer, honest)
    assert played.real[-150:] == list(range(50, 200))
    assert buffer.counters["refused"] > 150
    assert buffer.counters["packets"] > 150
