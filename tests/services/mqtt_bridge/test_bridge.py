"""What the bridge has the launcher start and stop: flags allow, requests start, and control never waits for either.

And urgent stops, between two transports in memory, with their threads.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import pytest

from pebble.contract import AUDIO_CONTROL, MQTT_AUDIO, MQTT_VIDEO, VIDEO_CONTROL
from pebble.contract.payloads import MediaRequest
from pebble.forwarding.routing import Side
from pebble.runtime import notes
from pebble.runtime.notes import Held, Wanted
from pebble.runtime.parent import NOTIFY_FD, WANTED
from pebble.services.mqtt_bridge.requests.media import Media, ProgramRequest
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryTransport
from tests.forwarding.virtual import World
from tests.services.mqtt_bridge.bridge_rig import BASE, Client, MemoryRig
from tests.support import WAIT_S, until

TRUE, FALSE = b'{"value": true}', b'{"value": false}'
ON, OFF = b'{"enabled": true}', b'{"enabled": false}'
VIDEO_FLAG, AUDIO_FLAG = "incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"
VIDEO, AUDIO = "incoming/front-camera", "incoming/audio"
CAMERA, SPEAKER, MICROPHONE = "camera_publisher", "audio_receiver", "audio_publisher"
STOP, STATE, DRIVE = "incoming/estop", "outgoing/estop/mcu", "incoming/drive-values"
PRESS, MIRROR_FLAG = b'{"stop": "00000000000000a1", "by": "test"}', "incoming/flags/remote-mirror"
ALL = (CAMERA, MICROPHONE, SPEAKER)
YES, NO = ProgramRequest(on=True), ProgramRequest(on=False)


class TestDecision:
    @pytest.mark.parametrize(
        ("asked", "encoding"),
        [("h264", "h264"), (None, ""), ("opus", ""), ("h264\nWANT", "")],
    )
    def test_the_encoding_is_one_we_know_or_the_configured_one(self, asked: str | None, encoding: str) -> None:
        media = Media(ALL)
        media.allow(MQTT_VIDEO, True)
        media.request(VIDEO_CONTROL, MediaRequest(enabled=True, encoding="pbvd"))
        media.request(VIDEO_CONTROL, MediaRequest(enabled=True, encoding=asked))
        assert media.requests()[CAMERA] == ProgramRequest(on=True, encoding=encoding)

    def test_what_runs_already_was_asked_for_and_can_be_stopped_before_its_flag_is_known(self) -> None:
        opus = ProgramRequest(on=True, encoding="opus")
        media = Media((CAMERA, MICROPHONE), running={MICROPHONE: opus})
        assert media.requests() == {CAMERA: NO}, "and the flag of audio is not known yet"
        media.request(AUDIO_CONTROL, MediaRequest(enabled=True))
        media.allow(MQTT_AUDIO, True)
        assert media.requests() == {CAMERA: NO, MICROPHONE: YES}, "there is no loudspeaker"
        media = Media(ALL, running={CAMERA: YES})
        media.request(VIDEO_CONTROL, MediaRequest(enabled=False))
        assert media.requests()[CAMERA] == NO


class AskingBridge(World):
    """A bridge in virtual time whose notify pipe ends here, where a launcher's would."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, one: bool) -> None:
        super().__init__("bridge", monkeypatch, one=one)
        self._read, self.write = os.pipe()
        os.set_blocking(self._read, False)
        monkeypatch.setenv(NOTIFY_FD, str(self.write))
        self.asked: list[notes.Note] = []

    def begin(self, **section: Any) -> None:
        self.start(av_daemon={"enabled": True}, **section)
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

    @pytest.mark.parametrize("side", ["local", "remote"])
    def test_a_retained_request_never_does(self, either: AskingBridge, side: str) -> None:
        client: Client = getattr(either, side)
        client.publish(VIDEO, ON, retain=True)
        either.begin()
        for flag in (VIDEO_FLAG, AUDIO_FLAG):
            client.publish(flag, TRUE, retain=True)
        client.publish(AUDIO, ON)
        assert (either.wanted(SPEAKER), either.wanted(CAMERA)) == ("1", "0")
        assert either.service.counters["stale"]

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
            ("thin", b'{"z": 0}', ""),
            ("wide", b'{"z": 0.5}', ""),
        ],
    )
    def test_on_a_thin_link_what_is_sent_waits_for_driving(
        self, either: AskingBridge, profile: str, drive: bytes, held: str
    ) -> None:
        either.begin(link={"profile": profile})
        either.remote.publish(DRIVE, drive)
        either.run(0.1)
        assert [either.wanted(program, Held, after=0.0) for program in ALL] == [held, held, ""]
        either.run(1.7)
        either.remote.publish(DRIVE, b'{"z": 0}')
        assert either.wanted(CAMERA, Held, after=3.1) == held
        assert either.wanted(CAMERA, Held, after=1.2) == held.replace("1", "0")

    def test_a_request_is_sent_again_to_a_busy_launcher(self, either: AskingBridge) -> None:
        either.begin()
        assert either.wanted(CAMERA) == "0"
        either.fill()
        either.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        either.remote.publish(VIDEO, ON)
        assert either.wanted(CAMERA) == "0"
        assert either.local.on(VIDEO)
        assert either.wanted(CAMERA) == "1"


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
    rig = MemoryRig(monkeypatch)
    yield rig
    rig.close()


