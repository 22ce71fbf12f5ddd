"""The bridge between real brokers: storms, one broker under two names, brokers without bridge mode, dead links."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.forwarding.admission import MAX_UNKNOWN_FLAGS
from pebble.forwarding.routing import Drop, Side
from pebble.forwarding.side import Gate
from pebble.transports import State
from tests.services.mqtt_bridge.bridge_rig import Client, MqttRig, Quiet, gate_of
from tests.support import AmqttBroker, Broker, some, until
from tests.tcp_proxy import TcpProxy

MIRROR_FLAG = "incoming/flags/remote-mirror"
VIDEO_FLAG = "incoming/flags/mqtt-video"
AUDIO_FLAG = "incoming/flags/mqtt-audio"
DRIVE = "incoming/drive-values"
TRUE, FALSE = b'{"value": true}', b'{"value": false}'
ONE_SHOTS = [
    DRIVE,
    "incoming/flags/reboot",
    "incoming/flags/git-pull",
    "incoming/flags/service-restart",
    "incoming/soundboard-command",
    "incoming/autonomy-command",
]

Rigs = Callable[..., MqttRig]


@pytest.fixture(scope="module")
def brokers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Broker, Broker]]:
    """The robot's broker and the operators'."""
    folder = tmp_path_factory.mktemp("brokers")
    local, remote = Broker(folder), Broker(folder)
    yield local, remote
    local.stop()
    remote.stop()


@pytest.fixture(scope="module")
def amqtt() -> Iterator[tuple[AmqttBroker, AmqttBroker]]:
    brokers = AmqttBroker(), AmqttBroker()
    yield brokers
    for broker in brokers:
        broker.stop()


@pytest.fixture
def spare(tmp_path: Path) -> Iterator[Broker]:
    """A broker of one test's own, which loses its messages when it is killed."""
    broker = Broker(tmp_path)
    yield broker
    broker.kill()


@pytest.fixture
def link(brokers: tuple[Broker, Broker]) -> Iterator[TcpProxy]:
    """A way to the operators' broker that can fail."""
    with TcpProxy(brokers[1].port) as link:
        yield link


@pytest.fixture
def rigs() -> Iterator[Rigs]:
    """Makes rigs that end with the test."""
    made: list[MqttRig] = []

    def make(local: dict[str, Any], remote: dict[str, Any], **more: Any) -> MqttRig:
        made.append(MqttRig(local, remote, **more))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


def at(broker: Broker | AmqttBroker, **more: Any) -> dict[str, Any]:
    return {"host": "127.0.0.1", "port": broker.port, **more}


def recorders(folder: Path) -> dict[str, Any]:
    record = folder / "ran"
    return {
        f"{name}_control": {
            "command": [sys.executable, "-c", f"open({str(record)!r}, 'a').write('{name}\\n')"],
            "cooldown_seconds": 0,
        }
        for name in ("reboot", "service_restart", "git_pull")
    }


def storm(*voices: tuple[Client, str, list[bytes]], seconds: float = 2.0, retain: bool = False) -> None:
    """Every client publishes all of it, evenly spread and in turns."""
    began = time.monotonic()
    rounds = list(zip(*(payloads for _, _, payloads in voices), strict=True))
    for number, payloads in enumerate(rounds, 1):
        for (client, suffix, _), payload in zip(voices, payloads, strict=True):
            client.publish(suffix, payload, retain=retain)
        time.sleep(max(0.0, began + number * seconds / len(rounds) - time.monotonic()))


class TestPlanted:
    def test_retained_flags_of_strangers_cost_the_robot_neither_memory_nor_its_commands(
        self, brokers: tuple[Broker, Broker], spare: Broker, rigs: Rigs
    ) -> None:
        rig = rigs(at(brokers[0]), at(spare))
        for number in range(3000):
            rig.remote.publish(f"incoming/flags/f{number}", b"x" * 100, qos=0, retain=True)
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.start()
        assert until(lambda: rig.local.payloads(VIDEO_FLAG) == [TRUE])
        rig.remote.publish(DRIVE, b'{"x": 0, "z": 0.5}')
        assert until(lambda: rig.local.on(DRIVE))
        Quiet(rig.local, rig.remote).wait()
        assert len({one.topic for one in rig.local.seen if "/flags/f" in one.topic}) == MAX_UNKNOWN_FLAGS
        assert rig.bridge.dropped()["too_many"] == 3000 - MAX_UNKNOWN_FLAGS


