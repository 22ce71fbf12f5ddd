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
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from pebble.config.media import AudioPublisher, VideoPublisher
from pebble.contract import AUDIO_CONTROL, MQTT_AUDIO, MQTT_VIDEO, VIDEO_CONTROL
from pebble.contract.payloads import MediaRequest
from pebble.extension import Stage
from pebble.runtime import notes
from pebble.runtime.notes import Held, Wanted
from pebble.runtime.parent import NOTIFY_FD, WANTED, ProgramRequest
from pebble.services.mqtt_bridge.media import MEDIA, Media
from pebble.transports import Message, MqttSettings, create
from tests.forwarding.virtual import World
from tests.services.mqtt_bridge.bridge_rig import BASE, Client
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


RENAMED = {"video_publisher": "outgoing/eye", "audio_publisher": "outgoing/ear", "audio_receiver": "incoming/mouth"}


class AskingBridge(World):
    """A bridge in virtual time whose notify pipe ends here, where a launcher's would."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, one: bool) -> None:
        super().__init__("bridge", monkeypatch, one=one)
        self._read, self.write = os.pipe()
        os.set_blocking(self._read, False)
        monkeypatch.setenv(NOTIFY_FD, str(self.write))
        self.asked: list[notes.Note] = []

    def begin(self, **section: Any) -> None:
        self.start(av_daemon=DEVICES, **section)
        self.run()

    def wanted(self, program: str, kind: type[Wanted | Held] = Wanted, *, after: float = 3.0) -> str:
        """What the launcher was told about a program last: ``1 h264``."""
        self.run(after)
        with suppress(BlockingIOError):
            self.asked += map(notes.decode, os.read(self._read, 1_000_000).splitlines())
        told = [note for note in self.asked if isinstance(note, kind) and note.program == program]
        return f"{int(told[-1].on)} {getattr(told[-1], 'encoding', '')}".rstrip() if told else ""

    def fill(self) -> None:
        """The launcher is busy: there is no room for a further request."""
        os.set_blocking(self.write, False)
        alive = notes.encode(notes.Alive()) + b"\n"
        for line in (alive * 100, alive):
            with suppress(BlockingIOError):
                while True:
                    os.write(self.write, line)

    def close(self) -> None:
        os.close(self._read)
        os.close(self.write)


@pytest.fixture(params=[False, True], ids=["two sides", "one broker"])
def either(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[AskingBridge]:
    bridge = AskingBridge(monkeypatch, one=request.param)
    yield bridge
    bridge.close()


@pytest.fixture
def bridge(monkeypatch: pytest.MonkeyPatch) -> Iterator[AskingBridge]:
    bridge = AskingBridge(monkeypatch, one=False)
    yield bridge
    bridge.close()


each_side = pytest.mark.parametrize("side", ["local", "remote"])


class TestBridge:
    def test_flags_gate_and_requests_start(self, either: AskingBridge) -> None:
        either.begin()
        either.remote.publish(VIDEO, ON)
        changes = [(TRUE, None, "1"), (None, OFF, "0"), (None, ON, "1"), (FALSE, None, "0"), (TRUE, None, "1")]
        for flag, request, wanted in [*changes, (b"", None, "0")]:
            if flag is not None:
                either.remote.publish(VIDEO_FLAG, flag, retain=True)
            if request is not None:
                either.remote.publish(VIDEO, request)
            assert either.wanted(CAMERA) == wanted
        assert not any("audio" in note.program and note.on for note in either.asked if isinstance(note, Wanted))

    @each_side
    def test_either_side_may_set_the_flag_and_ask(self, either: AskingBridge, side: str) -> None:
        either.begin()
        client: Client = getattr(either, side)
        client.publish(AUDIO_FLAG, TRUE, retain=True)
        for request, wanted in ((ON, "1"), (OFF, "0")):
            client.publish(AUDIO, request)
            assert [either.wanted(MICROPHONE), either.wanted(SPEAKER)] == [wanted] * 2

    @each_side
    def test_a_retained_flag_counts(self, either: AskingBridge, side: str) -> None:
        getattr(either, side).publish(VIDEO_FLAG, TRUE, retain=True)
        either.begin()
        either.remote.publish(VIDEO, ON)
        assert either.wanted(CAMERA) == "1"

    @each_side
    def test_a_retained_request_never_does(self, either: AskingBridge, side: str) -> None:
        client: Client = getattr(either, side)
        client.publish(VIDEO, ON, retain=True)
        either.begin()
        for flag in (VIDEO_FLAG, AUDIO_FLAG):
            client.publish(flag, TRUE, retain=True)
        client.publish(AUDIO, ON)
        assert (either.wanted(SPEAKER), either.wanted(CAMERA)) == ("1", "0")
        assert either.service.counters["stale"]

    @pytest.mark.parametrize(
        ("asked", "wanted"),
        [
            (b"true", "1"),
            (TRUE, "1"),
            (b'{"enabled": true, "encoding": "h264", "keyframe": true}', "1 h264"),
            (b'{"value": {"enabled": true, "encoding": "pbvd"}}', "1 pbvd"),
        ],
    )
    def test_forms_of_a_request(self, bridge: AskingBridge, asked: bytes, wanted: str) -> None:
        bridge.begin()
        bridge.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        bridge.remote.publish(VIDEO, asked)
        assert bridge.wanted(CAMERA) == wanted
        assert bridge.local.payloads(VIDEO) == [asked], "the publisher reads it, too"

    @pytest.mark.parametrize("nonsense", [b"", b"1", b'"true"', b"{", b"\xff", b"[true]", b'{"enabled": NaN}'])
    def test_nonsense_starts_and_stops_nothing(self, bridge: AskingBridge, nonsense: bytes) -> None:
        bridge.begin()
        bridge.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        for payload, wanted in ((nonsense, "0"), (ON, "1"), (nonsense, "1")):
            bridge.remote.publish(VIDEO, payload)
            assert bridge.wanted(CAMERA) == wanted
        assert bridge.service.counters["refused"] == 2

    def test_a_robot_without_camera_and_microphone_asks_for_nothing(self, bridge: AskingBridge) -> None:
        bridge.start()
        bridge.run()
        for flag, request in ((VIDEO_FLAG, VIDEO), (AUDIO_FLAG, AUDIO)):
            bridge.remote.publish(flag, TRUE, retain=True)
            bridge.remote.publish(request, ON)
        assert [bridge.wanted(program) for program in ALL] == [""] * 3
        assert bridge.local.on(AUDIO)

    def test_what_a_bridge_before_it_wanted_runs_on(
        self, either: AskingBridge, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv(WANTED, f"{CAMERA}=h264")
        either.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        either.begin()
        assert either.wanted(CAMERA) == "1 h264"
        assert Wanted(CAMERA, False) not in either.asked

    @pytest.mark.parametrize(
        ("profile", "drive", "held"),
        [
            ("thin", b'{"z": 0.5}', "1"),
            ("thin", b'{"z": 0.5, "t": 1, "key": "aabbccdd"}', "1"),
            ("thin", b'{"z": 0}', ""),
            ("thin", b"{", ""),
            ("wide", b'{"z": 0.5}', ""),
        ],
    )
    def test_on_a_thin_link_what_is_sent_waits_for_driving(
        self, bridge: AskingBridge, profile: str, drive: bytes, held: str
    ) -> None:
        bridge.begin(link={"profile": profile})
        bridge.remote.publish(DRIVE, drive)
        assert [bridge.wanted(program, Held, after=0.0) for program in ALL] == [held, held, ""]
        bridge.run(1.8)
        bridge.remote.publish(DRIVE, b'{"z": 0}')
        assert bridge.wanted(CAMERA, Held, after=3.1) == held
        assert bridge.wanted(CAMERA, Held, after=1.2) == held.replace("1", "0")

    def test_what_a_script_drives_holds_nothing_up(self, bridge: AskingBridge) -> None:
        bridge.begin(link={"profile": "thin"})
        bridge.local.publish(DRIVE, b'{"z": 0.5, "source": "autonomy", "run": 1}')
        assert bridge.wanted(CAMERA, Held) == ""

    def test_a_request_is_sent_again_to_a_busy_launcher(self, bridge: AskingBridge) -> None:
        bridge.begin()
        assert bridge.wanted(CAMERA) == "0"
        bridge.fill()
        bridge.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        bridge.remote.publish(VIDEO, ON)
        assert bridge.wanted(CAMERA) == "0"
        assert bridge.local.on(VIDEO)
        assert bridge.wanted(CAMERA) == "1"

    def test_without_a_launcher_it_logs_that_once(
        self, bridge: AskingBridge, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        caplog.set_level(logging.INFO)
        monkeypatch.delenv(NOTIFY_FD)
        bridge.begin()
        bridge.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        bridge.remote.publish(VIDEO, ON)
        bridge.run()
        assert sum("there is no launcher" in message for message in caplog.messages) == 1

    @pytest.mark.parametrize("names", [{}, RENAMED], ids=["as usual", "renamed"])
    def test_pictures_and_sound_never_pass(self, bridge: AskingBridge, names: dict[str, str]) -> None:
        bridge.begin(media={name: {"topic": f"{BASE}/{topic}"} for name, topic in names.items()})
        bridge.remote.publish("incoming/flags/remote-mirror", TRUE, retain=True)
        bridge.run()
        media = tuple(names.values()) or ("outgoing/front-camera", "outgoing/audio", "incoming/audio-stream")
        for client in (bridge.local, bridge.remote):
            for suffix in media:
                client.publish(suffix, b"\xff\xd8", qos=0)
        bridge.run()
        assert bridge.service.status.mirroring
        seen = [one.topic for one in [*bridge.local.seen, *bridge.remote.seen] if one.topic.endswith(media)]
        assert seen == [], "no client receives its own messages, and the other side must not"
        assert not bridge.service.counters["refused"], "nor are they taken for requests, whose names are alike"


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
                    "remote_mqtt": {"host": "127.0.0.1", "port": self._brokers[-1].port, "silence_seconds": SILENCE_S},
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


@pytest.fixture(params=[False, pytest.param(True, marks=pytest.mark.thorough)], ids=["two brokers", "one broker"])
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
