"""The bridge between two transports in memory, with their threads: recordings, bursts, urgent stops."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest

from pebble.forwarding.routing import Side
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryTransport
from tests.ext.recordings.demo_robots import DRIVE as RECORDED_DRIVE
from tests.ext.recordings.demo_robots import GOOB, messages, recorded
from tests.ext.recordings.replayed import Plays
from tests.services.mqtt_bridge.bridge_rig import BASE, Client, MemoryRig, Quiet
from tests.support import until

DRIVE, STOP, STATE = "incoming/drive-values", "incoming/estop", "outgoing/estop/mcu"
MIRROR_FLAG = "incoming/flags/remote-mirror"
PRESS, TRUE = b'{"stop": "00000000000000a1", "by": "test"}', b"true"
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


def after_all(speaker: Client, listener: Client, suffix: str = "outgoing/after") -> None:
    """Wait until earlier messages of ``speaker`` have passed, if they do: one more message goes the same way."""
    mark = str(time.monotonic_ns()).encode()
    speaker.publish(suffix, mark)
    assert until(lambda: mark in listener.payloads(suffix))


class TestTable:
    def test_what_a_robot_published_reaches_the_remote_side_unchanged(self, goob: MemoryRig, recording: Plays) -> None:
        """Payloads, quality and order of each topic."""
        goob.bridge(robot="goob")
        recording(RECORDED_DRIVE, goob.local_hub, f"{GOOB}/outgoing/#")
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
        recording(RECORDED_DRIVE, goob.remote_hub, topic)
        published = recorded(RECORDED_DRIVE, topic)
        assert len(published) > 100
        assert until(lambda: len(goob.local.on(DRIVE)) >= len(published))
        Quiet(goob.local, goob.remote).wait()
        assert goob.local.payloads(DRIVE) == published
        assert goob.remote.payloads(DRIVE) == published, "those of the recording alone"


class TestHeartbeat:
    def test_a_stop_on_sight_of_the_first_one_reaches_the_robot(self, rig: MemoryRig) -> None:
        """So a robot is not announced before it receives commands."""
        stops = iter([PRESS])

        def press(_: Message) -> None:
            for stop in stops:
                rig.remote.publish(STOP, stop)

        rig.remote.transport.subscribe(f"{BASE}/outgoing/online", press)
        rig.bridge()
        assert until(lambda: PRESS in rig.local.payloads(STOP), 3)

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
        rig.close()
        assert not [message for message in caplog.messages if "'inbox'" in message]


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
            return over.wait(10)

        holding = partial(bridge.forwarder.retained.remove, Side.REMOTE, f"{BASE}/{STATE}", unless=hold)
        threading.Thread(target=holding, daemon=True).start()
        assert held.wait(5)
        rig.remote.publish(STOP, PRESS, retain=retain)
        rig.remote.publish(MIRROR_FLAG, TRUE, retain=True)
        assert until(lambda: rig.local.payloads(STOP) == [PRESS], 5)
        assert not rig.local.on(MIRROR_FLAG)
        over.set()
        assert until(lambda: rig.local.on(MIRROR_FLAG))
