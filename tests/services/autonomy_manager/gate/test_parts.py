"""The gate's pure parts: signatures, pace, answers between two packets, and which topics drive."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.config import parse
from pebble.errors import PayloadError
from pebble.services.autonomy_manager.gate.activity import Activity
from pebble.services.autonomy_manager.gate.answers import AnswerMerger
from pebble.services.autonomy_manager.gate.client_filter import DriveCommand
from pebble.services.autonomy_manager.gate.drive_outlet import DriveOutlet, sign
from pebble.services.autonomy_manager.gate.pacer import PERIOD_S, Pacer
from pebble.services.autonomy_manager.gate.packets import PacketError
from pebble.services.autonomy_manager.gate.topics import TopicRules
from pebble.transports.counters import Counters
from tests.services.autonomy_manager.gate.mqtt_bytes import BASE, CONNACK, DRIVE, puback, publish

SIGNATURE = {"source": "autonomy", "run": 7}


@pytest.mark.parametrize(
    ("seen", "waits_for"),
    [
        ([], "its own start: it has not connected to the broker"),
        (["client"], "something: it has neither published nor subscribed"),
        (["client", "message"], ""),
        (["client", "subscribed"], "the messages that it subscribed to"),
        (["client", "subscribed", "message"], "the messages that it subscribed to"),
    ],
    ids=["starts", "connected", "acts once a minute", "listens", "listened"],
)
def test_a_silent_script_is_known_to_wait_after_10_s(seen: list[str], waits_for: str) -> None:
    now = [100.0]
    activity = Activity(lambda: now[0])
    for one in seen:
        (activity.message if one == "message" else lambda: activity.client(subscribed="subscribed" in seen))()
    assert (activity.silent, activity.waits_for) == (False, "")
    now[0] += 10.1
    assert (activity.silent, activity.waits_for) == (True, waits_for)
    activity.message()
    assert (activity.silent, activity.waits_for) == (False, ""), "messages in whichever direction"


@pytest.mark.parametrize(
    ("sent", "signed", "moves"),
    [
        ({"x": 0.1, "z": 0.5}, {"x": 0.1, "z": 0.5, **SIGNATURE}, True),
        ({"x": "abc", "z": " .5 "}, {"x": "abc", "z": " .5 ", **SIGNATURE}, True),
        ({"value": {"z": 0.5}, "t": 1}, {"value": {"z": 0.5, **SIGNATURE}, "t": 1}, True),
        ({"x": "0", "z": 0}, {"x": "0", "z": 0, **SIGNATURE}, False),
        ({}, SIGNATURE, False),
        ({"value": 1, "z": 1}, {"value": 1, "z": 1, **SIGNATURE}, True),
        ({"z": 1, "source": "person", "run": 99}, {"z": 1, **SIGNATURE}, True),
        ({"z": 0, "valid_ms": "odd"}, {"z": 0, "valid_ms": "odd", **SIGNATURE}, False),
    ],
)
def test_the_signature_is_in_the_object_that_holds_the_axes(sent: Any, signed: Any, moves: bool) -> None:
    result = sign(b"\xef\xbb\xbf" + json.dumps(sent).encode() + b"\r\n\0", 7)
    assert json.loads(result.payload) == signed
    assert result.moves is moves


@pytest.mark.parametrize(
    "payload", [b"", b"[]", b"1", b'{"z":NaN}', b'{"z":"nan"}', b'{"z":1e999}', b'{"z":1,"valid_ms":0}', b"\xff"]
)
def test_what_no_motor_owner_would_obey_is_refused(payload: bytes) -> None:
    with pytest.raises(PayloadError):
        sign(payload, 7)


_json = st.recursive(
    st.none() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.dictionaries(st.sampled_from(["x", "z", "value", "run"]), inner) | st.lists(inner, max_size=3),
)


@given(st.binary(max_size=60) | _json.map(lambda value: json.dumps(value).encode()))
def test_what_passes_is_always_signed(payload: bytes) -> None:
    try:
        signed = json.loads(sign(payload, 7).payload)
    except PayloadError:
        return
    inner = signed["value"] if isinstance(signed.get("value"), dict) else signed
    assert (inner["source"], inner["run"]) == ("autonomy", 7)


_commands = st.lists(st.tuples(st.floats(0, 0.03), st.sampled_from([True, True, True, False])), min_size=1, max_size=60)


@given(_commands)
def test_at_most_50_a_second_and_no_stop_is_dropped_delayed_or_overtaken(commands: list[tuple[float, bool]]) -> None:
    pacer, now = Pacer(), 0.0
    published: list[tuple[float, int]] = []
    for number, (wait, moves) in enumerate(commands):
        now += wait
        while pacer.due is not None and pacer.due <= now:
            due = pacer.due
            published += [(due, int(taken.payload)) for taken in filter(None, [pacer.take(due)])]
        repeated = bool(published) and not commands[published[-1][1]][1]
        if pacer.offer("t", b"%d" % number, moves, now):
            published.append((now, number))
        assert moves or repeated or published[-1] == (now, number), "a zero goes at once, unless it is the last one"
    published += [(math.inf, int(taken.payload)) for taken in filter(None, [pacer.take(math.inf)])]
    numbers = [number for _, number in published]
    assert numbers == sorted(numbers), "nothing is overtaken"
    assert numbers[-1] == len(commands) - 1, "the newest one wins"
    stops = [one for before, one in pairwise(numbers) if commands[before][1] and not commands[one][1]]
    paced = [at for at, number in published if number not in stops]
    assert all(later - earlier > PERIOD_S - 1e-9 for earlier, later in pairwise(paced)), "only a stop goes early"


def test_topics_wait_separately_and_share_the_limit() -> None:
    pacer = Pacer()
    assert pacer.offer("a", b"1", True, 0.0)
    assert [pacer.offer("a", b"2", True, 0.001), pacer.offer("b", b"3", True, 0.002)] == [False, False]
    assert pacer.take(PERIOD_S) == ("a", b"2", True)
    assert pacer.take(PERIOD_S) is None
    assert pacer.take(2 * PERIOD_S) == ("b", b"3", True)


def test_a_flood_of_zeros_waits_behind_the_first_one() -> None:
    sent = Sent()
    sent.drive('{"z":1}', now=0.0)
    for number in range(1000):
        sent.drive(json.dumps({"z": 0, "t": number}), now=0.001)
    assert [payload.get("t") for _, payload in sent] == [None, 0]
    sent.outlet.halt()
    sent.drive("{}", now=1.0)
    assert len(sent) == 3, "also while the run is being ended"
    sent.drive("{}", now=1.001)
    sent.outlet.publish_due(2.0)
    assert len(sent) == 4


class Sent(list[tuple[str, Any]]):
    """What an outlet published, parsed."""

    def __init__(self) -> None:
        super().__init__()
        self.counters = Counters()
        self.outlet = DriveOutlet(
            7, lambda topic, payload, _moves: self.append((topic, json.loads(payload))), self.counters
        )

    def drive(self, payload: str, connection: str = "a", now: float = 0.0, repeated: bool = False) -> None:
        self.outlet.receive(DriveCommand(DRIVE, payload.encode(), repeated), connection, now)


def test_the_end_of_the_connection_that_moves_the_robot_stops_it() -> None:
    sent = Sent()
    sent.drive('{"z":1}', "a", 0.0)
    sent.drive('{"z":0.5}', "a", 0.001)
    sent.outlet.ended("b", 0.002)
    assert len(sent) == 1, "another connection's end stops nothing"
    sent.outlet.ended("a", 0.003)
    sent.outlet.publish_due(1.0)
    assert sent[1:] == [(DRIVE, {"x": 0.0, "z": 0.0, **SIGNATURE})], "what waited is void"
    sent.outlet.ended("a", 2.0)
    assert len(sent) == 2, "one that has stopped needs no stop"


def test_many_connections_after_each_other_flood_no_motor_owner() -> None:
    sent = Sent()
    for number in range(1000):
        sent.drive('{"z":1}', f"connection {number}", 0.001)
        sent.outlet.ended(f"connection {number}", 0.001)
    assert [payload["z"] for _, payload in sent] == [1, 0]
    sent.outlet.publish_due(1.0)
    assert [payload["z"] for _, payload in sent] == [1, 0, 0]


def test_after_halt_only_zeros_pass() -> None:
    sent = Sent()
    sent.drive('{"z":1}', now=0.0)
    sent.drive('{"z":1}', now=0.001)
    sent.outlet.halt()
    sent.drive('{"z":1}', now=1.0)
    sent.outlet.publish_due(2.0)
    sent.drive("{}", now=3.0)
    assert [payload.get("z") for _, payload in sent] == [1, None]


def test_a_repeated_command_is_stale_unless_it_is_a_zero() -> None:
    sent = Sent()
    sent.drive('{"z":1}', repeated=True)
    sent.drive('{"z":0}', repeated=True)
    assert [payload["z"] for _, payload in sent] == [0]
    assert sent.counters.snapshot() == {"stale": 1, "signed": 1}


def test_answers_wait_for_the_end_of_the_brokers_packet() -> None:
    merger, stream = AnswerMerger(), CONNACK + publish("a", "x" * 300)
    assert merger.answer(puback(1)) == b"", "nothing comes before CONNACK"
    assert merger.feed(CONNACK[:3]) == CONNACK[:3]
    assert merger.feed(CONNACK[3:] + stream[4:50]) == CONNACK[3:] + puback(1) + stream[4:50]
    assert merger.answer(puback(2)) == b""
    assert merger.feed(stream[50:]) == stream[50:] + puback(2)
    assert merger.answer(puback(3)) == puback(3)


@given(st.lists(st.integers(0, 300), min_size=1, max_size=8), st.integers(1, 60))
def test_answers_never_cut_a_packet(sizes: list[int], step: int) -> None:
    packets = [CONNACK, *(publish("a", "x" * size) for size in sizes)]
    stream, merger, out = b"".join(packets), AnswerMerger(), bytearray()
    for number, at in enumerate(range(0, len(stream), step), start=1):
        out += merger.answer(puback(number))
        out += merger.feed(stream[at : at + step])
    rest, received = bytes(out), list[bytes]()
    while rest:
        size = 4 if rest[0] == 0x40 else len(packets[len(received)])
        received += [rest[:size]] if rest[0] != 0x40 else []
        rest = rest[size:]
    assert received == packets


def test_answers_without_end_are_refused() -> None:
    with pytest.raises(PacketError):
        AnswerMerger().answer(puback(1) * 20_000)


def test_all_motor_owners_drive_topics_are_the_robots() -> None:
    def line(topic: str, protocol: str = "goob_base_v1") -> dict[str, Any]:
        serial = {"port": f"/dev/{topic}"}
        return {"enabled": True, "protocol": protocol, "serial": serial, "topics": {"drive_values": topic}}

    services = {
        "serial_mcu_bridge": {
            **line("old/cmd"),
            "instances": {"arm": line("arm/cmd"), "imu": line("imu", "imu_mpu6050_v1")},
        },
        "ros1_bridge": {"topics": {"drive_values": "ros/cmd"}},
        "autonomy_manager": {"topics": {"command": "my/scripts"}},
    }
    rules = TopicRules.of(parse({"robot": {"id": "goob"}, "services": services}, folder=Path("/"), env={}))
    assert rules.drive_topics == {DRIVE, "old/cmd", "arm/cmd", "ros/cmd"}
    assert [rules.rule(topic).name for topic in ("my/scripts", f"{BASE}/incoming/autonomy-command")] == ["REFUSE"] * 2
