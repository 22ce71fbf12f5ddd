"""A bridge or a mirror between real brokers and hubs: what crosses, and what happens where brokers differ or go back.

The same rules hold in virtual time (tests/forwarding/test_services.py).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pebble.forwarding import side as side_module
from pebble.forwarding.routing import Drop
from pebble.services.mqtt_bridge.requests.media import Media
from pebble.transports import State
from tests.forwarding.links.rig import LOCAL, REMOTE, End, MqttEnd, Rig, Side, ZenohEnd
from tests.services.mqtt_bridge.bridge_rig import Quiet
from tests.support import AmqttBroker, Broker, cases, until

STOP, DRIVE, STATUS = "incoming/estop", "incoming/drive-values", "outgoing/status"
VIDEO_FLAG, AUDIO_FLAG = "incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"
TRUE, FALSE, PRESS = b'{"value": true}', b'{"value": false}', b'{"stop": "00000000000000a1", "by": "test"}'
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
        return sum(number for name, number in rig.service.status.counts.items() if name.startswith("remote: "))

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


#: The service, both ends, and which of them is restored: the one whose programs set the microphone, too.
RESTORED_LINKS: dict[str, tuple[str, Callable[[Path], End], Callable[[Path], End], Side]] = {
    "bridge, the robot's broker": ("bridge", partial(MqttEnd, keeps=True), MqttEnd, LOCAL),
    "bridge, the robot's hub": ("bridge", partial(ZenohEnd, keeps=True), MqttEnd, LOCAL),
    "mirror, its broker": ("mirror", ZenohEnd, partial(MqttEnd, keeps=True), REMOTE),
}
#: The link, how long its side is away, and who sets the microphone, in order: an operator, a program on the robot that
#: lives on, and one that is not asked to repeat what it set. ``longer``: than an outage in which an operator could
#: choose an earlier value again. In the end the microphone is switched off, after the save.
RESTORED = [
    ("bridge, the robot's broker", "longer", "save operator:on once:off"),
    ("bridge, the robot's hub", "while the robot is off", "once:on save operator:off"),
    ("mirror, its broker", "longer", "program:on save program:off"),
    ("bridge, the robot's broker", "briefly", "operator:on save operator:off"),
]


@pytest.mark.parametrize(("link", "when", "history"), RESTORED)
def test_a_microphone_that_was_switched_off_stays_off_when_a_side_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Make, link: str, when: str, history: str
) -> None:
    monkeypatch.setattr(side_module, "RESTORED_S", 0.0 if when == "longer" else 30.0)
    off, allowed = when == "while the robot is off", list[bool]()
    monkeypatch.setattr(Media, "allow", lambda _media, _flag, on: allowed.append(on))
    service, local, remote, restored = RESTORED_LINKS[link]
    rig = make(service, local(tmp_path), remote(tmp_path))
    rig.start()
    operator, end = rig.clients[restored.other], rig.ends[restored]
    setters = {"operator": operator, "program": rig.clients[restored], "once": rig.client(restored)}

    def set_microphone(who: str, value: bytes) -> None:
        others = [client for name, client in setters.items() if name != who]
        setters[who].publish(AUDIO_FLAG, value, retain=True, remember=who == "program")
        assert until(lambda: all(client.payloads(AUDIO_FLAG)[-1:] == [value] for client in others))
        assert until(lambda: rig.service.forwarder.retained.value(f"{rig.base}/{AUDIO_FLAG}") == value)

    for word in history.split():
        who, _, value = word.partition(":")
        set_microphone(who, TRUE if value == "on" else FALSE) if value else end.save()
    assert service == "mirror" or until(lambda: allowed[-1:] == [False])
    before, seen = rig.connections(restored), len(operator.on(AUDIO_FLAG))
    if off:
        rig.close()
    allowed.clear()
    end.stop()
    assert off or until(lambda: not rig.connections(restored))
    end.restore()
    if off:
        rig.start()
    else:
        assert until(lambda: rig.connections(restored) > before and rig.synchronized)
    assert until(lambda: {rig.retained(side).get(AUDIO_FLAG) for side in Side} == {FALSE})
    assert (True in allowed, TRUE in operator.payloads(AUDIO_FLAG)[seen:]) == (False, False)
