"""Control of a board: requests, its state, and what moves it, in virtual time."""

from __future__ import annotations

import json
from random import Random
from typing import Any

import pytest

from common.estop import fields
from common.lease import request_of
from pebble.contract import CONTROL, CONTROL_STATE, codec
from pebble.errors import PayloadError
from tests.firmware.drill import BASE, HOLDER, Drill
from tests.firmware.drill import CONTROL as REQUESTS
from tests.firmware.test_network_robot import online

KINDS = ("minilamp", "benjr")


@pytest.mark.parametrize(("kind", "security", "others"), [
    *((kind, {}, False) for kind in KINDS), ("benjr", {"level": "login", "strangers": "drive"}, True),
])  # fmt: skip
def test_two_drivers_and_only_who_has_control_moves_by_a_key(kind: str, security: dict[str, str], others: bool) -> None:
    drill = online(kind, security=security)
    assert drill.control() == {
        "by": "", "id": "", "key": "", "device": "", "asks": "", "asks_id": "", "others": False, "named": False,
        "boot": drill.state()["boot"],
    }  # fmt: skip
    drill.request("aaaaaaaa", by="Ann", device="phone")
    drill.wait(0.5)
    ann = drill.control()
    assert (ann["by"], ann["id"], ann["device"], len(ann["key"])) == ("ann", "aaaaaaaa", "phone", 8)
    drill.command(0, 0.5, key=ann["key"])
    drill.wait(0.2)
    assert any(drill.outputs())
    drill.request("bbbbbbbb", by="otto")
    drill.wait(0.5)
    assert (drill.control()["key"], drill.control()["asks"]) == (ann["key"], "otto")
    drill.command(0, 0.5, key=ann["key"])
    drill.wait(0.2)
    drill.request("bbbbbbbb", by="otto", take=True)
    drill.wait(0.1)
    assert not any(drill.outputs())  # each new driver begins with wheels at rest
    drill.nonsense(json.dumps({"z": 1, "key": ann["key"]}).encode())
    drill.wait(0.5)
    otto = drill.control()
    assert not any(drill.outputs())
    drill.command(0, 0.5, key=otto["key"])
    drill.wait(0.2)
    assert any(drill.outputs())
    drill.wait(1.0)
    assert moves(drill, "drive-values", z=0.7) is others
    drill.wait(0.5)
    assert drill.control()["others"] is others
    drill.request("bbbbbbbb", want="release")
    drill.wait(0.5)
    assert drill.control()["key"] == ""
    assert moves(drill, "drive-values", z=0.7)


@pytest.mark.parametrize("kind", KINDS)
def test_control_ends_without_its_holder_and_outlives_a_connection(kind: str) -> None:
    drill = online(kind)
    drill.request(for_ms=10_000)
    drill.wait(0.5)
    drill.drop_robot()
    states = len(drill.received(HOLDER))
    drill.wait(6.0)
    assert len(drill.received(HOLDER)) > states
    assert drill.control()["id"] == "aaaaaaaa"
    drill.wait(6.0)
    assert drill.control()["key"] == ""


def test_states_are_short_and_not_more_than_four_a_second() -> None:
    drill = online("benjr")
    began = drill.seconds
    for number in range(400):
        drill.at(began + number / 100, lambda number=number: drill.request(f"{number:08x}", by="z" * 60, take=True))
    drill.run(began + 4.0)
    states = drill.received(HOLDER, began)
    assert 8 <= len(states) <= 17
    assert max(map(len, states)) <= 300
    assert codec.decode(CONTROL_STATE, states[-1]).by == "z" * 40


def test_without_its_topic_a_board_has_no_control() -> None:
    drill = online("benjr", refused={REQUESTS})
    capabilities = json.loads(drill.received("pebble/robots/rover/outgoing/capabilities")[-1])
    assert capabilities["value"]["drive"]["control"] is False
    assert drill.control() == {}
    drill.command(0, 0.5)
    drill.wait(0.2)
    assert any(drill.outputs())


def at_named(kind: str) -> Drill:
    """A board that checks names, and page-1/ann has control of it."""
    drill = online(kind, security={"level": "named", "strangers": "refuse"})
    drill.clock.watch = drill.check = lambda: None  # type: ignore[method-assign]  # the rule of drills knows no names
    send(drill, "by/page-1/control", id="aaaaaaaa", by="Ann", device="phone", for_ms=10_000)
    drill.wait(0.5)
    return drill


