"""A bridge or a mirror between real brokers and hubs: what crosses, and what happens where brokers differ or go back.

The same rules hold in virtual time (tests/forwarding/test_services.py).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.forwarding.routing import Drop, Side
from pebble.forwarding.service import ForwardingService
from pebble.forwarding.side import Gate
from pebble.runtime.connections import local_transport
from pebble.services.mqtt_bridge.requests.media import Media
from pebble.transports import MqttSettings, State, Transport, ZenohSettings, create
from tests.forwarding.virtual import SERVICES
from tests.services.mqtt_bridge.bridge_rig import Client, Quiet, Running, make_config
from tests.support import AmqttBroker, Broker, cases, free_port, until
from tests.tcp_proxy import TcpProxy
from tests.transports.zenoh_net import HubProcess

LOCAL, REMOTE = Side.LOCAL, Side.REMOTE
STOP, DRIVE, STATUS = "incoming/estop", "incoming/drive-values", "outgoing/status"
VIDEO_FLAG, AUDIO_FLAG = "incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"
TRUE, FALSE, PRESS = b'{"value": true}', b'{"value": false}', b'{"stop": "00000000000000a1", "by": "test"}'
_numbers = count(1)


class MqttEnd:
    """A mosquitto, or another broker of a test's own, and a way to it for the service."""

    def __init__(self, folder: Path, protocol: str = "3.1.1", *, broker: Broker | AmqttBroker | None = None) -> None:
        self.broker = broker or Broker(folder)
        self.link = TcpProxy(self.broker.port)
        self.section: dict[str, Any] = {"host": "127.0.0.1", "port": self.link.port, "protocol": protocol}

    def transport(self, name: str) -> Transport:
        return create("mqtt", name, MqttSettings(**{**self.section, "port": self.broker.port, "as_published": True}))

    def close(self) -> None:
        self.link.stop()
        self.broker.stop()


class ZenohEnd:
    """A hub; ``uplink``: which operators reach over the network."""

    section: dict[str, Any]  # of a config

    def __init__(self, folder: Path, *, keeps: bool = False, uplink: bool = False) -> None:
        self._journal = folder / "journal" if keeps else None
        self._hub = HubProcess(folder / ("uplink" if uplink else "run"), self._journal)
        # a machine that stands still for the usual two seconds would make live messages late, and they would be dropped
        settings = replace(self._hub.settings, lease_ms=5000)
        if uplink:
            endpoint = f"tcp/127.0.0.1:{free_port()}"
            self._hub.settings = replace(settings, listen=(endpoint,))
            settings = ZenohSettings(run_dir=folder / "operators", connect=(endpoint,), client=True, lease_ms=5000)
            self.section = {"kind": "zenoh", "connect": [endpoint]}
        else:
            self.section = {"kind": "zenoh", "run_dir": str(settings.run_dir), "lease_ms": settings.lease_ms}
        self._settings = settings
        self._hub.start()

    def transport(self, name: str) -> Transport:
        return create("zenoh", name, self._settings)

    def save(self) -> None:
        assert self._journal is not None
        self._hub.wait_until_stored()
        self._saved = {file: file.read_bytes() for file in self._journal.parent.glob("journal*")}  # its log too

    def restore(self) -> None:
        """Kill it, and start it with what was there at the last :meth:`save`."""
        assert self._journal is not None
        self._hub.kill()
        for file in self._journal.parent.glob("journal*"):
            file.unlink()
        for file, data in self._saved.items():
            file.write_bytes(data)
        self._hub.start()

    def close(self) -> None:
        self._hub.end()


End = MqttEnd | ZenohEnd


