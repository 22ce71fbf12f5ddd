"""What the publisher does with sound while the link takes nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest

from pebble.config import parse
from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.packets import Sound
from pebble.extensions.media.sound import ReceivedSound, SoundDecoder
from pebble.extensions.media.speech import PERIOD_S, Speech
from pebble.services.audio_publisher import service
from pebble.services.audio_publisher.rate_control import LevelControl, Step, steps
from pebble.services.audio_publisher.service import AudioPublisher
from pebble.transports import Message, Transport
from pebble.transports.base import Outgoing
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.av.media_rig import Device, MediaProgram, Operator
from tests.kit.sound import best_match, envelope
from tests.support import Broker, until

CHUNK_S = 0.02
CHUNK = bytes(640)  # 20 ms at 16 kHz
SOUND = FrameInfo(format="s16le", rate=16_000, channels=1, captured_ms=1)


class Stuck(MemoryTransport):
    """Accepts everything, and confirms all but the newest packets, ``behind`` of them."""

    def __init__(self, behind: int) -> None:
        super().__init__("stuck", MemoryHub())
        self.behind = behind
        self.packets: list[bytes] = []

    @property
    def outgoing(self) -> Outgoing:
        unconfirmed = self.packets[max(0, len(self.packets) - self.behind) :]
        return Outgoing(waiting=sum(len(packet) + 60 for packet in unconfirmed))

    def _send(self, message: Message, urgent: bool) -> bool:
        self.packets.append(message.payload)
        return True


Make = Callable[..., AudioPublisher]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Make:
    """Makes a publisher with these options that sends by ``transport``; it does not run."""

    def made(transport: Transport, *, profile: str = "wide", **options: Any) -> AudioPublisher:
        monkeypatch.setattr(service, "remote_transport", lambda *_: transport.open())
        bridge = {"media": {"audio_publisher": options}, "link": {"profile": profile}}
        config = parse({"robot": {"id": "rover"}, "services": {"mqtt_bridge": bridge}}, folder=tmp_path, env={})
        return AudioPublisher(config, MemoryTransport("robot", MemoryHub()), clock=lambda: 0.0)

    return made


@pytest.mark.parametrize(("encoding", "most_s"), [("pcm", 0.2), ("opus", 0.5)])
def test_sound_waits_for_so_long_and_then_the_newest_is_dropped(make: Make, encoding: str, most_s: float) -> None:
    publisher = make(Stuck(1000), encoding=encoding, bundle=1)
    number = 0
    while not publisher.counters["dropped"] and number < 100:
        publisher.take(SOUND, CHUNK, number * CHUNK_S)
        number += 1
    assert number * CHUNK_S == pytest.approx(most_s, abs=5 * CHUNK_S)  # Opus may wait for a bundle
    assert publisher.encoding == encoding


def test_sound_gets_larger_and_smaller_and_none_is_lost(make: Make) -> None:
    publisher = make(transport := Stuck(0), encoding="opus", bundle=2)
    steps = []
    for number in range(1, 300):
        transport.behind = 7 if number > 150 else 0
        info = FrameInfo(format="s16le", rate=16_000, channels=1, captured_ms=20 * number)  # of its end
        publisher.take(info, CHUNK, number * CHUNK_S)
        steps += [publisher.reduced] if steps[-1:] != [publisher.reduced] else []
    three, least = "3 parts a packet", "3 parts a packet, 16 kbit/s"
    assert steps == [least, three, "", three, least]
    received = [Sound.unpack(packet) for packet in transport.packets]
    ends_ms = [sound.captured_ms + sound.samples // 16 for sound in received]
    assert [sound.captured_ms for sound in received] == [0, *ends_ms[:-1]]
    assert publisher.counters["dropped"] == 0


@pytest.mark.parametrize(("profile", "rest_s"), [("thin", 2.6), ("wide", 0.0)])
def test_on_a_thin_link_a_slow_packet_is_followed_by_a_rest(make: Make, profile: str, rest_s: float) -> None:
    publisher = make(transport := Stuck(0), encoding="opus", bundle=1, profile=profile)
    sent_at = []
    for number in range(250):
        before, now = len(transport.packets), number * CHUNK_S
        transport.behind = 99 if now < 0.3 else 0
        publisher.take(SOUND, CHUNK, now)
        sent_at += [now] * (len(transport.packets) - before)
    assert max(b - a for a, b in pairwise(sent_at)) == pytest.approx(rest_s, abs=0.1)


# -- what is reduced


def changes(levels: LevelControl, age_s: float, at: float) -> bool:
    before = levels.level
    levels.poll(age_s, at)
    return levels.level != before


def watch(levels: LevelControl, age_s: float, begin: float, seconds: float) -> list[float]:
    """A poll every 20 ms; returns when the level changed."""
    times = (begin + 0.02 * number for number in range(round(50 * seconds)))
    return [round(at, 2) for at in times if changes(levels, age_s, at)]


def test_steps_save_headers_first_and_then_bits() -> None:
    assert [(step.bundle, step.bitrate) for step in steps(1, 24_000)] == [(1, 24_000), (3, 24_000), (3, 16_000)]
    assert [(step.bundle, step.bitrate) for step in steps(3, 24_000)] == [(3, 24_000), (3, 16_000)]
    assert steps(3, 12_000) == (Step(3, 12_000),)


def at_ease() -> LevelControl:
    """Return a control that has learnt by 5.0 that the link takes everything, but for moments."""
    levels = LevelControl(2, 0.0)
    watch(levels, 0.0, 0.0, 5.0)
    assert levels.level == 0
    return levels


#: How old what waits is, for so many seconds from the start, the changes of the level meanwhile, and the level then.
FROM_THE_START = {
    "it begins small and has everything soon": (0.06, 2.5, 2, 0),
    "what stands in a queue earns nothing": (0.09, 60, 0, 2),
    "on a link that begins slow it stays small": (0.18, 60, 0, 2),
}


@pytest.mark.parametrize(("age_s", "seconds", "changes", "level"), FROM_THE_START.values(), ids=FROM_THE_START)
def test_from_the_start(age_s: float, seconds: float, changes: int, level: int) -> None:
    levels = LevelControl(2, 0.0)
    assert levels.level == 2
    assert (len(watch(levels, age_s, 0.0, seconds)), levels.level) == (changes, level)


def test_time_in_which_nothing_was_seen_earns_nothing() -> None:
    levels = LevelControl(2, 1.0)  # and no connection until 20.0
    assert watch(levels, 0.0, 20.0, 0.9) == []
    assert len(watch(levels, 0.0, 20.9, 2.0)) == 2
    watch(levels, 0.18, 60.0, 2.0)
    assert watch(levels, 0.0, 200.0, 9.0) == []


def test_confirmations_that_are_held_back_are_not_a_slow_link() -> None:
    levels = LevelControl(2, 0.0)
    for number in range(250):
        now = 0.02 * number
        levels.poll(0.01 + now % 0.1024, now)
    assert levels.level == 0


def test_slowness_goes_down_step_by_step_and_all_is_as_before_in_the_end() -> None:
    levels = at_ease()
    for begin in range(5, 100):
        assert watch(levels, 0.19, begin, 0.2) == [], "a moment of slowness is nothing"
        assert watch(levels, 0.06, begin + 0.2, 0.8) == [], "a fast link changes nothing"
    changes = watch(levels, 0.18, 110.0, 10)
    assert (len(changes), levels.level) == (2, 2)
    assert changes[-1] < 110 + 1, "commands wait behind what waits"
    watch(levels, 0.0, 120.0, 100)
    assert levels.level == 0


def test_steps_back_are_tried_ever_more_rarely() -> None:
    levels = at_ease()
    watch(levels, 0.18, 10.0, 3.0)
    tries, at = [], 13.0
    for _ in range(4):
        tries.append(next(0.02 * number for number in range(50_000) if changes(levels, 0.0, at + 0.02 * number)))
        at += tries[-1]
        at += next(0.02 * number for number in range(50_000) if changes(levels, 0.18, at + 0.02 * number))
    assert tries[0] > 5
    assert tries == sorted(tries)
    assert tries[-1] > 4 * tries[0]


# -- as its own process, with real brokers and an operator who decodes


CHUNK_MS = 20


class Mouth(Device):
    """Says the speech into the microphone's stream, 20 ms at a time."""

    def __init__(self, folder: Path, rate: int = 16000, channels: int = 1) -> None:
        self.speech, self._form = Speech(rate, channels), {"format": "s16le", "rate": rate, "channels": channels}
        self._count = rate * CHUNK_MS // 1000
        super().__init__(folder, "microphone", 1000 / CHUNK_MS, self._count * 2 * channels, slots=16)

    def write(self, number: int) -> None:
        now = {"captured_ns": time.monotonic_ns(), "captured_ms": time.time_ns() // 1_000_000}
        samples = self.speech.samples((number - 1) * self._count, self._count)
        self.writer.write(samples.tobytes(), FrameInfo(**now, **self._form))


def publisher(local: Broker, remote: Broker) -> MediaProgram:
    return MediaProgram("audio_publisher", "audio_publisher", "audio", local.port, remote.port)


@pytest.fixture
def ear(remote: Broker) -> Iterator[Operator]:
    ear = Operator(remote.port, "audio", SoundDecoder())
    yield ear
    ear.transport.close()


def joined(received: list[ReceivedSound]) -> np.ndarray:
    return np.concatenate([one.samples for one in received])[:, 0].astype(float)


def is_whole(received: list[ReceivedSound]) -> bool:
    return all(later.sequence == earlier.sequence + 1 for earlier, later in pairwise(received))


def test_every_encoding_in_turn_carries_the_recorded_speech(local: Broker, remote: Broker, ear: Operator) -> None:
    recorded = Speech(16000).samples(0, 2 * PERIOD_S * 16000)[:, 0].astype(float)  # what was heard is somewhere in it
    with publisher(local, remote) as robot, Mouth(robot.run_dir):
        pcm = ear.wait(40)
        assert {(one.encoding, one.rate, one.channels, len(one.samples)) for one in pcm} == {("pcm", 16000, 1, 320)}
        # may be unlike for a while: a machine that is too busy loses chunks of the microphone, and counts them
        assert until(lambda: best_match(joined(ear.received[-40:]), recorded) > 0.999, 20, step=0.1)
        ages = [at - one.captured_ms / 1000 for at, one in zip(ear.arrived, pcm, strict=False)]
        assert 0.015 < median(ages) < 0.5  # of the first sample, so at least a whole chunk
        assert median(b.captured_ms - a.captured_ms for a, b in pairwise(pcm)) == pytest.approx(20, abs=2)
        robot.ask(encoding="opus")
        ear.wait_for("opus")
        assert robot.reported(encoding="opus", running=True, last_error=None, reduced=None)
        opus = ear.wait(40)
        assert {(one.encoding, one.rate, len(one.samples)) for one in opus} == {("opus", 16000, 640)}
        curve = envelope(recorded, 16000)
        assert until(lambda: best_match(envelope(joined(ear.received[-40:]), 16000), curve) > 0.9, step=0.1)
        robot.ask(encoding="smoke signals")
        ear.wait_for("pcm")
        assert is_whole(ear.received)
        assert ear.decoder.counters["refused"] == 0
        assert until(lambda: (robot.newest.doing or "").startswith("pcm 16 kHz mono, "))


def test_the_microphone_comes_later_and_comes_back_and_so_does_the_remote_broker(
    local: Broker, remote: Broker, ear: Operator
) -> None:
    with publisher(local, remote) as robot:
        assert robot.reported(doing="waits for the microphone")
        with Mouth(robot.run_dir):
            ear.wait(10)
            assert robot.reported(running=True, last_error=None)
        assert until(lambda: "no sound" in (robot.newest.last_error or ""))
        with Mouth(robot.run_dir, 48000, 2):
            assert until(lambda: ear.received[-1].rate == 48000)
            assert is_whole(ear.received)
            remote.kill()
            assert robot.reported(doing="rests: the remote side is away")
            assert until(lambda: (robot.newest.dropped or 0) > 20)
            assert robot.newest.last_error
            remote.start()
            ear.wait(20)
            ages = [at - one.captured_ms / 1000 for at, one in zip(ear.arrived, ear.received, strict=False)]
            assert median(ages[-10:]) < 0.5, "nothing from before"
            assert robot.reported(last_error=None)
