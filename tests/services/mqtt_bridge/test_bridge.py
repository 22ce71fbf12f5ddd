"""The bridge between two transports in memory: everything that does not need a real broker."""

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

from pebble.forwarding.event_buffer import LIMIT
from pebble.forwarding.side import Gate
from pebble.services.mqtt_bridge.actions import SystemActions
from pebble.transports import State
from pebble.transports.memory import MemoryTransport
from tests.recordings.demo_robots import DRIVE as RECORDED_DRIVE
from tests.recordings.demo_robots import GOOB, messages, recorded
from tests.recordings.replayed import AS_RECORDED, Plays
from tests.services.mqtt_bridge.bridge_rig import BASE, Client, MemoryRig, Quiet, gate_of
from tests.support import until

MIRROR_FLAG = "incoming/flags/remote-mirror"
VIDEO_FLAG = "incoming/flags/mqtt-video"
DRIVE = "incoming/drive-values"
TRUE, FALSE = b'{"value": true}', b'{"value": false}'
#: Of the recording, without what is a device's own: that waits for the device's description, which no replay publishes.
RECORDED = (
    "logs", "status", "charging-level", "charging-status", "media-status", "autonomy-files", "autonomy-status",
    "soundboard-files", "soundboard-status", "sensors/imu",
)  # fmt: skip
RETAINED_COMMANDS = [
    DRIVE,
    "incoming/flags/reboot",
    "incoming/flags/git-pull",
    "incoming/flags/service-restart",
    "incoming/soundboard-command",
    "incoming/autonomy-command",
    "incoming/something-new",
]


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

    def test_state_is_retained_there(self, rig: MemoryRig) -> None:
        rig.local.publish("outgoing/soundboard-files", b"before", retain=True)
        rig.bridge()
        rig.local.publish("outgoing/autonomy-files", b"live", retain=True)
        retained = rig.remote_hub.retained
        assert until(lambda: f"{BASE}/outgoing/autonomy-files" in retained)
        assert retained[f"{BASE}/outgoing/soundboard-files"].payload == b"before"

    def test_removing_state_removes_it_there(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.local.publish("outgoing/autonomy-files", b"live", retain=True)
        assert until(lambda: f"{BASE}/outgoing/autonomy-files" in rig.remote_hub.retained)
        rig.local.publish("outgoing/autonomy-files", b"", retain=True)
        assert until(lambda: f"{BASE}/outgoing/autonomy-files" not in rig.remote_hub.retained)

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

    def test_remote_outgoing_never_comes_in(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.remote.publish("outgoing/status", b"no", retain=True)
        after_all(rig.remote, rig.local, "incoming/lights-solid")
        assert not rig.local.on("outgoing/status")

    def test_local_commands_go_out_only_while_mirroring(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.local.publish(DRIVE, b"1")
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        rig.local.publish(DRIVE, b"2")
        rig.local.publish(MIRROR_FLAG, b'{"enabled": false}', retain=True)
        rig.local.publish(DRIVE, b"3")
        after_all(rig.local, rig.remote)
        assert rig.remote.payloads(DRIVE) == [b"2"]

    @pytest.mark.parametrize("true", [b"true", TRUE, b'{"enabled": true}'])
    def test_the_mirror_flag_may_come_from_the_remote_side(self, rig: MemoryRig, true: bytes) -> None:
        rig.bridge()
        rig.remote.publish(MIRROR_FLAG, true)
        assert until(lambda: rig.local.on(MIRROR_FLAG))
        rig.local.publish(DRIVE, b"2")
        assert until(lambda: rig.remote.on(DRIVE))
        rig.remote.publish(MIRROR_FLAG, b"", retain=True)  # removed: back to the default
        assert until(lambda: len(rig.local.on(MIRROR_FLAG)) == 2)
        rig.local.publish(DRIVE, b"3")
        after_all(rig.local, rig.remote)
        assert rig.remote.payloads(DRIVE) == [b"2"]

    @pytest.mark.parametrize("nonsense", [b"1", b'"true"', b"{", b"\xff", b"[true]"])
    def test_nonsense_does_not_switch_mirroring_on(self, rig: MemoryRig, nonsense: bytes) -> None:
        bridge = rig.bridge()
        rig.local.publish(MIRROR_FLAG, nonsense)
        rig.local.publish(DRIVE, b"2")
        after_all(rig.local, rig.remote)
        assert not rig.remote.on(DRIVE)
        assert bridge.counters["refused"] == 1

    def test_what_an_mcu_wants_private_stays_private(self, rig: MemoryRig) -> None:
        rig.bridge()
        manifest = {
            "protocol": "pebble_serial_v1", "schema_version": 1, "interface_count": 2, "schema_hash": "h",
            "device_uid": "imu-1", "firmware_version": "1", "model": "nano",
            "interfaces": [{"name": "fast", "channel": "sensors/extra", "local_only": True}, {"name": "slow"}],
        }  # fmt: skip
        rig.local.publish("outgoing/mcu/imu-1/describe", json.dumps(manifest).encode(), retain=True)
        for suffix in ("outgoing/mcu/imu-1/fast", "outgoing/sensors/extra", "outgoing/mcu/imu-1/slow"):
            rig.local.publish(suffix, b"{}")
        after_all(rig.local, rig.remote)
        assert rig.remote.on("outgoing/mcu/imu-1/describe")
        assert rig.remote.on("outgoing/mcu/imu-1/slow")
        assert not rig.remote.on("outgoing/mcu/imu-1/fast")
        assert not rig.remote.on("outgoing/sensors/extra")


class TestHeartbeat:
    def test_at_once_then_at_its_interval_to_the_remote_side_only(self, rig: MemoryRig) -> None:
        rig.bridge(ready=False)
        assert until(lambda: len(rig.remote.on("outgoing/online")) >= 6)
        heartbeats = rig.remote.on("outgoing/online")
        stamps = [json.loads(heartbeat.payload) for heartbeat in heartbeats]
        assert all(set(stamp) == {"t"} and type(stamp["t"]) is int for stamp in stamps)
        assert all(heartbeat.qos == 1 and heartbeat.retain_requested for heartbeat in heartbeats)
        assert 900 < stamps[-1]["t"] - stamps[1]["t"] < 3000
        assert not rig.local.on("outgoing/online")

    def test_again_after_an_outage_at_once(self, rig: MemoryRig) -> None:
        rig.bridge(heartbeat={"interval_seconds": 30})
        before = len(rig.remote.on("outgoing/online"))
        rig.remote_hub.stop()
        rig.remote_hub.start()
        assert until(lambda: len(rig.remote.on("outgoing/online")) > before, 5)

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

    def test_and_after_a_polite_end(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.stop_bridges()
        assert until(lambda: json.loads(rig.remote.payloads("outgoing/online")[-1]).get("online") is False)

    def test_can_be_off_and_then_belongs_to_others(self, rig: MemoryRig) -> None:
        rig.bridge(heartbeat={"enabled": False})
        rig.local.publish("outgoing/online", b'{"t": 1}', retain=True)
        assert until(lambda: rig.remote.payloads("outgoing/online") == [b'{"t": 1}'])

    def test_renamed(self, rig: MemoryRig) -> None:
        rig.bridge(heartbeat={"topic": f"{BASE}/outgoing/alive", "qos": 0, "retain": False})
        assert until(lambda: rig.remote.on("outgoing/alive"))
        assert not rig.remote.on("outgoing/alive")[0].retain_requested
        rig.local.publish("outgoing/online", b"mine")
        assert until(lambda: rig.remote.payloads("outgoing/online") == [b"mine"])


class TestOutage:
    def test_the_remote_side_has_the_current_state_afterwards(self, rig: MemoryRig) -> None:
        rig.local.publish("outgoing/autonomy-files", b"start-up", retain=True)
        rig.bridge()
        rig.cut()
        rig.remote_hub.retained.clear()
        taken = rig.taken()
        rig.local.publish("outgoing/autonomy-files", b"newer", retain=True)
        rig.local.publish("outgoing/soundboard-files", b"new", retain=True)
        assert until(lambda: rig.taken() == taken + 2)
        rig.uplink.mend()
        assert until(lambda: rig.remote.payloads("outgoing/soundboard-files") == [b"new"])
        assert until(lambda: rig.remote.payloads("outgoing/autonomy-files")[-1] == b"newer")
        assert b"start-up" not in rig.remote.payloads("outgoing/autonomy-files")[1:]

    def test_state_of_a_robot_that_starts_without_uplink_arrives_later(self, rig: MemoryRig) -> None:
        rig.uplink.cut()
        rig.local.publish("outgoing/capabilities", b"old", retain=True)
        rig.bridge(ready=False)
        assert until(lambda: rig.robot_side.state is State.CONNECTED)
        rig.local.publish("outgoing/capabilities", b"new", retain=True)
        rig.local.publish("outgoing/somebody/happened", b"1")
        assert until(lambda: rig.taken() == 3)
        rig.uplink.mend()
        assert until(lambda: rig.remote.payloads("outgoing/capabilities") == [b"new"])
        assert until(lambda: rig.remote.payloads("outgoing/somebody/happened") == [b"1"])

    def test_events_wait_streams_and_commands_do_not(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        after_all(rig.local, rig.remote)
        rig.cut()
        taken = rig.taken()
        rig.local.publish("outgoing/somebody/happened", b"event")
        rig.local.publish("outgoing/touch-sensors", b"stream")
        rig.local.publish("outgoing/somebody/stream", b"stream", qos=0)
        rig.local.publish(DRIVE, b"command")
        rig.local.publish("incoming/flags/reboot", b"true")
        rig.local.publish("outgoing/somebody/happened", b"later")
        assert until(lambda: rig.taken() == taken + 6)
        rig.uplink.mend()
        assert until(lambda: rig.remote.payloads("outgoing/somebody/happened")[-1:] == [b"later"])
        after_all(rig.local, rig.remote)
        assert rig.remote.payloads("outgoing/somebody/happened") == [b"event", b"later"]
        for suffix in ("outgoing/touch-sensors", "outgoing/somebody/stream", DRIVE, "incoming/flags/reboot"):
            assert not rig.remote.on(suffix)

    def test_waiting_events_are_bounded_and_the_oldest_go(self, rig: MemoryRig) -> None:
        bridge = rig.bridge()
        rig.cut()
        for number in range(LIMIT + 100):
            rig.local.publish("outgoing/somebody/happened", b"%d" % number)
        assert until(lambda: bridge.forwarder.counters["events_dropped"] == 100)
        rig.uplink.mend()
        assert until(lambda: len(rig.remote.on("outgoing/somebody/happened")) == LIMIT)
        assert rig.remote.payloads("outgoing/somebody/happened")[0] == b"100"

    def test_local_traffic_does_not_notice(self, rig: MemoryRig) -> None:
        rig.bridge()
        other = Client(MemoryTransport("somebody-else", rig.local_hub))
        rig.cut()
        for number in range(200):
            rig.local.publish("outgoing/status", b"%d" % number)
        assert until(lambda: len(other.on("outgoing/status")) == 200, 2)
        other.transport.close()


class TestFlags:
    def retained(self, rig: MemoryRig) -> tuple[bytes | None, bytes | None]:
        """The retained values of the flag: local, remote."""
        topic = f"{BASE}/{VIDEO_FLAG}"
        local, remote = rig.local_hub.retained.get(topic), rig.remote_hub.retained.get(topic)
        return local and local.payload, remote and remote.payload

    def test_pass_both_ways_and_are_retained(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.remote.publish(VIDEO_FLAG, TRUE)  # the operator did not set the retain flag
        assert until(lambda: rig.local.payloads(VIDEO_FLAG) == [TRUE])
        assert self.retained(rig)[0] == TRUE
        rig.local.publish(VIDEO_FLAG, FALSE, retain=True)
        assert until(lambda: rig.remote.payloads(VIDEO_FLAG) == [FALSE])
        assert self.retained(rig) == (FALSE, FALSE)

    def test_that_differ_at_the_start_take_the_remote_value(self, rig: MemoryRig) -> None:
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        rig.bridge()
        assert until(lambda: self.retained(rig) == (FALSE, FALSE))
        Quiet(rig.local, rig.remote).wait(0.7)
        assert self.retained(rig) == (FALSE, FALSE)
        assert rig.local.payloads(VIDEO_FLAG) == [FALSE]  # once: no flapping
        assert not rig.remote.on(VIDEO_FLAG)

    def test_that_only_the_robot_knows_are_published(self, rig: MemoryRig) -> None:
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.bridge()
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        Quiet(rig.local, rig.remote).wait(0.7)
        assert rig.remote.payloads(VIDEO_FLAG) == [TRUE]
        assert not rig.local.on(VIDEO_FLAG)

    def test_that_differ_with_the_uplink_coming_later(self, rig: MemoryRig) -> None:
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        rig.uplink.cut()
        rig.bridge(ready=False)
        assert until(lambda: rig.taken() == 1)
        rig.uplink.mend()
        assert until(lambda: self.retained(rig) == (FALSE, FALSE))
        Quiet(rig.local, rig.remote).wait(0.7)
        assert self.retained(rig) == (FALSE, FALSE)

    def test_changed_locally_before_the_first_uplink_win(self, rig: MemoryRig) -> None:
        rig.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        rig.uplink.cut()
        rig.bridge(ready=False)
        assert until(lambda: rig.robot_side.state is State.CONNECTED)
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        assert until(lambda: rig.taken() == 1)
        rig.uplink.mend()
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        Quiet(rig.local, rig.remote).wait(0.7)
        assert self.retained(rig) == (TRUE, TRUE)
        assert not rig.local.on(VIDEO_FLAG)

    def test_changed_locally_during_an_outage_win(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        assert until(lambda: self.retained(rig) == (FALSE, FALSE))
        rig.cut()
        taken = rig.taken()
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        assert until(lambda: rig.taken() == taken + 1)
        rig.uplink.mend()
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        Quiet(rig.local, rig.remote).wait(0.7)
        assert self.retained(rig) == (TRUE, TRUE)
        assert rig.local.payloads(VIDEO_FLAG) == [FALSE]

    def test_changed_remotely_during_an_outage_win_otherwise(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        rig.cut()
        rig.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        rig.uplink.mend()
        assert until(lambda: self.retained(rig) == (FALSE, FALSE))
        Quiet(rig.local, rig.remote).wait(0.7)
        assert self.retained(rig) == (FALSE, FALSE)

    def test_changed_remotely_while_the_local_side_was_away(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.local.publish(VIDEO_FLAG, FALSE, retain=True)
        assert until(lambda: self.retained(rig) == (FALSE, FALSE))
        rig.local_hub.stop()
        assert until(lambda: rig.robot_side.state is State.CONNECTING)
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        assert until(lambda: rig.operator_side.counters["delivered"] >= 1)
        rig.local_hub.start()
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        Quiet(rig.local, rig.remote).wait(0.7)
        assert self.retained(rig) == (TRUE, TRUE)

    @pytest.mark.parametrize("first", ["local", "remote"])
    @pytest.mark.parametrize("forgetful", ["local", "remote"])
    def test_a_side_that_lost_a_value_receives_the_newest(self, rig: MemoryRig, first: str, forgetful: str) -> None:
        """Also if the last value that the bridge sent there is older: no stale value returns."""
        rig.bridge()
        speakers = [rig.local, rig.remote] if first == "local" else [rig.remote, rig.local]
        speakers[0].publish(VIDEO_FLAG, FALSE, retain=True, remember=False)
        assert until(lambda: self.retained(rig) == (FALSE, FALSE))
        speakers[1].publish(VIDEO_FLAG, TRUE, retain=True, remember=False)  # only the bridge has it
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        hub = rig.local_hub if forgetful == "local" else rig.remote_hub
        hub.stop(forget=True)
        hub.start()
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        Quiet(rig.local, rig.remote).wait(0.7)
        assert self.retained(rig) == (TRUE, TRUE)

    def test_a_restarted_bridge_changes_nothing(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        rig.stop_bridges()
        rig.bridge()
        Quiet(rig.local, rig.remote).wait(0.7)
        assert self.retained(rig) == (TRUE, TRUE)

    def test_removed_on_one_side_are_removed_on_the_other(self, rig: MemoryRig) -> None:
        rig.bridge()
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        assert until(lambda: self.retained(rig) == (TRUE, TRUE))
        rig.remote.publish(VIDEO_FLAG, b"", retain=True)
        assert until(lambda: self.retained(rig) == (None, None))


class TestRetainedCommands:
    @pytest.mark.parametrize("retaining_client", ["local", "remote"])
    def test_neither_cross_nor_run(self, rig: MemoryRig, tmp_path: Path, retaining_client: str) -> None:
        speaker, listener = (rig.local, rig.remote) if retaining_client == "local" else (rig.remote, rig.local)
        for suffix in RETAINED_COMMANDS:
            speaker.publish(suffix, b"true", retain=True)
        rig.bridge(**recorders(tmp_path))
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        rig.cut()
        rig.uplink.mend()
        Quiet(rig.local, rig.remote).wait(0.8)
        assert not [m for m in listener.seen if m.topic.removeprefix(f"{BASE}/") in RETAINED_COMMANDS]
        assert not ran(tmp_path)

    @pytest.mark.parametrize("retaining_client", ["local", "remote"])
    def test_published_as_retained_during_the_check_neither(
        self, rig: MemoryRig, tmp_path: Path, retaining_client: str
    ) -> None:
        rig.bridge(**recorders(tmp_path))
        speaker, listener = (rig.local, rig.remote) if retaining_client == "local" else (rig.remote, rig.local)
        for suffix in RETAINED_COMMANDS:
            speaker.publish(suffix, b"true", retain=True)
        Quiet(rig.local, rig.remote).wait(0.5)
        assert not [m for m in listener.seen if m.topic.removeprefix(f"{BASE}/") in RETAINED_COMMANDS]
        assert not ran(tmp_path)


class TestActions:
    @pytest.mark.parametrize("side", ["local", "remote"])
    @pytest.mark.parametrize("true", [b"true", TRUE, b'{"enabled": true}'])
    def test_run_from_either_side_once(self, rig: MemoryRig, tmp_path: Path, side: str, true: bytes) -> None:
        rig.bridge(**recorders(tmp_path))
        speaker, listener = (rig.local, rig.remote) if side == "local" else (rig.remote, rig.local)
        speaker.publish("incoming/flags/git-pull", true)
        assert until(lambda: ran(tmp_path) == ["git_pull"])
        assert listener.payloads("incoming/flags/git-pull") == [true]
        Quiet(rig.local, rig.remote).wait()
        assert ran(tmp_path) == ["git_pull"]

    def test_from_the_local_side_without_uplink(self, rig: MemoryRig, tmp_path: Path) -> None:
        rig.uplink.cut()
        rig.bridge(ready=False, **recorders(tmp_path))
        rig.local.publish("incoming/flags/service-restart", b"true")
        assert until(lambda: ran(tmp_path) == ["service_restart"])

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

    @pytest.mark.parametrize("no", [b"false", b'{"value": false}', b"1", b'"true"', b"null", b"", b"[true]", b"\xff"])
    def test_nothing_but_true_runs(self, rig: MemoryRig, tmp_path: Path, no: bytes) -> None:
        rig.bridge(**recorders(tmp_path))
        rig.remote.publish("incoming/flags/reboot", no)
        rig.local.publish("incoming/flags/reboot", no)
        rig.local.publish("incoming/flags/git-pull", b"true")
        assert until(lambda: ran(tmp_path) == ["git_pull"])

    def test_retained_ones_run_if_the_config_allows_it(self, rig: MemoryRig, tmp_path: Path) -> None:
        rig.local.publish("incoming/flags/reboot", b"true", retain=True)
        rig.bridge(**recorders(tmp_path, ignore_retained=False))
        assert until(lambda: ran(tmp_path) == ["reboot"])

    def test_renamed(self, rig: MemoryRig, tmp_path: Path) -> None:
        rig.bridge(topics={"reboot": "site/reboot"}, **recorders(tmp_path))
        rig.remote.transport.publish("site/reboot", b"true")
        assert until(lambda: ran(tmp_path) == ["reboot"])


class TestOneBroker:
    @pytest.fixture
    def one(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
        rig = MemoryRig(monkeypatch, one=True)
        yield rig
        rig.close()

    def test_nothing_is_mirrored_and_the_heartbeat_is_published(self, one: MemoryRig) -> None:
        one.local.publish("outgoing/status", b"before", retain=True)
        bridge = one.bridge()
        assert gate_of(bridge) is Gate.SHUT
        for suffix in (MIRROR_FLAG, VIDEO_FLAG, "outgoing/status", DRIVE):
            one.local.publish(suffix, TRUE)
        Quiet(one.local, one.remote).wait(0.8)
        for suffix in (MIRROR_FLAG, VIDEO_FLAG, DRIVE):
            assert one.remote.payloads(suffix) == [TRUE]
        assert one.remote.payloads("outgoing/status") == [b"before", TRUE]
        assert until(lambda: len(one.remote.on("outgoing/online")) > 4)

    def test_actions_work(self, one: MemoryRig, tmp_path: Path) -> None:
        one.local.publish("incoming/flags/reboot", b"true", retain=True)
        one.bridge(**recorders(tmp_path))
        one.remote.publish("incoming/flags/git-pull", b"true")
        assert until(lambda: ran(tmp_path) == ["git_pull"])
        Quiet(one.local, one.remote).wait()
        assert ran(tmp_path) == ["git_pull"]

    def test_without_heartbeat_it_is_found_out_too(self, one: MemoryRig) -> None:
        assert gate_of(one.bridge(heartbeat={"enabled": False})) is Gate.SHUT

    def test_still_so_after_an_outage(self, one: MemoryRig) -> None:
        bridge = one.bridge()
        one.local_hub.stop()
        one.local_hub.start()
        assert until(lambda: bridge.transport.counters["connected"] == bridge.remote.counters["connected"] == 2)
        before = len(one.remote.on("outgoing/online"))
        assert until(lambda: len(one.remote.on("outgoing/online")) > before + 2)  # a round of probes takes less
        assert gate_of(bridge) is Gate.SHUT
        one.local.publish("outgoing/strange", b"1")
        Quiet(one.local, one.remote).wait(0.5)
        assert one.remote.payloads("outgoing/strange") == [b"1"]

    def test_a_heartbeat_seen_later_ends_the_mirroring(self, rig: MemoryRig) -> None:
        """Publishes as if another bridge had begun to join the two brokers."""
        bridge = rig.bridge()
        joint = Client(MemoryTransport("joint", rig.remote_hub), listen=False)
        onto = Client(MemoryTransport("onto", rig.local_hub), listen=False)
        joint.transport.subscribe(
            f"{BASE}/outgoing/#", lambda m: onto.transport.publish(m.topic, m.payload, qos=m.qos), echo=False
        )
        assert until(lambda: gate_of(bridge) is Gate.SHUT, 5)
        joint.transport.close()
        onto.transport.close()

    def test_a_heartbeat_of_another_program_on_the_local_side_does_not(self, rig: MemoryRig) -> None:
        """Even if it names the same millisecond."""
        bridge = rig.bridge()
        assert until(lambda: rig.remote.on("outgoing/online"))
        for heartbeat in rig.remote.payloads("outgoing/online"):
            rig.local.publish("outgoing/online", heartbeat)
        rig.remote.publish(DRIVE, b"1")
        assert until(lambda: rig.local.on(DRIVE))
        time.sleep(1.2)  # a probe would have given it away
        assert gate_of(bridge) is Gate.OPEN


class TestStorms:
    @pytest.mark.parametrize("mirroring", [False, True])
    @pytest.mark.parametrize("side", ["local", "remote"])
    def test_alternating_flags_arrive_once_each_in_order(self, rig: MemoryRig, side: str, mirroring: bool) -> None:
        rig.bridge()
        rig.local.publish(MIRROR_FLAG, TRUE if mirroring else FALSE, retain=True)
        after_all(rig.local, rig.remote)
        speaker, listener = (rig.local, rig.remote) if side == "local" else (rig.remote, rig.local)
        for number in range(1000):
            speaker.publish(VIDEO_FLAG, FALSE if number % 2 else TRUE, retain=True)
        assert until(lambda: len(listener.on(VIDEO_FLAG)) >= 1000)
        Quiet(rig.local, rig.remote).wait()
        assert listener.payloads(VIDEO_FLAG) == [TRUE, FALSE] * 500
        assert not speaker.on(VIDEO_FLAG)
