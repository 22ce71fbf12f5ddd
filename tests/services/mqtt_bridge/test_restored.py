"""A side that has gone back to an older save, or still has what the robot took back while no bridge ran."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.forwarding import side as side_module
from pebble.services.mqtt_bridge.media import Media
from pebble.transports import State
from tests.services.mqtt_bridge.bridge_rig import MqttRig, Quiet
from tests.services.mqtt_bridge.restoring import FALSE, HISTORIES, TRUE, OwnBroker, OwnHub, play
from tests.sparing_broker import SparingBroker
from tests.support import Broker, some, until
from tests.tcp_proxy import TcpProxy

AUDIO_FLAG = "incoming/flags/mqtt-audio"
STATUS = "outgoing/autonomy-status"


@pytest.fixture
def brokers(tmp_path: Path) -> Iterator[tuple[Broker, Broker]]:
    """The robot's broker, and the operators', which saves."""
    local, remote = Broker(tmp_path), Broker(tmp_path, persistence=True)
    yield local, remote
    local.stop()
    remote.kill()


@pytest.fixture
def way(brokers: tuple[Broker, Broker]) -> Iterator[TcpProxy]:
    """The bridge's way to the operators' broker."""
    with TcpProxy(brokers[1].port) as way:
        yield way


@pytest.fixture
def rig(brokers: tuple[Broker, Broker], way: TcpProxy) -> Iterator[MqttRig]:
    local, remote = ({"host": "127.0.0.1", "port": broker.port} for broker in brokers)
    rig = MqttRig(local, remote, uplink=way.port)
    rig.start()
    yield rig
    rig.close()


def set_flag(rig: MqttRig, value: bytes, *, here: bool = True) -> None:
    """By an operator, who is not asked to repeat it; ``here``: it arrives at the robot now."""
    before = len(rig.local.on(AUDIO_FLAG))
    rig.remote.publish(AUDIO_FLAG, value, retain=True, remember=False)
    assert not here or until(lambda: rig.local.payloads(AUDIO_FLAG)[before:] == [value])


def set_status(rig: MqttRig, value: bytes) -> None:
    rig.local.publish(STATUS, value, retain=True)
    assert until(lambda: rig.remote.payloads(STATUS)[-1:] == [value])


def connections(rig: MqttRig) -> int:
    return rig.bridge.remote.counters["connected"]


def test_a_broker_that_was_restored_from_an_older_save_gets_the_newest_values(
    rig: MqttRig, brokers: tuple[Broker, Broker]
) -> None:
    set_status(rig, b"old")
    set_flag(rig, FALSE)
    brokers[1].save()
    older = {file: file.read_bytes() for file in brokers[1].store.iterdir()}
    set_status(rig, b"new")
    set_flag(rig, TRUE)
    before = connections(rig)
    brokers[1].kill()
    for file, saved in older.items():
        file.write_bytes(saved)
    brokers[1].start()
    assert until(lambda: connections(rig) > before and rig.bridge.remote.state is State.CONNECTED)
    assert until(lambda: rig.retained("remote") == {STATUS: b"new", AUDIO_FLAG: TRUE}, 5)
    Quiet(rig.local, rig.remote).wait(0.7)
    assert rig.retained("local")[AUDIO_FLAG] == TRUE
    assert rig.local.payloads(AUDIO_FLAG) == [FALSE, TRUE]


@pytest.mark.parametrize("longer", [False, True], ids=["brief", "longer"])
@pytest.mark.parametrize("history", some(HISTORIES, 4))
@pytest.mark.parametrize("own", [OwnBroker, OwnHub])
def test_a_microphone_that_was_switched_off_stays_off_when_the_robots_own_side_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: type[OwnBroker | OwnHub], history: str, longer: bool
) -> None:
    """``longer``: it was away for longer than an outage in which an operator could choose an earlier value again."""
    monkeypatch.setattr(side_module, "RESTORED_S", 0.0 if longer else 30.0)
    allowed: list[bool] = []
    monkeypatch.setattr(Media, "allow", lambda _media, _flag, on: allowed.append(on))
    side, remote = own(tmp_path), Broker(tmp_path)
    rig = MqttRig(side.address, {"host": "127.0.0.1", "port": remote.port})
    try:
        bridge = rig.start()
        once = rig.client("local")

        def set_microphone(who: str, value: bytes) -> None:
            setter = {"operator": rig.remote, "program": rig.local, "once": once}[who]
            setter.publish(AUDIO_FLAG, value, retain=True, remember=setter is rig.local)
            assert until(lambda: bridge.forwarder.retained.value(f"{rig.base}/{AUDIO_FLAG}") == value)
            assert until(lambda: {rig.retained(name).get(AUDIO_FLAG) for name in ("local", "remote")} == {value})

        play(history, set_microphone, side.save)
        assert until(lambda: allowed[-1:] == [False])
        allowed.clear()
        before = bridge.transport.counters["connected"]
        side.stop()
        assert until(lambda: bridge.transport.state is not State.CONNECTED)
        side.restore()
        assert until(lambda: bridge.transport.counters["connected"] > before)
        Quiet(rig.remote, rig.local).wait(1.0)
        assert until(lambda: rig.retained("local").get(AUDIO_FLAG) == FALSE), rig.retained("local")
        assert rig.retained("remote")[AUDIO_FLAG] == FALSE
        assert True not in allowed
    finally:
        rig.close()
        side.stop()
        remote.stop()


@pytest.mark.parametrize("history", some(HISTORIES, 4))
@pytest.mark.parametrize("own", [OwnBroker, OwnHub])
def test_it_stays_off_when_the_robots_own_side_is_restored_while_the_robot_is_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: type[OwnBroker | OwnHub], history: str
) -> None:
    allowed: list[bool] = []
    monkeypatch.setattr(Media, "allow", lambda _media, _flag, on: allowed.append(on))
    side, remote = own(tmp_path), Broker(tmp_path)
    rig = MqttRig(side.address, {"host": "127.0.0.1", "port": remote.port})
    try:
        rig.start()

        def set_microphone(who: str, value: bytes) -> None:
            setter = rig.remote if who == "operator" else rig.local
            setter.publish(AUDIO_FLAG, value, retain=True)
            assert until(lambda: {rig.retained(name).get(AUDIO_FLAG) for name in ("local", "remote")} == {value})

        play(history, set_microphone, side.save)
        rig.close()
        side.stop()
        allowed.clear()
        side.restore()
        rig.start()
        assert until(lambda: rig.retained("local").get(AUDIO_FLAG) == FALSE)
        assert (rig.retained("remote")[AUDIO_FLAG], True in allowed) == (FALSE, False)
    finally:
        rig.close()
        side.stop()
        remote.stop()


def test_a_value_that_an_operator_chose_again_during_an_outage_is_no_older_one(rig: MqttRig, way: TcpProxy) -> None:
    set_status(rig, b"status")
    set_flag(rig, FALSE)
    set_flag(rig, TRUE)
    before = connections(rig)
    way.cut()
    assert until(lambda: rig.bridge.remote.state is not State.CONNECTED)
    set_flag(rig, FALSE, here=False)
    way.mend()
    assert until(lambda: connections(rig) > before)
    assert until(lambda: rig.local.payloads(AUDIO_FLAG) == [FALSE, TRUE, FALSE])


@pytest.mark.parametrize(("late_s", "by_name"), [(0.0, False), (0.0, True), (0.7, False), (1.5, False), (1.5, True)])
def test_an_operators_flag_counts_however_late_the_broker_sends_it(
    brokers: tuple[Broker, Broker], late_s: float, by_name: bool
) -> None:
    """Silence does not mean that the broker has no value."""
    local, remote = ({"host": "127.0.0.1", "port": broker.port} for broker in brokers)
    front = SparingBroker(brokers[1].port, late_s=late_s, by_name=by_name)
    rig = MqttRig(local, remote, uplink=front.port)
    try:
        rig.local.publish(AUDIO_FLAG, TRUE, retain=True)
        rig.remote.publish(AUDIO_FLAG, FALSE, retain=True)
        for client in (rig.local, rig.remote):
            client.transport.close()
        rig.start()
        Quiet(rig.client("local")).wait(2.0)
        assert {side: rig.retained(side).get(AUDIO_FLAG) for side in ("local", "remote")} == dict.fromkeys(
            ("local", "remote"), FALSE
        )
    finally:
        rig.close()
        front.close()
