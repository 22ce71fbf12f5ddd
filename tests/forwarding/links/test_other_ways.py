"""Both sides that are one broker, brokers that send our own messages back, and other ways between the brokers."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.forwarding.routing import Drop
from tests.forwarding.links.rig import LOCAL, REMOTE, End, MqttEnd, Rig, ZenohEnd
from tests.services.mqtt_bridge.bridge_rig import Client, Quiet
from tests.support import AmqttBroker, cases, until

STOP, DRIVE, STATUS = "incoming/estop", "incoming/drive-values", "outgoing/status"
VIDEO_FLAG, AUDIO_FLAG = "incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"
TRUE, FALSE, PRESS = b'{"value": true}', b'{"value": false}', b'{"stop": "00000000000000a1", "by": "test"}'
Make = Callable[..., Rig]


@pytest.fixture
def make() -> Iterator[Make]:
    """Makes rigs that end with the test, before their ends do."""
    made: list[Rig] = []

    def make(service: str, local: End, remote: End, **options: Any) -> Rig:
        made.append(Rig(service, local, remote, **options))
        return made[-1]

    yield make
    for rig in made:
        rig.close()
    for end in {end for rig in made for end in rig.ends.values()}:
        end.close()


@pytest.fixture(scope="module")
def amqtt() -> Iterator[AmqttBroker]:
    broker = AmqttBroker()
    yield broker
    broker.stop()


def storm(*voices: tuple[Client, str, list[bytes]], seconds: float, retain: bool = False) -> None:
    """Every client publishes all of it, evenly spread and in turns."""
    began = time.monotonic()
    rounds = list(zip(*(payloads for _, _, payloads in voices), strict=True))
    for number, payloads in enumerate(rounds, 1):
        for (client, suffix, _), payload in zip(voices, payloads, strict=True):
            client.publish(suffix, payload, retain=retain and "/flags/" in suffix)
        time.sleep(max(0.0, began + number * seconds / len(rounds) - time.monotonic()))


class TestWithoutBridgeMode:
    """amqtt sends our own messages back and hides the retain flag of live ones."""

    @pytest.fixture
    def rig(self, make: Make, amqtt: AmqttBroker, tmp_path: Path) -> Rig:
        return make("bridge", MqttEnd(tmp_path, broker=AmqttBroker()), Shared(tmp_path, broker=amqtt))

    def test_stops_flags_and_commands_arrive_and_come_to_rest(self, rig: Rig) -> None:
        rig.remote.publish(STOP, b"old", retain=True)
        rig.start()
        assert not rig.service.remote.as_published
        assert not rig.service.transport.exact_echo
        rig.remote.publish(STOP, PRESS, retain=True)
        for number in range(1, 51):  # one by one: this broker loses some of a burst now and then
            rig.remote.publish(DRIVE, b'{"x": 0, "z": 0}')
            assert until(lambda number=number: len(rig.local.on(DRIVE)) >= number)  # type: ignore[misc]
        flags = [TRUE, FALSE] * cases(60, 250)
        storm((rig.local, VIDEO_FLAG, flags), (rig.remote, AUDIO_FLAG, flags[::-1]), seconds=1.0, retain=True)
        rig.remote.publish("incoming/flags/git-pull", b"true")
        Quiet(rig.local, rig.remote).wait(1.0, 20)
        assert rig.local.payloads(STOP) == [PRESS]
        assert STOP not in rig.retained(LOCAL)
        assert len(rig.local.on(DRIVE)) == 50
        assert 1 <= len(rig.remote.on(VIDEO_FLAG)) <= len(flags)
        assert 1 <= len(rig.local.on(AUDIO_FLAG)) <= len(flags)
        assert (rig.remote.payloads(VIDEO_FLAG)[-1], rig.local.payloads(AUDIO_FLAG)[-1]) == (FALSE, TRUE)
        too_late = rig.service.forwarder.counters[f"remote: {Drop.LATE.value}"]  # on a busy machine, behind the flags
        assert len(rig.local.on("incoming/flags/git-pull")) + too_late == 1


class Shared(MqttEnd):
    """An end whose broker others go on using."""

    def close(self) -> None:
        self.link.stop()


def test_mosquittos_own_clients_use_a_mirror(make: Make, tmp_path: Path) -> None:
    rig = make("mirror", ZenohEnd(tmp_path), MqttEnd(tmp_path))
    rig.start()
    rig.local.publish(STATUS, b'{"kept": 1}', retain=True)
    assert until(lambda: rig.remote.on(STATUS))
    sub, pub = shutil.which("mosquitto_sub"), shutil.which("mosquitto_pub")
    assert sub, "mosquitto-clients is not installed: `make test` installs it"
    assert pub
    where = ["-h", "127.0.0.1", "-p", str(rig.ends[REMOTE].section["port"])]
    listen = [sub, *where, "-t", f"{rig.base}/outgoing/#", "-F", "%r %t %p", "-C", "1", "-W", "10"]
    earlier = subprocess.run(listen, capture_output=True, text=True, timeout=20, check=True).stdout.strip()
    assert earlier == f'1 {rig.base}/{STATUS} {{"kept": 1}}'
    subprocess.run([pub, *where, "-t", f"{rig.base}/{DRIVE}", "-m", '{"x": 0, "z": 1}', "-q", "1"], check=True)
    assert until(lambda: rig.local.payloads(DRIVE) == [b'{"x": 0, "z": 1}'])
