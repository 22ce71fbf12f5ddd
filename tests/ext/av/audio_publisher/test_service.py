"""The audio publisher as its own process: a real stream of sound, real brokers, and an operator who decodes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
import pytest

from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.sound import ReceivedSound, SoundDecoder
from pebble.extensions.media.speech import PERIOD_S, Speech
from pebble.transports import Message
from tests.ext.av.media_rig import Device, MediaProgram, Operator
from tests.kit.sound import best_match, envelope
from tests.support import Broker, until

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


class Ear(Operator):
    """Decodes every packet of the robot's sound."""

    def __init__(self, port: int) -> None:
        self.arrived: list[float] = []  # epoch seconds
        self.decoder = SoundDecoder()
        super().__init__(port, "audio")

    def receive(self, message: Message) -> None:
        one = self.decoder.feed(message.payload)
        if one is not None:
            self.arrived.append(time.time())
            self.received.append(one)


def publisher(local: Broker, remote: Broker) -> MediaProgram:
    return MediaProgram("audio_publisher", "audio_publisher", "audio", local.port, remote.port)


@pytest.fixture
def ear(remote: Broker) -> Iterator[Ear]:
    ear = Ear(remote.port)
    yield ear
    ear.close()


def joined(received: list[ReceivedSound]) -> np.ndarray:
    return np.concatenate([one.samples for one in received])[:, 0].astype(float)


def recorded(rate: int) -> np.ndarray:
    """Two periods: whatever was heard is somewhere in it."""
    return Speech(rate).samples(0, 2 * PERIOD_S * rate)[:, 0].astype(float)


def pcm_likeness(received: list[ReceivedSound]) -> float:
    """May be low for a while: a machine that is too busy loses chunks of the microphone, and counts them."""
    return best_match(joined(received), recorded(16000))


def opus_likeness(received: list[ReceivedSound]) -> float:
    return best_match(envelope(joined(received), 16000), envelope(recorded(16000), 16000))


def is_whole(received: list[ReceivedSound]) -> bool:
    return all(later.sequence == earlier.sequence + 1 for earlier, later in pairwise(received))


def test_every_encoding_in_turn_carries_the_recorded_speech(local: Broker, remote: Broker, ear: Ear) -> None:
    with publisher(local, remote) as robot, Mouth(robot.run_dir):
        pcm = ear.wait(40)
        assert {(one.encoding, one.rate, one.channels, len(one.samples)) for one in pcm} == {("pcm", 16000, 1, 320)}
        assert until(lambda: pcm_likeness(ear.received[-40:]) > 0.999, 20, step=0.1)
        ages = [at - one.captured_ms / 1000 for at, one in zip(ear.arrived, pcm, strict=False)]
        assert 0.015 < median(ages) < 0.5  # of the first sample, so at least a whole chunk
        assert median(b.captured_ms - a.captured_ms for a, b in pairwise(pcm)) == pytest.approx(20, abs=2)
        robot.ask(encoding="opus")
        ear.wait_for("opus")
        assert robot.reported(encoding="opus", running=True, last_error=None, reduced=None)
        opus = ear.wait(40)
        assert {(one.encoding, one.rate, len(one.samples)) for one in opus} == {("opus", 16000, 640)}
        assert until(lambda: opus_likeness(ear.received[-40:]) > 0.9, 20, step=0.1)
        robot.ask(encoding="smoke signals")
        ear.wait_for("pcm")
        assert is_whole(ear.received)
        assert ear.decoder.counters["refused"] == 0
        assert until(lambda: (robot.newest.doing or "").startswith("pcm 16 kHz mono, "))


def test_the_microphone_comes_later_and_comes_back_and_so_does_the_remote_broker(
    local: Broker, remote: Broker, ear: Ear
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
