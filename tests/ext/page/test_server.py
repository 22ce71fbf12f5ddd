"""The parts of the server together, without a broker."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator

import pytest

from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.people import People
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import robots as robots_module
from pebble.extensions.page.drive.driven_robot import Tab
from pebble.extensions.page.robots import Interest, Robots
from pebble.extensions.page.server import Server
from pebble.extensions.page.setting import WebSettings
from pebble.transports import Message, MqttSettings

_CAPABILITIES = {"t": 1, "value": {"drive": {"available": True}, "estop": {"available": True, "owners": ["serial"]}}}


def published(ref: str, metric: str, value: object, *, retain: bool = False) -> Message:
    return Message(f"{ref}/outgoing/{metric}", json.dumps(value).encode(), retain=retain)


GOOB, TOWER = "pebble/robots/goob", "pebble/robots/tower"


@pytest.fixture
def server() -> Iterator[Server]:
    people, audit = People(None), Audit(None)
    yield Server(WebSettings(broker=MqttSettings(host="127.0.0.1", port=1)), people, audit)
    people.close()
    audit.close()


@pytest.mark.parametrize("topic", ["pebble/robots/goob/incoming/\x01", "x" * 1100, "a" + "/b" * 250, "#", ""])
def test_what_no_topic_may_be_called_is_refused_and_nothing_else(server: Server, topic: str) -> None:
    assert server.broker.publish(topic, b"{}") is False


#: What a page does with a robot, whether it gets a place that way, and whether it keeps one.
USES: dict[str, tuple[Callable[[Server], object], tuple[bool, bool]]] = {
    "nothing": (lambda _: None, (False, False)),
    "it is open": (lambda server: server.open_components.open(GOOB), (True, True)),
    "it is driven": (lambda server: setattr(server.drivers.robot(GOOB), "tab", Tab("", "ann", "")), (True, True)),
    "it is stopped": (
        lambda server: server.stops.press(GOOB, "a" * 16, by="", why="", now=1.0, known=[]),
        (True, True),
    ),
    "all are stopped": (
        lambda server: server.stops.press("", "a" * 16, by="", why="", now=1.0, known=[RobotView(GOOB)]),
        (False, True),
    ),
}


@pytest.mark.parametrize(("use", "expected"), USES.values(), ids=USES)
def test_a_robot_keeps_its_place_while(
    server: Server, monkeypatch: pytest.MonkeyPatch, use: Callable[[Server], object], expected: tuple[bool, bool]
) -> None:
    monkeypatch.setattr(server.open_components, "update", lambda _ref: None)
    use(server)
    assert (server.robots.is_wanted(GOOB), server.robots.is_kept(GOOB)) == expected


@pytest.mark.parametrize(
    ("comes", "wanted", "kept", "stays"),
    [
        ("first", False, False, False),
        ("first", False, True, True),
        ("first", True, True, True),
        ("last", False, False, False),
        ("last", True, True, True),
    ],
)
def test_no_crowd_takes_the_place_of_a_robot_that_a_page_uses(
    monkeypatch: pytest.MonkeyPatch, comes: str, wanted: bool, kept: bool, stays: bool
) -> None:
    monkeypatch.setattr(robots_module, "MAX_COMPONENTS", 20)
    robots, opened = Robots(), [f"pebble/robots/open{number}" for number in range(30)]
    robots.is_wanted = lambda ref: ref in opened or (wanted and ref == GOOB)
    robots.is_kept = lambda ref: ref in opened or (kept and ref == GOOB)
    crowd = [f"pebble/robots/e{number}" for number in range(25)]
    for ref in [GOOB, *crowd] if comes == "first" else [*crowd, GOOB]:
        robots.receive(published(ref, "capabilities", _CAPABILITIES), 1.0)
    assert len(robots.components) == 20
    for ref in opened:
        robots.receive(published(ref, "online", {"t": 1}), 1.0)
    assert set(robots.components) == {*opened, *[GOOB] * stays}
    assert robots.omitted


def test_many_are_refreshed_rarely_and_the_open_one_and_the_dead_one_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty at ten a second: each every four seconds."""
    monkeypatch.setattr(robots_module, "_REFRESHES_PER_S", 10)
    refs = [f"pebble/robots/r{number}" for number in range(40)]
    opened, dead, died = refs[7], refs[8], 10.0
    robots, page = Robots(), Interest(lambda: None)
    robots.join(page)
    robots.watch(page, opened)
    seen: dict[str, list[tuple[float, bool | None]]] = {ref: [] for ref in refs}
    for now in (quarter / 4 for quarter in range(4 * 20)):
        for ref in refs if now < died else [one for one in refs if one != dead]:
            robots.receive(published(ref, "online", {"t": 1}), now)
        robots.refresh(now + now / 1000)  # an age that did not change is not sent
        taken, _ = robots.take(page, now, large=False)
        for ref, _metric, value, _age in (one for one in taken if one[1] == "web/liveness"):
            seen[ref].append((now, json.loads(bytes(value))["online"]))
    late = {ref: [now for now, _ in found if now >= 4.0] for ref, found in seen.items()}
    assert len(late[opened]) == 16
    assert {len(found) for ref, found in late.items() if ref not in (opened, dead)} <= {3, 4, 5}
    assert next(now for now, online in seen[dead] if online is False) - died <= 1.5 + 0.25
    assert not [now for now, online in seen[dead] if online and now > died + 1.75]


def test_what_does_not_fit_into_a_message_waits_behind_what_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots_module, "MAX_STATE_BYTES", 1000)
    refs = [f"pebble/robots/r{number}" for number in range(40)]
    robots, page = Robots(), Interest(lambda: None)
    for ref in refs:
        robots.receive(published(ref, "capabilities", _CAPABILITIES), 1.0)
    robots.join(page)
    robots.watch(page, refs[30])
    parts = []
    while not parts or page.more:
        parts.append([ref for ref, *_ in robots.take(page, 1.0, large=False)[0]])
    assert parts[0][0] == refs[30]
    assert len(parts) > 3
    assert sorted(ref for part in parts for ref in part) == sorted(refs)