class TestStorms:
    @pytest.mark.parametrize(("mirroring", "protocol"), some([(True, "5"), (False, "3.1.1"), (True, "3.1.1")], 3))
    def test_1000_alternating_flags_in_2_s_arrive_once_each_in_order(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, mirroring: bool, protocol: str
    ) -> None:
        rig = rigs(at(brokers[0], protocol=protocol), at(brokers[1], protocol=protocol))
        rig.start()
        rig.local.publish(MIRROR_FLAG, TRUE if mirroring else FALSE, retain=True)
        flags = [TRUE, FALSE] * 500
        storm((rig.local, VIDEO_FLAG, flags), (rig.remote, AUDIO_FLAG, flags), retain=True)
        assert until(lambda: len(rig.remote.on(VIDEO_FLAG)) >= 1000 and len(rig.local.on(AUDIO_FLAG)) >= 1000)
        Quiet(rig.local, rig.remote).wait()
        assert rig.remote.payloads(VIDEO_FLAG) == flags
        assert rig.local.payloads(AUDIO_FLAG) == flags
        assert not rig.local.on(VIDEO_FLAG)
        assert not rig.remote.on(AUDIO_FLAG)

    def test_1000_alternating_commands_while_mirroring(self, brokers: tuple[Broker, Broker], rigs: Rigs) -> None:
        rig = rigs(at(brokers[0]), at(brokers[1]))
        rig.start()
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        assert until(lambda: rig.remote.on(MIRROR_FLAG))
        commands = [b'{"x": 0, "z": 1}', b'{"x": 0, "z": 0}'] * 500
        lights = "incoming/lights-solid"
        storm((rig.local, DRIVE, commands), (rig.remote, lights, commands))
        assert until(lambda: len(rig.remote.on(DRIVE)) >= 1000 and len(rig.local.on(lights)) >= 1000)
        Quiet(rig.local, rig.remote).wait()
        assert rig.remote.payloads(DRIVE) == commands
        assert rig.local.payloads(lights) == commands
        assert not rig.local.on(DRIVE)
        assert not rig.remote.on(lights)

    def test_from_both_sides_at_once_nothing_circulates(self, brokers: tuple[Broker, Broker], rigs: Rigs) -> None:
        rig = rigs(at(brokers[0]), at(brokers[1]))
        rig.start()
        for _ in range(500):
            rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
            rig.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        assert until(lambda: len(rig.local.on(VIDEO_FLAG)) >= 500 and len(rig.remote.on(VIDEO_FLAG)) >= 500)
        Quiet(rig.local, rig.remote).wait()
        assert rig.local.payloads(VIDEO_FLAG) == [FALSE] * 500
        assert rig.remote.payloads(VIDEO_FLAG) == [TRUE] * 500

    def test_one_broker_under_two_names(self, brokers: tuple[Broker, Broker], rigs: Rigs) -> None:
        here = {"host": "localhost", "port": brokers[0].port}
        rig = rigs(here, at(brokers[0]))
        rig.remote.publish("outgoing/status", b"{}", retain=True)
        rig.start()
        assert gate_of(rig.bridge) is Gate.SHUT
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        storm((rig.local, VIDEO_FLAG, [TRUE, FALSE] * 500), retain=True)
        storm((rig.local, "outgoing/soundboard-files", [TRUE, FALSE] * 50), seconds=0.1, retain=True)
        Quiet(rig.local, rig.remote).wait()
        assert rig.remote.payloads(VIDEO_FLAG) == [TRUE, FALSE] * 500
        assert len(rig.remote.on("outgoing/soundboard-files")) == 100
        assert len(rig.remote.on("outgoing/online")) > 4