class Rig:
    """Both ends, a client on each that is no client of the service, and the service in between."""

    def __init__(self, service: str, local: End, remote: End, *, robot: str = "", **section: Any) -> None:
        """``section``: further keys of services.mqtt_bridge."""
        self.name, self.robot = service, robot or f"r{next(_numbers)}"
        self.base = f"pebble/robots/{self.robot}"
        self.ends: dict[Side, End] = {LOCAL: local, REMOTE: remote}
        self.config = self._parse(local.section, remote.section, section)
        self._clients: list[Client] = []
        self._running: Running | None = None
        self.service: ForwardingService
        self.local, self.remote = self.client(LOCAL), self.client(REMOTE)

    @property
    def clients(self) -> dict[Side, Client]:
        return {LOCAL: self.local, REMOTE: self.remote}

    def client(self, side: Side) -> Client:
        """One more on that side; none receives its own messages."""
        transport = self.ends[side].transport(f"{self.robot}-{side.value}-{len(self._clients)}")
        self._clients.append(Client(transport, self.base))
        return self._clients[-1]

    def start(self, *, ready: bool = True) -> ForwardingService:
        made = SERVICES[self.name]
        self.service = made(self.config, local_transport(self.config, made.client_name, as_published=True))
        self._running = Running(self.service)
        if ready:
            self.wait_ready()
        return self.service

    def wait_ready(self) -> None:
        """Until the service forwards, or has found out that it must not."""
        forwarder = self.service.forwarder
        assert until(lambda: forwarder.gate is not Gate.WAITING), "it never made up its mind"
        assert until(lambda: forwarder.gate is Gate.SHUT or forwarder.retained.synchronized(*Side))

    def retained(self, side: Side) -> dict[str, bytes]:
        """What a late subscriber finds on that side, but what the bridge itself publishes there."""
        late = self.client(side)
        Quiet(late).wait(0.2)
        late.transport.close()
        retained = {m.topic.removeprefix(f"{self.base}/"): m.payload for m in late.seen if m.retain}
        return {suffix: payload for suffix, payload in retained.items() if suffix != "outgoing/online"}

    def after_all(self, speaker: Side) -> None:
        """Wait until earlier messages of the client on that side have passed, if they do."""
        listener = self.clients[speaker.other]
        mark = b'{"b": %d}' % len(listener.seen)
        self.clients[speaker].publish("incoming/lights-solid", mark)
        assert until(lambda: mark in listener.payloads("incoming/lights-solid"))

    def stop(self) -> None:
        if self._running is not None:
            self._running.stop()
            self._running = None

    def close(self) -> None:
        self.stop()
        for client in self._clients:
            client.transport.close()

    def _parse(self, local: dict[str, Any], remote: dict[str, Any], section: dict[str, Any]) -> Config:
        if self.name == "bridge":
            own = {"transport" if "kind" in local else "local_mqtt": local}
            other = {"remote" if "kind" in remote else "remote_mqtt": remote}
            return make_config(self.robot, **{**own, **other, **section})
        # beside a bridge, as on any robot: it looks first whether they share a broker
        bridge = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}, **section}
        raw = {"robot": {"id": self.robot}, "transport": {**local, "mqtt_mirror": remote}}
        return parse({**raw, "services": {"mqtt_bridge": bridge}}, folder=Path.cwd(), env={})


Make = Callable[..., Rig]
Arrived = tuple[str, bytes, int, bool]


@pytest.fixture
def make() -> Iterator[Make]:
    """Makes rigs that end with the test, before their ends do."""
    made: list[Rig] = []

    def make(service: str, local: End, remote: End, **section: Any) -> Rig:
        made.append(Rig(service, local, remote, **section))
        return made[-1]

    yield make
    for rig in made:
        rig.close()
    for end in {end for rig in made for end in rig.ends.values()}:
        end.close()


