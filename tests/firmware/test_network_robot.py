"""What MiniLAMP and BenJr say and do, in virtual time."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest

from tests.firmware.drill import BASE, DRIVE, LIMIT_S, ONLINE, STALE_S, START_S, Drill

KINDS = ("minilamp", "benjr")
WEEK_S = 7 * 86_400.0  # more than half a period of the ticks
EPOCH_MS = 1_800_000_000_000  # of the virtual time server at virtual time 0
AHEAD = {"minilamp": (1.0, 1.0, 0.0), "benjr": (-0.5, -0.5)}


def online(kind: str, seed: int = 1, **weather: str) -> Drill:
    drill = Drill(kind, seed)
    for name, value in weather.items():
        setattr(drill.network.weather, name, value)
    while drill.robot.link.state != "online":
        drill.turn(0.01)
        assert drill.seconds < 30, drill.robot.link.reason
    drill.run(drill.seconds + 0.5)
    return drill


def said(drill: Drill, metric: str) -> list[Any]:
    return [json.loads(payload) for payload in drill.heard(f"{BASE}/outgoing/{metric}")]


@pytest.mark.parametrize("kind", KINDS)
def test_it_says_what_it_is_and_keeps_that_with_the_broker(kind: str) -> None:
    drill = online(kind)
    (message,) = [one.message for one in drill.broker.heard if one.message.topic == f"{BASE}/outgoing/capabilities"]
    assert message.retain
    envelope = json.loads(message.payload)
    assert envelope["schema"] == "pebble-capabilities/v1"
    value = envelope["value"]
    assert value["identity"] == {"system": "pebble", "type": "robots", "id": "rover"}
    assert value["transport"] == {"kind": "mqtt"}
    assert value["drive"] == {"available": True, "controls": True, "topic": DRIVE}
    assert value["telemetry"]["charging_level_topic"] == f"{BASE}/outgoing/charging-level"
    assert value["telemetry"]["charging_status"] is (kind == "benjr")
    absent = {"available": False, "controls": False}
    assert [value[part] for part in ("video", "audio", "soundboard", "autonomy")] == [absent] * 4
    assert value["system"] == {"reboot": absent, "service_restart": absent, "git_pull": absent}


@pytest.mark.parametrize("kind", KINDS)
def test_the_heart_beats_in_real_milliseconds(kind: str) -> None:
    drill = online(kind)
    start = drill.seconds
    drill.run(start + 10)
    beats = [
        (one.at, json.loads(one.message.payload)["t"]) for one in drill.broker.heard if one.message.topic == ONLINE
    ]
    beats = [(at, t) for at, t in beats if at > START_S + start]
    assert 38 <= len(beats) <= 42
    for at, t in beats:
        assert abs(EPOCH_MS + at * 1000 - t) < 150  # the way of the message and half of the time server's


def test_without_a_time_server_it_counts_from_its_start() -> None:
    drill = online("benjr", ntp="silent")
    assert all(beat["t"] < 60_000 for beat in said(drill, "online"))


def test_a_time_server_that_cannot_be_asked_disturbs_nothing() -> None:
    drill = Drill("benjr", 1)
    settings = {"robot": {"id": "rover"}, "wifi": {"ssid": "home"}, "mqtt": {"host": "10.0.0.2"}, "ntp": "no..name"}
    drill.robot = drill.board.load("benjr", settings)
    drill.run(10)
    assert drill.robot.link.state == "online"
    assert drill.robot.link.losses == 0


@pytest.mark.parametrize("kind", KINDS)
def test_the_battery_every_five_seconds_and_not_kept(kind: str) -> None:
    drill = Drill(kind, 1)
    drill.board.set_volts(drill.board.firmware.module(f"{kind}.pins").BATTERY, 0.8)
    drill.run(20)
    told = [one.message for one in drill.broker.heard if one.message.topic.endswith("charging-level")]
    assert 3 <= len(told) <= 4
    assert not any(message.retain for message in told)
    volts = json.loads(told[0].payload)
    assert volts["unit"] == "v"
    assert volts["value"] == pytest.approx({"minilamp": 1.6, "benjr": 3.6}[kind], abs=0.01)
    assert said(drill, "charging-status") == ([{"value": False}] * len(told) if kind == "benjr" else [])


@pytest.mark.parametrize("kind", KINDS)
def test_reports_get_through_however_long_the_names_are(kind: str) -> None:
    drill = Drill(kind, 1)
    identity = {"system": "s" * 64, "type": "t" * 64, "id": "\u540d" * 64}
    settings = {"robot": identity, "wifi": {"ssid": "home"}, "mqtt": {"host": "10.0.0.2"}, "ntp": ""}
    drill.robot = drill.board.load(kind, settings)
    drill.run(10)
    base = "/".join(identity.values())
    heard = [one.message.topic for one in drill.broker.heard]
    assert heard.count(f"{base}/outgoing/capabilities") == 1
    assert heard.count(f"{base}/outgoing/charging-level") >= 1
    assert heard.count(f"{base}/outgoing/charging-status") == heard.count(f"{base}/outgoing/charging-level") * (
        kind == "benjr"
    )


@pytest.mark.parametrize("loss", ["broker", "wifi"])
def test_it_comes_back_after_more_days_than_ticks_can_tell(loss: str) -> None:
    drill = online("benjr")
    drill.run(drill.seconds + 5)
    lose, restore = {
        "broker": (drill.broker.kill, drill.broker.start),
        "wifi": (drill.network.radio.lose, drill.network.radio.restore),
    }[loss]
    lose()
    while drill.seconds < WEEK_S:
        drill.turn(30.0)
    drill.network.weather.ntp = "silent"
    restore()
    drill.run(drill.seconds + 15)
    assert drill.robot.link.state == "online"
    assert abs(EPOCH_MS + drill.clock.now() * 1000 - said(drill, "online")[-1]["t"]) < 500


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


@pytest.mark.parametrize("kind", KINDS)
def test_of_a_burst_only_the_newest_acts(kind: str) -> None:
    drill = online(kind)
    moves = drill.seen.moves
    for z in (1.0, -1.0, 0.3, -0.3, 1.0):
        drill.command(0.0, z)
    drill.command(0.0, 0.5)
    drill.nonsense(b'{"z": NaN}')
    drill.run(drill.seconds + 0.3)
    assert drill.outputs() == AHEAD[kind]
    assert drill.seen.moves == moves + 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_command_right_behind_the_subscription_acts_at_once_or_never(kind: str) -> None:
    drill = online(kind)
    drill.drop_robot()
    while drill.robot.link.state != "connecting":
        drill.turn(0.01)
    start = drill.seconds
    while drill.robot.link.state != "online":
        drill.command(0.0, 0.5)
        drill.turn(0.005)
    drill.run(start + 5)  # the rule is checked at every turn
    assert not any(drill.outputs())


@pytest.mark.parametrize("kind", KINDS)
def test_who_loses_the_broker_stops_at_once(kind: str) -> None:
    drill = online(kind)
    drill.command(0.0, 0.5)
    drill.run(drill.seconds + 0.2)
    assert any(drill.outputs())
    drill.network.radio.lose()
    drill.turn(0.01)
    assert not any(drill.outputs())
    assert drill.robot.link.state == "offline"


def test_a_stop_is_said_until_the_shield_has_heard_it() -> None:
    drill = online("benjr")
    drill.command(0.0, 0.5)
    drill.run(drill.seconds + 0.2)
    drill.failing_i2c(2.0)
    drill.run(drill.seconds + 1.9)
    assert any(drill.outputs())  # it cannot have heard
    drill.board.bus.mend(0x30)
    drill.turn(0.01)
    assert not any(drill.outputs())
    assert drill.robot.trips == 1


@pytest.mark.parametrize("kind", KINDS)
def test_settings_that_are_missing_are_named_when_the_motors_are_off(kind: str) -> None:
    drill = online(kind)
    drill.command(0.0, 0.5)
    drill.run(drill.seconds + 0.2)
    assert any(drill.outputs())
    with pytest.raises(ValueError, match=r"robot\.id"):
        drill.board.load(kind, {})
    assert not any(drill.outputs())


def test_a_certificate_needs_the_date() -> None:
    drill = Drill("minilamp", 1)
    wrapper = drill.board.firmware.module("common.tls").Wrapper({"ca": "/ca.der"}, "broker")
    wrapper.tell(5_000)  # since boot
    assert drill.board.rtc[0] == 2000
    wrapper.tell(1_700_000_000_999)
    assert drill.board.rtc == (2023, 11, 14, 1, 22, 13, 20, 0)
    wrapper.tell(4_200_000_000_000)  # a time server's nonsense
    assert drill.board.rtc[0] == 2023


@pytest.mark.parametrize(
    ("asked", "answers", "heard"),
    [
        ("8.8.8.8", "8.8.8.8", b"answer"),
        ("8.8.8.8", "6.6.6.6", b""),
        ("85.1.2.3", "8.8.8.8", b""),
        ("224.0.0.251", "192.168.1.7", b"answer"),
    ],
)
def test_only_who_was_asked_may_answer(asked: str, answers: str, heard: bytes) -> None:
    from common.sockets import Question

    question = Question.__new__(Question)
    question._host, question._port, question._due, question.data = asked, 53, 0, b"question"
    question.socket = SimpleNamespace(sendto=lambda *_: None, recvfrom=lambda _: (b"answer", (answers, 53)))
    assert question.step(0) == heard


def test_the_end_of_a_connection_is_said_in_words() -> None:
    from common.sockets import Stream

    stream = Stream.__new__(Stream)
    stream.socket = SimpleNamespace(readinto=lambda _: 0)
    with pytest.raises(OSError, match="closed by the broker"):
        stream.read(memoryview(bytearray(1)))


def test_what_tls_could_not_send_comes_again_as_it_was() -> None:
    from common.sockets import Stream

    class Socket:
        def __init__(self) -> None:
            self.seen: list[bytes] = []

        def write(self, data: memoryview) -> int | None:
            self.seen.append(bytes(data))
            return None if len(self.seen) < 3 else len(data)

    stream = Stream.__new__(Stream)
    stream._tried, stream.socket = 0, Socket()
    data = memoryview(b"heartbeat and more")
    assert stream.write(data, 9) == 0
    assert stream.write(data, 18) == 0  # more waits by now
    assert stream.write(data, 18) == 9
    assert stream.write(data[9:], 9) == 9
    assert stream.socket.seen == [b"heartbeat"] * 3 + [b" and more"]