class TestBrokersWithoutBridgeMode:
    """amqtt sends our own messages back and hides the retain flag of live ones."""

    def test_a_storm_of_flags_comes_to_rest_with_the_newest_on_both_sides(
        self, amqtt: tuple[AmqttBroker, AmqttBroker], rigs: Rigs
    ) -> None:
        rig = rigs(at(amqtt[0]), at(amqtt[1]))
        rig.start()
        assert not rig.bridge.transport.exact_echo
        storm((rig.local, VIDEO_FLAG, [TRUE, FALSE] * 500), (rig.remote, AUDIO_FLAG, [FALSE, TRUE] * 500), retain=True)
        rig.remote.publish("incoming/flags/git-pull", b"true")
        Quiet(rig.local, rig.remote).wait(1.0, 20)
        assert 1 <= len(rig.remote.on(VIDEO_FLAG)) <= 1000
        assert 1 <= len(rig.local.on(AUDIO_FLAG)) <= 1000
        assert rig.remote.payloads(VIDEO_FLAG)[-1] == FALSE
        assert rig.local.payloads(AUDIO_FLAG)[-1] == TRUE
        too_late = rig.bridge.forwarder.counters[f"remote: {Drop.LATE.value}"]  # on a busy machine, behind the flags
        assert len(rig.local.on("incoming/flags/git-pull")) + too_late == 1

    def test_mirroring_is_refused_with_one_clear_error(
        self, amqtt: tuple[AmqttBroker, AmqttBroker], rigs: Rigs, caplog: pytest.LogCaptureFixture
    ) -> None:
        rig = rigs(at(amqtt[0]), at(amqtt[1]))
        rig.start()
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        assert until(lambda: rig.remote.on(MIRROR_FLAG))
        for number in range(1, 21):
            rig.local.publish(DRIVE, b'{"x": 0, "z": 1}')
            assert until(lambda number=number: len(rig.local.on(DRIVE)) >= number)  # type: ignore[misc]
        rig.remote.publish("incoming/lights-solid", b"{}")
        assert until(lambda: rig.local.on("incoming/lights-solid"))
        Quiet(rig.local, rig.remote).wait()
        assert not rig.remote.on(DRIVE)
        assert len(rig.local.on("incoming/lights-solid")) == 1
        errors = [record.message for record in caplog.records if "remote-mirror is refused" in record.message]
        assert len(errors) == 1

    def test_equal_drive_commands_are_all_delivered(self, amqtt: tuple[AmqttBroker, AmqttBroker], rigs: Rigs) -> None:
        rig = rigs(at(amqtt[0]), at(amqtt[1]))
        rig.start()
        for number in range(1, 51):  # one by one: this broker loses some of a burst now and then
            rig.remote.publish(DRIVE, b'{"x": 0, "z": 0}')
            assert until(lambda number=number: len(rig.local.on(DRIVE)) >= number)  # type: ignore[misc]
        Quiet(rig.local, rig.remote).wait()
        assert len(rig.local.on(DRIVE)) == 50


class TestRetained:
    @pytest.mark.parametrize("retaining_client", ["local", "remote"])
    def test_retained_commands_neither_run_nor_cross(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, link: TcpProxy, tmp_path: Path, retaining_client: str
    ) -> None:
        rig = rigs(at(brokers[0]), at(brokers[1]), uplink=link.port, **recorders(tmp_path))
        speaker = rig.client(retaining_client, listen=False)
        for suffix in ONE_SHOTS:
            speaker.publish(suffix, b"true", retain=True)
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        rig.start()
        link.drop()
        assert until(lambda: rig.bridge.status.epoch >= 2)
        assert until(lambda: Side.REMOTE in rig.bridge.status.subscribed)
        Quiet(rig.local, rig.remote).wait(0.8)
        crossed = rig.remote if retaining_client == "local" else rig.local
        assert not [m for m in crossed.seen if m.topic.removeprefix(f"{rig.base}/") in ONE_SHOTS]
        assert not (tmp_path / "ran").exists()

    @pytest.mark.parametrize(("delay_s", "piece"), [(0.0, 65536), (0.15, 65536), (0.02, 8)])
    def test_flags_that_differ_at_the_start(
        self, brokers: tuple[Broker, Broker], rigs: Rigs, link: TcpProxy, delay_s: float, piece: int
    ) -> None:
        link.delay_s, link.piece = delay_s, piece
        rig = rigs(at(brokers[0]), at(brokers[1]), uplink=link.port)
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        rig.local.publish(AUDIO_FLAG, TRUE, retain=True)
        rig.start()
        assert until(lambda: rig.local.payloads(VIDEO_FLAG) == [FALSE])
        assert until(lambda: rig.remote.payloads(AUDIO_FLAG) == [TRUE])
        Quiet(rig.local, rig.remote).wait(0.8)
        assert rig.retained("local") == rig.retained("remote") == {VIDEO_FLAG: FALSE, AUDIO_FLAG: TRUE}
        assert rig.local.payloads(VIDEO_FLAG) == [FALSE]
        assert not rig.remote.on(VIDEO_FLAG)

    def test_a_remote_broker_that_forgot_everything_gets_the_current_state(
        self, spare: Broker, brokers: tuple[Broker, Broker], rigs: Rigs
    ) -> None:
        rig = rigs(at(brokers[0]), at(spare))
        rig.local.publish("outgoing/capabilities", b"old", retain=True)
        rig.start()
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        assert until(lambda: rig.local.on(VIDEO_FLAG))
        rig.local.publish(VIDEO_FLAG, FALSE, retain=True)
        assert until(lambda: rig.remote.on(VIDEO_FLAG))
        rig.remote.transport.close()  # it would publish its own retained messages again
        spare.kill()
        rig.local.publish("outgoing/capabilities", b"new", retain=True)
        spare.start()
        expected = {"outgoing/capabilities": b"new", VIDEO_FLAG: FALSE}
        assert until(lambda: rig.retained("remote") == expected, 10, step=0.3)

    def test_a_local_broker_that_forgot_everything_gets_its_flags_back(
        self, spare: Broker, brokers: tuple[Broker, Broker], rigs: Rigs
    ) -> None:
        rig = rigs(at(spare), at(brokers[1]))
        rig.start()
        rig.local.publish(VIDEO_FLAG, TRUE, retain=True)
        assert until(lambda: rig.remote.on(VIDEO_FLAG))
        rig.remote.publish(VIDEO_FLAG, FALSE, retain=True)
        assert until(lambda: rig.local.on(VIDEO_FLAG))
        rig.local.transport.close()
        spare.kill()
        rig.remote.publish(AUDIO_FLAG, TRUE, retain=True)
        spare.start()
        assert until(lambda: rig.retained("local") == {VIDEO_FLAG: FALSE, AUDIO_FLAG: TRUE}, 10, step=0.3)
        assert rig.retained("remote") == {VIDEO_FLAG: FALSE, AUDIO_FLAG: TRUE}


