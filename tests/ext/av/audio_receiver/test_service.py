"""The audio receiver as its own process, a recorder instead of aplay, and an operator who speaks."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pebble.config import parse
from pebble.extensions.media.pcm import to_bytes
from pebble.extensions.media.sound import make_sound_encoder, sequence_numbers
from pebble.extensions.media.speech import Speech
from pebble.services.audio_receiver import service as service_module
from pebble.services.audio_receiver.service import AudioReceiver
from pebble.transports import QoS, Subscription
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.av.media_rig import BASE, MediaProgram, client, speech_of
from tests.kit.robot import Running
from tests.kit.sound import best_match
from tests.support import WAIT_S, Broker, until

# Appends what it hears to a file that is named after how it was called.
RECORDER = """
import os, sys, time
folder, rate, channels, device = sys.argv[1:]
with open(f"{folder}/{time.monotonic_ns():020}-{rate}-{channels}-{device}-{os.getpid()}.raw", "wb", buffering=0) as out:
    while chunk := os.read(0, 4096):
        out.write(chunk)
"""


class Recorder:
    """The command that stands in for aplay, and what it was given to play."""

    def __init__(self, folder: Path) -> None:
        script = folder / "recorder.py"
        script.write_text(RECORDER)
        self.folder = folder
        self.command = [sys.executable, str(script), str(folder), "{rate}", "{channels}", "{device}"]

    @property
    def calls(self) -> list[str]:
        """Rate, channels and device, oldest first."""
        return [file.stem.partition("-")[2].rpartition("-")[0] for file in self._files()]

    @property
    def pids(self) -> list[int]:
        return [int(file.stem.rpartition("-")[2]) for file in self._files()]

    def samples(self, call: int = 0) -> np.ndarray:
        files = self._files()
        data = files[call].read_bytes() if len(files) > call else b""
        return np.frombuffer(data[: len(data) // 2 * 2], "<i2").astype(float)

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("*.raw"))  # their names begin with when they began


@pytest.fixture
def recorder(tmp_path: Path) -> Recorder:
    return Recorder(tmp_path)


class Operator:
    """Speaks in real time."""

    def __init__(self, port: int) -> None:
        self.transport = client("operator", port)
        self.numbers = sequence_numbers()

    def speak(self, name: str = "pcm", *, seconds: float, rate: int = 16000, channels: int = 1) -> None:
        encoder = make_sound_encoder(name, rate=rate, channels=channels, numbers=self.numbers)
        speech, count, began = speech_of(rate, channels), rate // 50, time.monotonic()
        for number in range(round(seconds * 50)):
            time.sleep(max(0.0, began + 0.02 * number - time.monotonic()))  # as a microphone does
            for packet in encoder.encode(to_bytes(speech.samples(number * count, count)), time.time_ns() // 1_000_000):
                self.send(packet)

    def send(self, payload: bytes, *, retain: bool = False) -> None:
        assert self.transport.publish(f"{BASE}/incoming/audio-stream", payload, qos=QoS.LATEST, retain=retain)


@pytest.fixture
def operator(remote: Broker) -> Iterator[Operator]:
    operator = Operator(remote.port)
    yield operator
    operator.transport.close()


Receive = Callable[..., MediaProgram]


@pytest.fixture
def receive(local: Broker, remote: Broker, recorder: Recorder) -> Iterator[Receive]:
    """Starts the receiver of a robot, and returns once it reports."""
    with ExitStack() as ends:

        def started(problem: str | None = None, **options: Any) -> MediaProgram:
            options = {"command": recorder.command, **options}
            names = ("audio_receiver", "audio_receiver", "audio")
            robot = ends.enter_context(MediaProgram(*names, local.port, remote.port, **options))
            assert robot.reported(running=True, last_error=problem, doing="is silent")
            return robot

        yield started


@pytest.mark.solo  # what comes too late is not played
def test_received_speech_is_played_and_garbage_and_retained_packets_are_not(
    receive: Receive, operator: Operator, recorder: Recorder
) -> None:
    packet = make_sound_encoder("pcm", rate=16000, channels=1).encode(bytes(640), 1000)[0]
    operator.send(packet, retain=True)
    robot = receive(device="plug:x", latency_ms=1000)
    for size in range(200):
        operator.send(bytes(range(256))[:size])
        operator.send(packet[:size])
    assert until(lambda: (robot.newest.rate or 0) > 0)
    assert recorder.calls == []
    operator.speak(seconds=2)
    speech = Speech(16000).samples(0, 32000)[:, 0].astype(float)
    assert until(lambda: len(recorder.samples()) >= 32000 * 0.98)
    assert recorder.calls == ["16000-1-plug:x"]
    assert best_match(recorder.samples()[:28000], np.pad(speech, (8000, 8000))) > 0.95
    assert robot.reported(encoding="pcm", last_error=None, doing="plays 16 kHz, 1 channel")
    assert until(lambda: (robot.newest.bitrate or 0) > 0)
    before = robot.newest.dropped or 0
    burst = make_sound_encoder("pcm", rate=16000, channels=1, numbers=operator.numbers)
    for number, packet in enumerate(burst.encode(bytes(200 * 640), time.time_ns() // 1_000_000)):
        time.sleep(0.1 * (number % 40 == 0))  # no more at once than wait for the thread that plays
        operator.send(packet)
    assert until(lambda: (robot.newest.dropped or 0) > before + 100)
    used_s, seen = cpu_s(robot.process.pid), len(robot.reports)
    assert until(lambda: len(robot.reports) >= seen + 2)
    assert cpu_s(robot.process.pid) - used_s < 0.5, "it waits for packets"


def cpu_s(pid: int) -> float:
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def test_another_player_begins_after_a_change_of_format_and_when_it_dies_or_hangs(
    receive: Receive, operator: Operator, recorder: Recorder
) -> None:
    robot = receive()
    operator.speak(seconds=0.5)
    operator.speak("opus", seconds=0.5, rate=48000, channels=2)
    assert until(lambda: len(recorder.calls) == 2 and len(recorder.samples(1)) > 5000)
    assert robot.newest.restarts == 0
    os.kill(recorder.pids[1], signal.SIGKILL)
    operator.speak(seconds=1.2)
    assert until(lambda: len(recorder.calls) == 3 and len(recorder.samples(2)) > 3000)
    assert robot.reported(restarts=1)
    os.kill(recorder.pids[2], signal.SIGSTOP)
    seen = len(robot.reports)
    operator.speak(seconds=3.5)
    assert len(robot.reports) >= seen + 2, "it blocks nothing else"
    assert until(lambda: len(recorder.calls) == 4 and len(recorder.samples(3)) > 3000)
    assert recorder.calls == ["16000-1-default", "48000-2-default", "16000-1-default", "16000-1-default"]
    robot.process.send_signal(signal.SIGTERM)
    assert robot.process.wait(WAIT_S) == 0


def test_a_player_that_is_not_installed_is_named_once(receive: Receive, operator: Operator) -> None:
    robot = receive(command=["no-such-player", "-"], problem="no-such-player is not installed")
    operator.speak(seconds=0.5)
    assert until(lambda: (robot.newest.dropped or 0) > 10)
    assert robot.newest.last_error == "no-such-player is not installed"
    assert robot.process.printed.count("no sound: no-such-player is not installed") == 1


@pytest.mark.parametrize(
    ("security", "topics"),
    [
        ({}, ["audio-stream"]),
        ({"level": "named"}, ["by/+/audio-stream"]),
        ({"level": "named", "strangers": "free"}, ["by/+/audio-stream", "audio-stream"]),
    ],
)
def test_whose_voice_it_receives(monkeypatch: pytest.MonkeyPatch, security: dict[str, str], topics: list[str]) -> None:
    filters: list[str] = []

    class Remote(MemoryTransport):
        def subscribe(self, filter_: str, *arguments: Any, **options: Any) -> Subscription:
            filters.append(filter_)
            return super().subscribe(filter_, *arguments, **options)

    monkeypatch.setattr(service_module, "remote_transport", lambda _config, name: Remote(name, MemoryHub()))
    bridge = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": 1884}}
    raw = {"robot": {"id": "rover"}, "security": security, "services": {"mqtt_bridge": bridge}}
    config = parse(raw, folder=Path.cwd(), env={})
    running = Running(AudioReceiver(config, MemoryTransport("local", MemoryHub())))
    try:
        assert until(lambda: filters == [f"{config.base}/incoming/{topic}" for topic in topics])
    finally:
        running.stop()
