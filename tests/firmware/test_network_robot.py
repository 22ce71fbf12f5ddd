"""MiniLAMP's and BenJr's messages and motions, in virtual time."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any
from unittest.mock import Mock

import pytest

from tests.ext.lab.simulation.virtual_broker import Session, VirtualBroker
from tests.firmware.drill import BASE, DRIVE, ESTOP, LIMIT_S, RESET, STALE_S, STATE, Drill
from wifi import sockets

KINDS = ("minilamp", "benjr")
WEEK_S = 7 * 86_400.0  # more than half a period of the ticks
EPOCH_MS = 1_800_000_000_000  # of the virtual time server at virtual time 0
AHEAD = {"minilamp": (1.0, 1.0, 0.0), "benjr": (-0.5, -0.5)}


def online(
    kind: str,
    seed: int = 1,
    *,
    refused: Iterable[str] = (),
    **settings: Any,
) -> Drill:
    """A robot that is connected; ``refused`` topics cannot be subscribed to, ``settings`` change those of its board."""
    drill = Drill(kind, seed)
    drill.broker.refused = set(refused)
    if settings:
        base = {"robot": {"id": "rover"}, "wifi": {"ssid": "home"}, "mqtt": {"host": "10.0.0.2"}}
        drill.robot = drill.board.load(kind, {**base, **settings})
    while drill.robot.session.connection.state != "online":
        drill.turn(0.01)
        assert drill.seconds < 30, drill.robot.session.connection.reason
    drill.wait(0.5)
    return drill


@pytest.mark.parametrize("kind", KINDS)
def test_a_group_moves_a_board_that_lists_it_as_its_drive_command_would(kind: str) -> None:
    drill = online(kind)
    (capabilities,) = published(drill, "capabilities")
    lists = capabilities["value"].get("groups") == ["drive-values"]
    assert lists is (kind == "minilamp"), "benjr has little room"
    (capabilities,) = published(online(kind, refused={f"{BASE}/incoming/group"}), "capabilities")
    assert "groups" not in capabilities["value"]
    drill.clock.watch = drill.check = lambda: None  # type: ignore[method-assign]
    group = b'{"drive-values":{"z":1.0,"valid_ms":400}}'
    for body, moves in ((group[:-1] + b',"estop":{}}', False), (group, lists), (group, False)):
        drill.broker.publish(f"{BASE}/incoming/group", body, qos=1)
        drill.wait(0.2)
        assert any(drill.outputs()) is moves
        drill.wait(0.4)
        assert not any(drill.outputs()), "for as long as it is valid"
        if moves is lists:
            drill.stop()  # so that the last one does not move it
            drill.wait(0.3)


def published(drill: Drill, metric: str) -> list[Any]:
    return [json.loads(payload) for payload in drill.received(f"{BASE}/outgoing/{metric}")]


def test_groups_whose_topic_is_refused_are_not_announced() -> None:
    (capabilities,) = published(online("minilamp", refused={f"{BASE}/incoming/group"}), "capabilities")
    assert "groups" not in capabilities["value"]


@pytest.mark.parametrize("kind", KINDS)
def test_its_capabilities_are_a_retained_message(kind: str) -> None:
    drill = online(kind)
    (message,) = [one.message for one in drill.broker.received if one.message.topic == f"{BASE}/outgoing/capabilities"]
    assert message.retain
    body = json.loads(message.payload)
    value, absent = body["value"], {"available": False, "controls": False}
    assert body["schema"] == "pebble-capabilities/v1"
    assert value["identity"] == {"system": "pebble", "type": "robots", "id": "rover"}
    assert value["telemetry"]["charging_level_topic"] == f"{BASE}/outgoing/charging-level"
    assert value["telemetry"]["charging_status"] is (kind == "benjr")
    drive = {"available": True, "controls": True, "arbitrates": True, "control": True, "topic": DRIVE}
    assert value["drive"] == drive | {"axes": ["x", "z", *(["y"] if kind == "minilamp" else [])]}
    topics = {"topic": ESTOP, "reset_topic": RESET, "owners": ["mcu"], "status_topics": [STATE]}
    assert value["estop"] == {"available": True, **topics}
    assert [value[name] for name in ("video", "audio", "soundboard", "autonomy")] == [absent] * 4
    assert value["system"] == dict.fromkeys(("reboot", "service_restart", "git_pull"), absent)


def test_its_client_id_is_its_own_and_as_long_as_any_broker_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that knows it can disconnect the robot. It lasts until the next boot, to end an old connection."""
    ids: list[str] = []
    accept = VirtualBroker.taken_over

    def taken_over(broker: VirtualBroker, by: Session) -> None:
        ids.append(by.client_id)
        accept(broker, by)

    monkeypatch.setattr(VirtualBroker, "taken_over", taken_over)
    drill = online("benjr")
    drill.drop_robot()
    drill.wait(10)
    online("benjr", seed=2)
    assert len(ids) == 3
    assert ids[0] == ids[1] != ids[2]
    assert all(re.fullmatch("pebble-[0-9a-f]{16}", one) for one in ids)


@pytest.mark.parametrize("kind", KINDS)
def test_the_battery_every_five_seconds_and_not_retained(kind: str) -> None:
    drill = Drill(kind, 1)
    drill.board.set_volts(drill.board.firmware.module(f"{kind}.pins").BATTERY, 0.8)
    drill.run(20)
    levels = [one.message for one in drill.broker.received if one.message.topic.endswith("charging-level")]
    assert 3 <= len(levels) <= 4
    assert not any(message.retain for message in levels)
    volts = json.loads(levels[0].payload)
    assert volts["unit"] == "v"
    assert volts["value"] == pytest.approx({"minilamp": 1.6, "benjr": 3.6}[kind], abs=0.01)
    assert published(drill, "charging-status") == ([{"value": False}] * len(levels) if kind == "benjr" else [])