def send(drill: Drill, metric: str, *, retain: bool = False, **body: Any) -> None:
    drill.broker.publish(f"{BASE}/incoming/{metric}", json.dumps(body).encode(), qos=1, retain=retain)


def moves(drill: Drill, metric: str, **body: Any) -> bool:
    """Whether this drive command moves a board that stands; the rule of drills knows no strangers."""
    drill.clock.watch = drill.check = lambda: None  # type: ignore[method-assign]
    send(drill, metric, **body)
    drill.wait(0.3)
    moving = any(drill.outputs())
    send(drill, "drive-values", z=0)
    drill.wait(0.2)
    assert not any(drill.outputs())  # a zero needs no name
    return moving


@pytest.mark.parametrize("kind", KINDS)
def test_of_what_has_no_name_or_is_retained_only_stops_and_zeros_count(kind: str) -> None:
    drill = at_named(kind)
    key = drill.control()["key"]
    for metric in ("control", "control/take", "by/otto/by/otto/control"):
        send(drill, metric, id="bbbbbbbb", by="otto")
    send(drill, "by/otto/control/take", id="bbbbbbbb", retain=True)  # live: it counts, and again as a retained one not
    drill.wait(0.5)
    assert (drill.control()["by"], drill.control()["id"]) == ("otto", "bbbbbbbb")
    send(drill, "by/page-1/control/take", id="aaaaaaaa", by="ann")
    drill.wait(0.5)
    drill.drop_robot()
    drill.wait(5.0)
    assert drill.control()["by"] in ("page-1/ann", "")
    assert drill.control()["key"] != key
    send(drill, "estop", stop="00000000000000aa", by="anybody")
    drill.wait(0.3)
    assert drill.state()["latched"]
    state = drill.state()
    for metric in ("estop-reset", "by/otto/by/otto/estop-reset"):
        send(drill, metric, boot=state["boot"], count=state["count"])
    drill.wait(0.5)
    assert drill.state()["latched"]
    send(drill, "by/sam/estop-reset", boot=state["boot"], count=state["count"])
    drill.wait(0.5)
    assert not drill.state()["latched"]
    send(drill, "by/otto/estop", stop="00000000000000bb", by="Eve")
    drill.wait(0.3)
    assert (drill.state()["latched"], drill.state()["by"]) == (True, "otto/eve")


def test_a_topic_that_fits_nowhere_ends_the_connection_and_moves_nothing() -> None:
    drill = at_named("benjr")
    send(drill, "by/page-1/drive-values", z=0.5, key=drill.control()["key"])
    drill.wait(0.1)
    assert any(drill.outputs())
    send(drill, f"by/{'a' * 5000}/drive-values", z=1)
    drill.wait(0.5)
    assert not any(drill.outputs())
    drill.wait(5.0)
    assert drill.robot.session.connection.state == "online"


@pytest.mark.parametrize("security", [{"level": "nmaed"}, {"level": "named", "strangers": "all"}])
def test_a_level_that_is_unknown_is_refused(security: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="not in"):
        online("benjr", security=security)


def test_a_board_reads_requests_as_linux_does() -> None:
    random, accepted = Random(1), 0
    values = {
        "id": ["3f2a91c0", "3F2A91C0", "3f2a91c", "", 7, None],
        "want": ["hold", "release", "drive", None],
        "by": ["ann", "page-1/Ann B.", "a" * 60, 7, None],
        "device": ["phone", "x" * 60, []],
        "for_ms": [3000, 0, 1500.5, 99_999, "1", True, None],
    }
    for _ in range(3000):
        names = [name for name in values if name == "id" or random.random() < 0.4]
        body = {name: random.choice(values[name]) for name in names}
        body = {"value": body, "by": "x"} if random.random() < 0.2 else body
        try:
            request = codec.decode(CONTROL, json.dumps(body).encode())
            ms = 0 if request.ends() else int(min(max(request.for_ms, 1), 10_000))
            expected = request.id, request.by, request.device, ms
            accepted += 1
        except PayloadError:
            expected = None
        assert request_of(fields(body)) == expected, body
    assert accepted > 100