class TestHeartbeat:
    def test_a_stop_on_sight_of_the_first_one_reaches_the_robot(self, rig: MemoryRig) -> None:
        """So a robot is not announced before it receives commands."""
        stops = iter([PRESS])

        def press(_: Message) -> None:
            for stop in stops:
                rig.remote.publish(STOP, stop)

        rig.remote.transport.subscribe(f"{BASE}/outgoing/online", press)
        rig.bridge()
        assert until(lambda: PRESS in rig.local.payloads(STOP))
        rig.close()
        assert b'"online":false' in rig.remote_hub.retained[f"{BASE}/outgoing/online"].payload


class TestUrgency:
    def test_a_stop_is_published_by_the_thread_that_received_it(
        self, rig: MemoryRig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """No queue and no other thread is in between, so nothing can delay it or take its place."""
        rig.bridge()
        threads: list[str] = []
        publish = MemoryTransport.publish

        def record(transport: MemoryTransport, topic: str, *arguments: Any, **options: Any) -> bool:
            if topic.endswith(STOP) and transport is rig.robot_side:
                threads.append(threading.current_thread().name)
                assert options["urgent"]
                assert options["qos"] is QoS.DELIVERED
            return publish(transport, topic, *arguments, **options)

        monkeypatch.setattr(MemoryTransport, "publish", record)
        rig.remote.publish(STOP, PRESS, qos=0)
        assert until(lambda: rig.local.on(STOP))
        assert threads == ["pebble-memory remote-bridge"]

    @pytest.mark.parametrize("retain", [False, True])
    def test_it_waits_for_no_lock_of_retained_messages(self, rig: MemoryRig, *, retain: bool) -> None:
        bridge = rig.bridge()
        held, over = threading.Event(), threading.Event()

        def hold(_topic: str) -> bool:
            held.set()
            return over.wait(WAIT_S)

        holding = partial(bridge.forwarder.retained.remove, Side.REMOTE, f"{BASE}/{STATE}", unless=hold)
        threading.Thread(target=holding, daemon=True).start()
        assert held.wait(WAIT_S)
        rig.remote.publish(STOP, PRESS, retain=retain)
        rig.remote.publish(MIRROR_FLAG, b"true", retain=True)
        assert until(lambda: rig.local.payloads(STOP) == [PRESS])
        assert not rig.local.on(MIRROR_FLAG)
        over.set()
        assert until(lambda: rig.local.on(MIRROR_FLAG))