def test_reports_get_through_however_long_the_names_are() -> None:
    identity = {"system": "s" * 64, "type": "t" * 64, "id": "\u540d" * 64}
    drill = online("benjr", robot=identity, ntp="")
    drill.run(10)
    base = "/".join(identity.values())
    received = [one.message.topic for one in drill.broker.received]
    assert received.count(f"{base}/outgoing/capabilities") == 1
    assert received.count(f"{base}/outgoing/charging-status") == received.count(f"{base}/outgoing/charging-level") >= 1


def test_it_reconnects_after_more_days_than_ticks_can_measure() -> None:
    drill = online("benjr")
    drill.wait(5)
    drill.broker.kill()
    while drill.seconds < WEEK_S:
        drill.turn(30.0)
    drill.network.conditions.ntp = "silent"
    drill.broker.start()
    drill.wait(15)
    assert drill.robot.session.connection.state == "online"
    assert abs(EPOCH_MS + drill.clock.now() * 1000 - published(drill, "online")[-1]["t"]) < 500


def test_a_backlog_does_not_drive_a_robot() -> None:
    """More commands than the board can read, for seconds: what it reads gets older and older."""
    drill = online("minilamp")
    drill.clock.watch = lambda: None
    end = drill.seconds + 6.0
    while drill.seconds < end + STALE_S + LIMIT_S:
        for _ in range(120 if drill.seconds < end else 0):
            drill.command(0.0, 1.0, qos=0)
        drill.clock.advance(0.04)
        drill.network.step()
        drill.robot.step()
    assert not any(drill.outputs())


def test_who_loses_the_broker_stops_at_once() -> None:
    drill = online("minilamp")
    drill.command(0.0, 0.5)
    drill.wait(0.2)
    assert any(drill.outputs())
    drill.network.radio.lose()
    drill.turn(0.01)
    assert not any(drill.outputs())
    assert drill.robot.session.connection.state == "offline"


def test_a_stop_is_repeated_until_the_shield_acknowledges_it() -> None:
    drill = online("benjr")
    drill.command(0.0, 0.5)
    drill.wait(0.2)
    drill.failing_i2c(2.0)
    drill.wait(1.9)
    assert any(drill.outputs())  # the shield did not receive it
    drill.board.bus.restore(0x30)
    drill.turn(0.01)
    assert not any(drill.outputs())
    assert drill.robot.deadman.trips == 1


@pytest.mark.parametrize("kind", KINDS)
def test_settings_that_are_missing_are_named_when_the_motors_are_off(kind: str) -> None:
    drill = online(kind)
    drill.command(0.0, 0.5)
    drill.wait(0.2)
    assert any(drill.outputs())
    with pytest.raises(ValueError, match=r"robot\.id"):
        drill.board.load(kind, {})
    assert not any(drill.outputs())


def test_a_certificate_needs_the_date() -> None:
    drill = Drill("minilamp", 1)
    wrapper = drill.board.firmware.module("wifi.tls").Wrapper({"ca": "/ca.der"})
    wrapper.set_time(5_000)  # since boot
    assert drill.board.rtc[0] == 2000
    wrapper.set_time(1_700_000_000_999)
    assert drill.board.rtc == (2023, 11, 14, 1, 22, 13, 20, 0)
    wrapper.set_time(4_200_000_000_000)  # a time server's nonsense
    assert drill.board.rtc[0] == 2023


def test_every_address_of_its_broker_has_a_turn_and_the_one_that_worked_comes_again() -> None:
    drill = Drill("minilamp", 1)
    order = ("10.0.0.9", "10.0.0.1", "10.0.0.2")  # the broker has the second one by number
    drill.network.hosts = {"fleet.test": order, "pool.ntp.org": "10.0.0.3"}
    settings = {"robot": {"id": "rover"}, "wifi": {"ssid": "home"}, "mqtt": {"host": "fleet.test"}}
    drill.robot = drill.board.load("minilamp", settings)
    drill.run(40)
    assert drill.robot.session.connection.state == "online"
    losses = drill.robot.session.connection.losses
    assert losses <= 3
    drill.drop_robot()
    drill.wait(5)
    assert (drill.robot.session.connection.state, drill.robot.session.connection.losses) == ("online", losses + 1)


@pytest.mark.parametrize(
    ("asked", "answers", "received"),
    [
        ("8.8.8.8", "8.8.8.8", b"answer"),
        ("85.1.2.3", "8.8.8.8", b""),
        ("224.0.0.251", "192.168.1.7", b"answer"),
    ],
)
def test_only_who_was_asked_may_answer(
    monkeypatch: pytest.MonkeyPatch, asked: str, answers: str, received: bytes
) -> None:
    module = Mock(**{"socket.return_value.recvfrom.return_value": (b"answer", (answers, 53))})
    monkeypatch.setattr(sockets, "socket", module)
    assert sockets.Query(asked, 53, b"question", 0).step(0) == received


def test_what_tls_could_not_send_comes_again_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    write = Mock(side_effect=(None, None, 9, 9))
    monkeypatch.setattr(sockets, "socket", Mock(**{"socket.return_value.write": write}))
    monkeypatch.setattr(sockets, "select", Mock())
    stream, data = sockets.Stream("10.0.0.2", 1883, None), memoryview(b"heartbeat and more")
    assert [stream.write(data, count) for count in (9, 18, 18)] == [0, 0, 9]  # more waits by now
    assert stream.write(data[9:], 9) == 9
    assert [bytes(call.args[0]) for call in write.call_args_list] == [b"heartbeat"] * 3 + [b" and more"]