LINKS: dict[str, tuple[str, Callable[[Path], End], Callable[[Path], End]]] = {
    "bridge on 3.1.1": ("bridge", MqttEnd, MqttEnd),
    "mirror on 5": ("mirror", ZenohEnd, partial(MqttEnd, protocol="5")),
    "bridge on zenoh": ("bridge", ZenohEnd, partial(MqttEnd, protocol="5")),
    "bridge to zenoh": ("bridge", MqttEnd, partial(ZenohEnd, uplink=True)),
}
#: Who publishes a topic, how, and which service passes it on, retained or not.
MESSAGES: list[tuple[Side, str, int, bool, str, bool]] = [
    (LOCAL, STATUS, 1, True, "bridge mirror", True),
    (LOCAL, "outgoing/weather", 0, False, "bridge mirror", False),
    (LOCAL, "outgoing/sensors/imu-fast", 0, False, "mirror", False),
    (LOCAL, DRIVE, 1, False, "mirror", False),
    (LOCAL, VIDEO_FLAG, 1, False, "bridge mirror", True),
    (LOCAL, "incoming/flags/reboot", 1, True, "", False),
    (REMOTE, "outgoing/diagnostics", 1, True, "mirror", True),
    (REMOTE, "incoming/lights-solid", 1, False, "bridge mirror", False),
    (REMOTE, "incoming/dance", 1, True, "", False),
    (REMOTE, STOP, 1, True, "bridge mirror", False),
    (REMOTE, "incoming/flags/party", 1, True, "bridge mirror", True),
]


@pytest.mark.parametrize("link", LINKS)
def test_messages_cross_once_as_they_were_published(make: Make, tmp_path: Path, link: str) -> None:
    service, local, remote = LINKS[link]
    rig = make(service, local(tmp_path), remote(tmp_path))
    rig.remote.publish(STOP, b"old", retain=True)
    rig.local.publish("outgoing/capabilities", b"before", retain=True)
    rig.start()
    due: dict[Side, list[Arrived]] = {LOCAL: [], REMOTE: [("outgoing/capabilities", b"before", 1, True)]}
    for side, topic, qos, retain, services, retained in MESSAGES:
        rig.clients[side].publish(topic, PRESS, qos=qos, retain=retain)
        due[side.other] += [(topic, PRESS, qos, retained)] if service in services.split() else []

    def arrived(side: Side) -> list[Arrived]:
        return sorted(
            (one.topic.removeprefix(f"{rig.base}/"), one.payload, one.qos, one.retain or bool(one.retain_requested))
            for one in list(rig.clients[side].seen)
            if one.payload in (PRESS, b"before", b"old")
        )

    for side in Side:
        assert until(lambda side=side: arrived(side) == sorted(due[side])), arrived(side)  # type: ignore[misc]
    Quiet(*rig.clients.values()).wait(0.1)
    for side in Side:
        assert arrived(side) == sorted(due[side])
        newest = {topic: payload for topic, payload, _, retained in due[side] if retained}
        assert until(lambda side=side, newest=newest: newest.items() <= rig.retained(side).items())  # type: ignore[misc]
    assert rig.retained(LOCAL).get(STOP) is None


def test_a_retained_stop_passes_on_no_slow_link(make: Make, tmp_path: Path) -> None:
    """A broker sends few retained messages at a time: the last ones arrive many round trips after the first."""
    rig = make("bridge", MqttEnd(tmp_path), MqttEnd(tmp_path))
    others = 300
    for number in range(others):
        rig.remote.publish(f"incoming/flags/f{number}", TRUE, retain=True)
    rig.remote.publish(STOP, b"old", retain=True)
    slow = rig.ends[REMOTE]
    assert isinstance(slow, MqttEnd)
    slow.link.delay_s = 0.1
    rig.start(ready=False)

    def arrived() -> int:
        counts = rig.service.forwarder.counters.snapshot()
        return sum(number for name, number in counts.items() if name.startswith("remote: "))

    assert until(lambda: arrived() >= others)
    rig.wait_ready()
    rig.after_all(REMOTE)
    assert not rig.local.on(STOP)
    rig.remote.publish(STOP, PRESS)
    assert until(lambda: rig.local.payloads(STOP) == [PRESS])


