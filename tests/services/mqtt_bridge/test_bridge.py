"""The bridge between two transports in memory, with their threads: recordings, bursts, crashes, real actions."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pebble.services.mqtt_bridge.actions import SystemActions
from pebble.transports.memory import MemoryTransport
from tests.recordings.demo_robots import DRIVE as RECORDED_DRIVE
from tests.recordings.demo_robots import GOOB, messages, recorded
from tests.recordings.replayed import AS_RECORDED, Plays
from tests.services.mqtt_bridge.bridge_rig import Client, MemoryRig, Quiet
from tests.support import until

DRIVE = "incoming/drive-values"
#: Of the recording, without what is a device's own: that waits for the device's description, which no replay publishes.
RECORDED = (
    "logs", "status", "charging-level", "charging-status", "media-status", "autonomy-files", "autonomy-status",
    "soundboard-files", "soundboard-status", "sensors/imu",
)  # fmt: skip


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
    rig = MemoryRig(monkeypatch)
    yield rig
    rig.close()


@pytest.fixture
def goob(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
    """A bridge for the robot of the recordings."""
    rig = MemoryRig(monkeypatch, base=GOOB)
    yield rig
    rig.close()


def recorders(folder: Path, **more: Any) -> dict[str, Any]:
    """Actions that write down their own name instead of what they should do."""
    record = folder / "ran"
    return {
        f"{name}_control": {
            "command": [sys.executable, "-c", f"open({str(record)!r}, 'a').write('{name}\\n')"],
            "cooldown_seconds": 0,
            **more,
        }
        for name in ("reboot", "service_restart", "git_pull")
    }


def ran(folder: Path) -> list[str]:
    record = folder / "ran"
    return record.read_text().split() if record.exists() else []


def after_all(speaker: Client, listener: Client, suffix: str = "outgoing/after") -> None:
    """Wait until earlier messages of ``speaker`` have passed, if they do: one more message goes the same way."""
    mark = str(time.monotonic_ns()).encode()
    speaker.publish(suffix, mark)
    assert until(lambda: mark in listener.payloads(suffix))


class TestTable:
    def test_what_a_robot_published_reaches_the_remote_side_unchanged(self, goob: MemoryRig, recording: Plays) -> None:
        """Payloads, quality and order of each topic."""
        goob.bridge(robot="goob")
        recording([RECORDED_DRIVE], goob.local_hub, replace(AS_RECORDED, only=(f"{GOOB}/outgoing/#",)))
        after_all(goob.local, goob.remote)
        Quiet(goob.remote).wait()
        arrived = [(one.topic, one.payload, int(one.qos)) for one in goob.remote.seen]
        for topic in (f"{GOOB}/outgoing/{metric}" for metric in RECORDED):
            published = [one for one in messages(RECORDED_DRIVE) if one.channel.topic == topic]
            expected = [(topic, one.payload, int(one.channel.metadata["qos"])) for one in published]
            assert expected
            assert [one for one in arrived if one[0] == topic] == expected

    def test_recorded_commands_reach_the_robot_once_and_in_order(self, goob: MemoryRig, recording: Plays) -> None:
        goob.bridge(robot="goob")
        topic = f"{GOOB}/{DRIVE}"
        recording([RECORDED_DRIVE], goob.remote_hub, replace(AS_RECORDED, only=(topic,)))
        published = recorded(RECORDED_DRIVE, topic)
        assert len(published) > 100
        assert until(lambda: len(goob.local.on(DRIVE)) >= len(published))
        Quiet(goob.local, goob.remote).wait()
        assert goob.local.payloads(DRIVE) == published
        assert goob.remote.payloads(DRIVE) == published, "those of the recording alone"


class TestHeartbeat:
    def test_a_burst_does_not_delay_it(self, rig: MemoryRig, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO)
        rig.bridge(heartbeat={"interval_seconds": 0.05})
        before, began = len(rig.remote.on("outgoing/online")), time.monotonic()
        sent = 0
        while sent < 3000 or time.monotonic() < began + 0.5:  # ten heartbeats, however fast the machine is
            rig.local.publish("outgoing/status", b"%d" % sent, qos=0)
            sent += 1
        assert until(lambda: rig.remote.on("outgoing/status")[-1].payload == b"%d" % (sent - 1))
        heartbeats = len(rig.remote.on("outgoing/online")) - before
        assert heartbeats >= (time.monotonic() - began) / 0.05 / 3
        rig.stop_bridges()
        assert not [message for message in caplog.messages if "dropped from the inbox" in message]

    def test_the_will_is_published_after_a_crash(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.remote_hub.crash(rig.operator_side)
        assert until(lambda: json.loads(rig.remote.payloads("outgoing/online")[-1]).get("online") is False)
        assert rig.remote.on("outgoing/online")[-1].retain_requested


class TestOutage:
    def test_local_traffic_does_not_notice(self, rig: MemoryRig) -> None:
        rig.bridge()
        other = Client(MemoryTransport("somebody-else", rig.local_hub))
        rig.cut()
        for number in range(200):
            rig.local.publish("outgoing/status", b"%d" % number)
        assert until(lambda: len(other.on("outgoing/status")) == 200, 2)
        other.transport.close()


class TestActions:
    def test_one_that_fails_in_the_bridge_ends_nothing(
        self, rig: MemoryRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        bridge = rig.bridge(**recorders(tmp_path))
        with monkeypatch.context() as broken:
            broken.setattr(SystemActions, "request", lambda _actions, _channel: 1 / 0)
            rig.remote.publish("incoming/flags/reboot", b"true")
            assert until(lambda: bridge.counters["handler_errors"] == 1)
        rig.remote.publish("incoming/flags/git-pull", b"true")
        assert until(lambda: ran(tmp_path) == ["git_pull"])
