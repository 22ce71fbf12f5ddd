"""What the bridge has the launcher start and stop: flags allow, requests start, and control never waits for either."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from pebble.config.media import AudioPublisher, VideoPublisher
from pebble.contract import AUDIO_CONTROL, MQTT_AUDIO, MQTT_VIDEO, VIDEO_CONTROL
from pebble.contract.payloads import MediaRequest
from pebble.launcher.programs import Stage
from pebble.runtime.parent import NOTIFY_FD, WANTED, ProgramRequest
from pebble.services.mqtt_bridge.media import MEDIA, Media
from pebble.transports import Message, MqttSettings, create
from tests.services.mqtt_bridge.bridge_rig import BASE, Client, MemoryRig, Quiet
from tests.support import ROOT, Broker, process_name, until

TRUE, FALSE = b'{"value": true}', b'{"value": false}'
ON, OFF = b'{"enabled": true}', b'{"enabled": false}'
VIDEO_FLAG, AUDIO_FLAG = "incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"
VIDEO, AUDIO = "incoming/front-camera", "incoming/audio"
CAMERA, SPEAKER, MICROPHONE = "camera_publisher", "audio_receiver", "audio_publisher"
DRIVE = "incoming/drive-values"
ALL = (CAMERA, MICROPHONE, SPEAKER)
DEVICES = {"enabled": True}
ASKED = MediaRequest(enabled=True)
YES, NO = ProgramRequest(on=True), ProgramRequest(on=False)


class TestDecision:
    def test_every_program_has_a_row(self) -> None:
        programs = [name for row in MEDIA for name in row.programs]
        assert programs == ["camera_publisher", "video_stream", "audio_publisher", "audio_receiver"]

    def test_the_encodings_are_those_a_config_may_name(self) -> None:
        for row, section in zip(MEDIA, (VideoPublisher, AudioPublisher), strict=True):
            assert row.encodings == get_args(get_type_hints(section)["encoding"])

    def test_nothing_is_wanted_unless_it_is_allowed_and_asked_for(self) -> None:
        media = Media(ALL)
        assert media.requests() == dict.fromkeys(ALL, NO)
        media.request(VIDEO_CONTROL, ASKED)
        assert CAMERA not in media.requests(), "its flag is not known yet"
        media.allow(MQTT_VIDEO, True)
        assert media.requests() == {CAMERA: YES, MICROPHONE: NO, SPEAKER: NO}
        media.allow(MQTT_VIDEO, False)
        assert media.requests()[CAMERA] == NO
        media.allow(MQTT_VIDEO, True)
        assert media.requests()[CAMERA] == YES, "the request still stands"
        media.request(VIDEO_CONTROL, MediaRequest(enabled=False, encoding="h264"))
        assert media.requests()[CAMERA] == NO

    def test_sound_goes_both_ways(self) -> None:
        media = Media(ALL)
        media.allow(MQTT_AUDIO, True)
        media.request(AUDIO_CONTROL, ASKED)
        assert media.requests() == {CAMERA: NO, MICROPHONE: YES, SPEAKER: YES}

    @pytest.mark.parametrize(
        ("asked", "encoding"),
        [("h264", "h264"), ("json", "json"), (None, ""), ("opus", ""), ("", ""), ("h264\nWANT", ""), ("ü", "")],
    )
    def test_the_encoding_is_one_we_know_or_the_configured_one(self, asked: str | None, encoding: str) -> None:
        media = Media(ALL)
        media.allow(MQTT_VIDEO, True)
        media.request(VIDEO_CONTROL, MediaRequest(enabled=True, encoding="pbvd"))
        media.request(VIDEO_CONTROL, MediaRequest(enabled=True, encoding=asked))
        assert media.requests()[CAMERA] == ProgramRequest(on=True, encoding=encoding)

    def test_what_the_robot_does_not_have_is_not_wanted(self) -> None:
        media = Media((CAMERA,))
        media.allow(MQTT_AUDIO, True)
        media.request(AUDIO_CONTROL, ASKED)
        assert media.requests() == {CAMERA: NO}

    def test_what_runs_already_was_asked_for(self) -> None:
        opus = ProgramRequest(on=True, encoding="opus")
        media = Media(ALL, running={MICROPHONE: opus, SPEAKER: opus})
        assert media.requests() == {CAMERA: NO}, "and the flag of audio is not known yet"
        media.allow(MQTT_AUDIO, True)
        assert media.requests() == {CAMERA: NO, MICROPHONE: opus, SPEAKER: opus}

    def test_what_runs_already_can_be_stopped_before_its_flag_is_known(self) -> None:
        media = Media(ALL, running={CAMERA: YES})
        media.request(VIDEO_CONTROL, MediaRequest(enabled=False))
        assert media.requests()[CAMERA] == NO


class Launcher:
    """The other end of the bridge's notify pipe."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._read, self.write = os.pipe()
        os.set_blocking(self._read, False)
        monkeypatch.setenv(NOTIFY_FD, str(self.write))
        self.received: list[str] = []

    def drain(self) -> bytes:
        try:
            return os.read(self._read, 1_000_000)
        except BlockingIOError:
            return b""

    def receives(self, program: str, wanted: int, encoding: str = "") -> bool:
        """Whether this becomes the last line about it."""
        return until(lambda: self._last(program) == f"{wanted} {encoding}".strip())

    def _last(self, program: str) -> str:
        self.received += self.drain().decode().splitlines()
        start = f"WANT {program} "
        earlier = [line.removeprefix(start) for line in self.received if line.startswith(start)]
        return earlier[-1] if earlier else ""

    def close(self) -> None:
        os.close(self._read)
        os.close(self.write)