class TestDeadLinks:
    def test_an_uplink_that_goes_silent(self, brokers: tuple[Broker, Broker], rigs: Rigs, link: TcpProxy) -> None:
        """Messages that were sent before the loss was detected count as well."""
        rig = rigs(at(brokers[0]), at(brokers[1]), uplink=link.port)
        rig.remote.publish(VIDEO_FLAG, TRUE, retain=True)
        rig.start()
        assert until(lambda: rig.local.on(VIDEO_FLAG))
        rig.local.publish("outgoing/capabilities", b"old", retain=True)
        assert until(lambda: rig.remote.on("outgoing/capabilities"))
        link.blackhole()
        rig.local.publish(VIDEO_FLAG, FALSE, retain=True)
        rig.local.publish("outgoing/capabilities", b"new", retain=True)
        rig.local.publish("outgoing/somebody/happened", b"1")
        rig.local.publish("outgoing/touch-sensors", b"stream")
        rig.remote.publish(AUDIO_FLAG, TRUE, retain=True)
        rig.remote.publish(DRIVE, b"old")
        assert until(lambda: rig.bridge.remote.state is State.CONNECTING, 10)
        rig.local.publish("outgoing/somebody/happened", b"2")
        link.resume()
        assert until(lambda: rig.remote.payloads("outgoing/somebody/happened")[-1:] == [b"2"])
        assert until(lambda: rig.local.on(AUDIO_FLAG))
        Quiet(rig.local, rig.remote).wait(0.8)
        expected = {VIDEO_FLAG: FALSE, AUDIO_FLAG: TRUE}
        assert rig.retained("local") == {**expected, "outgoing/capabilities": b"new"}
        assert rig.retained("remote") == {**expected, "outgoing/capabilities": b"new"}
        assert rig.remote.payloads("outgoing/somebody/happened") == [b"1", b"2"]
        assert rig.local.payloads(VIDEO_FLAG) == [TRUE]
        assert not rig.local.on(DRIVE)
        assert not rig.remote.on("outgoing/touch-sensors")

    def test_a_frozen_remote_broker_does_not_delay_local_traffic(
        self, tmp_path: Path, spare: Broker, brokers: tuple[Broker, Broker], rigs: Rigs
    ) -> None:
        rig = rigs(at(brokers[0]), at(spare), **recorders(tmp_path))
        rig.start()
        other = rig.client("local")
        spare.freeze()
        for number in range(400):  # together fewer than the 1000 that mosquitto holds for a slow reader
            rig.local.publish("outgoing/status", b"%d " % number + bytes(2000), retain=True)
            rig.local.publish("outgoing/touch-sensors", b"%d" % number)
        assert until(lambda: len(other.on("outgoing/touch-sensors")) == 400, 10)
        rig.local.publish("incoming/flags/git-pull", b"true")
        assert until(lambda: (tmp_path / "ran").exists(), 5)
        assert until(lambda: rig.bridge.remote.state is State.CONNECTING, 10)
        spare.thaw()
        assert until(lambda: rig.retained("remote").get("outgoing/status", b"").startswith(b"399 "), 10, step=0.3)