def test_a_frozen_remote_broker_does_not_delay_local_traffic(make: Make, tmp_path: Path) -> None:
    code = f"open({str(tmp_path / 'ran')!r}, 'w')"
    run = {"command": [sys.executable, "-c", code]}
    rig = make("bridge", MqttEnd(tmp_path), MqttEnd(tmp_path), git_pull_control=run)
    rig.start()
    other, broker = rig.client(LOCAL), rig.ends[REMOTE].broker
    assert isinstance(broker, Broker)
    broker.freeze()
    for number in range(400):  # together fewer than the 1000 that mosquitto holds for a slow reader
        rig.local.publish("outgoing/status", b"%d " % number + bytes(2000), retain=True)
        rig.local.publish("outgoing/touch-sensors", b"%d" % number)
    assert until(lambda: len(other.on("outgoing/touch-sensors")) == 400)
    rig.local.publish("incoming/flags/git-pull", b"true")
    assert until(lambda: (tmp_path / "ran").exists())
    assert until(lambda: rig.service.remote.state is State.CONNECTING)
    broker.thaw()
    assert until(lambda: rig.retained(REMOTE).get("outgoing/status", b"").startswith(b"399 "), step=0.3)


def test_stops_flags_and_commands_arrive_and_come_to_rest_without_bridge_mode(make: Make, tmp_path: Path) -> None:
    """amqtt sends our own messages back and hides the retain flag of live ones."""
    rig = make("bridge", *(MqttEnd(tmp_path, broker=AmqttBroker()) for _ in range(2)))
    rig.remote.publish(STOP, b"old", retain=True)
    rig.start()
    assert not rig.service.remote.as_published
    assert not rig.service.transport.exact_echo
    rig.remote.publish(STOP, PRESS, retain=True)
    for number in range(1, 51):  # one by one: this broker loses some of a burst now and then
        rig.remote.publish(DRIVE, b'{"x": 0, "z": 0}')
        assert until(lambda number=number: len(rig.local.on(DRIVE)) >= number)  # type: ignore[misc]
    flags = [TRUE, FALSE] * cases(60, 250)
    for flag, other in zip(flags, flags[::-1], strict=True):
        rig.local.publish(VIDEO_FLAG, flag, retain=True)
        rig.remote.publish(AUDIO_FLAG, other, retain=True)
        time.sleep(1 / len(flags))
    rig.remote.publish("incoming/flags/git-pull", b"true")
    Quiet(rig.local, rig.remote).wait(1.0)
    assert rig.local.payloads(STOP) == [PRESS]
    assert STOP not in rig.retained(LOCAL)
    assert len(rig.local.on(DRIVE)) == 50
    assert 1 <= len(rig.remote.on(VIDEO_FLAG)) <= len(flags)
    assert 1 <= len(rig.local.on(AUDIO_FLAG)) <= len(flags)
    assert (rig.remote.payloads(VIDEO_FLAG)[-1], rig.local.payloads(AUDIO_FLAG)[-1]) == (FALSE, TRUE)
    too_late = rig.service.forwarder.counters[f"remote: {Drop.LATE.value}"]  # on a busy machine, behind the flags
    assert len(rig.local.on("incoming/flags/git-pull")) + too_late == 1


def test_a_microphone_that_was_switched_off_stays_off_when_a_side_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Make
) -> None:
    """A program that lives no more switched it on, an operator off after the save, and then the robot was off."""
    allowed = list[bool]()
    monkeypatch.setattr(Media, "allow", lambda _media, _flag, on: allowed.append(on))
    end = ZenohEnd(tmp_path, keeps=True)
    rig = make("bridge", end, MqttEnd(tmp_path))
    rig.start()

    def set_microphone(setter: Client, value: bytes, *others: Client) -> None:
        setter.publish(AUDIO_FLAG, value, retain=True, remember=False)
        assert until(lambda: all(client.payloads(AUDIO_FLAG)[-1:] == [value] for client in others))
        assert until(lambda: rig.service.forwarder.retained.value(f"{rig.base}/{AUDIO_FLAG}") == value)

    set_microphone(rig.client(LOCAL), TRUE, rig.local, rig.remote)
    end.save()
    set_microphone(rig.remote, FALSE, rig.local)
    assert until(lambda: allowed[-1:] == [False])
    rig.close()
    allowed.clear()
    end.restore()
    assert until(lambda: rig.retained(LOCAL).get(AUDIO_FLAG) == TRUE), "it has not gone back"
    rig.start()
    assert until(lambda: {rig.retained(side).get(AUDIO_FLAG) for side in Side} == {FALSE})
    assert True not in allowed