@pytest.fixture
def launcher(monkeypatch: pytest.MonkeyPatch) -> Iterator[Launcher]:
    launcher = Launcher(monkeypatch)
    yield launcher
    launcher.close()


@pytest.fixture(params=[False, True], ids=["two sides", "one broker"])
def either(request: pytest.FixtureRequest, launcher: Launcher, monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
    rig = MemoryRig(monkeypatch, one=request.param)
    yield rig
    rig.close()


@pytest.fixture
def rig(launcher: Launcher, monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
    rig = MemoryRig(monkeypatch)
    yield rig
    rig.close()


class TestBridge:
    def test_flags_gate_and_requests_start(self, either: MemoryRig, launcher: Launcher) -> None:
        either.bridge(av_daemon=DEVICES)
        either.remote.publish(VIDEO, ON)
        either.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        assert launcher.receives(CAMERA, 1)
        either.remote.publish(VIDEO, OFF)
        assert launcher.receives(CAMERA, 0)
        either.remote.publish(VIDEO, ON)
        assert launcher.receives(CAMERA, 1)
        either.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        assert launcher.receives(CAMERA, 0)
        either.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        assert launcher.receives(CAMERA, 1)
        either.remote.publish(VIDEO_FLAG, b"", retain=True)
        assert launcher.receives(CAMERA, 0)
        assert not any("audio" in line and line.endswith("1") for line in launcher.received)

    @pytest.mark.parametrize("side", ["local", "remote"])
    def test_either_side_may_set_the_flag_and_ask(self, either: MemoryRig, launcher: Launcher, side: str) -> None:
        either.bridge(av_daemon=DEVICES)
        client: Client = getattr(either, side)
        client.publish(AUDIO_FLAG, TRUE, retain=True)
        client.publish(AUDIO, ON)
        assert launcher.receives(MICROPHONE, 1)
        assert launcher.receives(SPEAKER, 1)
        client.publish(AUDIO, OFF)
        assert launcher.receives(MICROPHONE, 0)
        assert launcher.receives(SPEAKER, 0)

    @pytest.mark.parametrize("side", ["local", "remote"])
    def test_a_retained_flag_counts(self, either: MemoryRig, launcher: Launcher, side: str) -> None:
        getattr(either, side).publish(VIDEO_FLAG, TRUE, retain=True)
        either.bridge(av_daemon=DEVICES)
        either.remote.publish(VIDEO, ON)
        assert launcher.receives(CAMERA, 1)

    @pytest.mark.parametrize("side", ["local", "remote"])
    def test_a_retained_request_never_does(self, either: MemoryRig, launcher: Launcher, side: str) -> None:
        client: Client = getattr(either, side)
        client.publish(VIDEO, ON, retain=True)
        bridge = either.bridge(av_daemon=DEVICES)
        client.publish(VIDEO_FLAG, TRUE, retain=True)
        client.publish(AUDIO_FLAG, TRUE, retain=True)
        client.publish(AUDIO, ON)
        assert launcher.receives(SPEAKER, 1), "and by now the retained one has arrived"
        assert bridge.counters["stale"]
        assert launcher.receives(CAMERA, 0)

    @pytest.mark.parametrize(
        ("asked", "encoding"),
        [
            (b"true", ""),
            (TRUE, ""),
            (b'{"enabled": true, "encoding": "h264", "keyframe": true}', "h264"),
            (b'{"value": {"enabled": true, "encoding": "pbvz"}}', "pbvz"),
        ],
    )
    def test_forms_of_a_request(self, rig: MemoryRig, launcher: Launcher, asked: bytes, encoding: str) -> None:
        rig.bridge(av_daemon=DEVICES)
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.remote.publish(VIDEO, asked)
        assert launcher.receives(CAMERA, 1, encoding)
        assert until(lambda: rig.local.payloads(VIDEO) == [asked]), "the publisher reads it, too"

    @pytest.mark.parametrize("nonsense", [b"", b"1", b'"true"', b"{", b"\xff", b"[true]", b'{"enabled": NaN}'])
    def test_nonsense_starts_and_stops_nothing(self, rig: MemoryRig, launcher: Launcher, nonsense: bytes) -> None:
        bridge = rig.bridge(av_daemon=DEVICES)
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.remote.publish(VIDEO, nonsense)
        assert until(lambda: bridge.counters["refused"])
        assert launcher.receives(CAMERA, 0)
        rig.remote.publish(VIDEO, ON)
        assert launcher.receives(CAMERA, 1)
        rig.remote.publish(VIDEO, nonsense)
        assert until(lambda: bridge.counters["refused"] == 2)
        assert launcher.receives(CAMERA, 1)

    def test_a_robot_without_camera_and_microphone_asks_for_nothing(self, rig: MemoryRig, launcher: Launcher) -> None:
        rig.bridge()
        for flag, request in ((VIDEO_FLAG, VIDEO), (AUDIO_FLAG, AUDIO)):
            rig.remote.publish(flag, TRUE, retain=True)
            rig.remote.publish(request, ON)
        assert until(lambda: rig.local.on(AUDIO))
        Quiet(rig.local).wait(0.1)
        assert not launcher.drain()

    def test_what_a_bridge_before_it_wanted_runs_on(
        self, either: MemoryRig, launcher: Launcher, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv(WANTED, f"{CAMERA}=h264")
        either.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        either.bridge(av_daemon=DEVICES)
        assert launcher.receives(CAMERA, 1, "h264")
        assert f"WANT {CAMERA} 0" not in launcher.received

    def test_a_request_is_sent_again_to_a_busy_launcher(self, rig: MemoryRig, launcher: Launcher) -> None:
        rig.bridge(av_daemon=DEVICES)
        assert launcher.receives(CAMERA, 0)
        while True:
            try:
                os.write(launcher.write, b"ALIVE\n" * 100)
            except BlockingIOError:
                break
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.remote.publish(VIDEO, ON)
        assert until(lambda: rig.local.on(VIDEO))
        assert launcher.receives(CAMERA, 1)

    def test_without_a_launcher_it_logs_that_once(
        self, rig: MemoryRig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        caplog.set_level(logging.INFO)
        monkeypatch.delenv(NOTIFY_FD)
        rig.bridge(av_daemon=DEVICES)
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.remote.publish(VIDEO, ON)
        rig.remote.publish(DRIVE, b"1")
        assert until(lambda: rig.local.on(DRIVE))
        assert sum("there is no launcher" in message for message in caplog.messages) == 1

    def test_pictures_and_sound_never_pass(self, rig: MemoryRig) -> None:
        bridge = rig.bridge(av_daemon=DEVICES)
        rig.remote.publish("incoming/flags/remote-mirror", TRUE, retain=True)
        assert until(lambda: bridge.forwarder.mirroring)
        for client in (rig.local, rig.remote):
            for suffix in ("outgoing/front-camera", "outgoing/audio", "incoming/audio-stream"):
                client.publish(suffix, b"\xff\xd8", qos=0)
        rig.local.publish("outgoing/online-elsewhere", b"after")
        rig.remote.publish(DRIVE, b"after")
        assert until(lambda: rig.remote.on("outgoing/online-elsewhere") and rig.local.on(DRIVE))
        media = ("front-camera", "audio", "audio-stream")
        seen = [m.topic for m in [*rig.local.seen, *rig.remote.seen] if m.topic.endswith(media)]
        assert seen == [], "no client receives its own messages, and the other side must not"
        assert not bridge.counters["refused"], "nor are they taken for requests, whose names are alike"

    def test_they_do_not_pass_under_other_names_either(self, rig: MemoryRig) -> None:
        names = {name: {"topic": f"{BASE}/{topic}"} for name, topic in RENAMED.items()}
        rig.bridge(av_daemon=DEVICES, media=names)
        for suffix in RENAMED.values():
            rig.local.publish(suffix, b"\xff\xd8", qos=0)
            rig.remote.publish(suffix, b"\xff\xd8", qos=0)
        rig.local.publish("outgoing/strange", b"after")
        rig.remote.publish(DRIVE, b"after")
        assert until(lambda: rig.remote.on("outgoing/strange") and rig.local.on(DRIVE))
        assert not [m for m in [*rig.local.seen, *rig.remote.seen] if m.topic.endswith(tuple(RENAMED.values()))]


RENAMED = {
    "video_publisher": "outgoing/eye",
    "audio_publisher": "outgoing/ear",
    "audio_receiver": "incoming/mouth",
}


SILENCE_S = 5.0  # a machine that does too much at once is not a broker that stopped answering


class Robot:
    """A real launcher with a real bridge between real brokers, and a camera publisher that misbehaves."""

    def __init__(self, folder: Path, behaviour: str, *, one: bool) -> None:
        self.journal, self.errors = folder / "journal", folder / "errors"
        self._brokers = [Broker(folder)] if one else [Broker(folder), Broker(folder)]
        self.local, self.remote = (self._client(name, broker) for name, broker in self._sides())
        config = folder / "rover.json"
        config.write_text(json.dumps(self._config(folder)))
        rows = [
            ("mqtt_bridge", "pebble.services.mqtt_bridge", [str(config)], Stage.CONNECTION, {"may_request": True}),
            (
                *(CAMERA, "fake_service", [CAMERA, behaviour, str(self.journal)], Stage.CONNECTION),
                {"on_demand": True, "preloaded": False, "stop_timeout_s": 3.0},
            ),
        ]
        self.launcher = subprocess.Popen(
            [sys.executable, "tests/fakes/run_launcher.py", str(ROOT), str(config), json.dumps(rows), folder / "said"],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT / "tests" / "fakes")},
            stderr=self.errors.open("wb"),
        )
        resolution = "are one broker" if one else "forwarding between"
        assert until(lambda: resolution in self.errors.read_text(), 20), self.errors.read_text()

    def _sides(self) -> list[tuple[str, Broker]]:
        return [("somebody", self._brokers[0]), ("operator", self._brokers[-1])]

    def _client(self, name: str, broker: Broker) -> Client:
        settings = MqttSettings(host="127.0.0.1", port=broker.port, as_published=True)
        return Client(create("mqtt", name, settings))

    def _config(self, folder: Path) -> dict[str, Any]:
        return {
            "robot": {"id": "rover"},
            "transport": {"kind": "mqtt", "run_dir": str(folder / "run")},
            "local_mqtt": {"host": "localhost", "port": self._brokers[0].port, "silence_seconds": SILENCE_S},
            "services": {
                "launcher": {"shutdown_timeout_seconds": 1.0},
                "av_daemon": DEVICES,
                "mqtt_bridge": {
                    "enabled": True,
                    "remote_mqtt": {
                        "host": "127.0.0.1",
                        "port": self._brokers[-1].port,
                        "silence_seconds": SILENCE_S,
                    },
                },
            },
        }

    def pids(self, event: str) -> list[int]:
        lines = self.journal.read_text().splitlines() if self.journal.exists() else []
        return [int(line.split()[2]) for line in lines if line.split()[1] == event]

    def bridge_pid(self) -> int:
        children = Path(f"/proc/{self.launcher.pid}/task/{self.launcher.pid}/children").read_text().split()
        return next(int(pid) for pid in children if process_name(int(pid)) == "mqtt_bridge")

    def close(self) -> None:
        self.launcher.terminate()
        self.launcher.wait(10)
        for client in (self.local, self.remote):
            client.transport.close()
        for broker in self._brokers:
            broker.stop()


@pytest.fixture(params=[False, True], ids=["two brokers", "one broker"])
def one(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


class TestWholeWay:
    def test_a_media_program_that_does_not_stop_delays_no_drive_command(self, tmp_path: Path, one: bool) -> None:
        robot = Robot(tmp_path, "stubborn", one=one)
        try:
            robot.remote.publish(VIDEO_FLAG, TRUE, retain=True)
            robot.remote.publish(VIDEO, ON)
            assert until(lambda: robot.pids("ready"), 20), robot.errors.read_text()
            delays = drive(robot, seconds=4.0, rate_hz=50)
            assert until(lambda: "camera_publisher did not stop within 3 s: killed" in robot.errors.read_text())
            assert max(delays) < 0.5, "seconds; in fact some milliseconds"
        finally:
            robot.close()

    def test_a_killed_bridge_does_not_end_what_was_asked_for(self, tmp_path: Path, one: bool) -> None:
        robot = Robot(tmp_path, "good", one=one)
        try:
            robot.remote.publish(VIDEO_FLAG, TRUE, retain=True)
            robot.remote.publish(VIDEO, ON)
            assert until(lambda: robot.pids("ready"), 20), robot.errors.read_text()
            os.kill(robot.bridge_pid(), signal.SIGKILL)
            assert not until(lambda: robot.pids("stop"), 5.5, step=0.05), "asked for once is enough"
            assert len(robot.pids("start")) == 1
            robot.remote.publish(VIDEO, OFF)
            assert until(lambda: robot.pids("stop"))
        finally:
            robot.close()


def drive(robot: Robot, *, seconds: float, rate_hz: float) -> list[float]:
    """Drive while video is switched off; how many seconds each command took from the operator to the robot's side."""
    arrived: dict[bytes, float] = {}

    def note(message: Message) -> None:
        if not message.payload.isspace():  # else a probe of the bridge
            arrived[message.payload] = time.monotonic()

    listener = robot.local.transport.subscribe(f"{BASE}/{DRIVE}", note, echo=False, direct=True)
    sent: dict[bytes, float] = {}
    for number in range(int(seconds * rate_hz)):
        payload = b'{"x": 0, "z": %.4f}' % (number / 10_000)
        sent[payload] = time.monotonic()
        robot.remote.publish(DRIVE, payload)
        if number == int(rate_hz / 2):
            robot.remote.publish(VIDEO, OFF)
        time.sleep(1 / rate_hz)
    assert until(lambda: len(arrived) == len(sent))
    listener.close()
    return [arrived[payload] - at for payload, at in sent.items()]
