"""The server's table of components, and what pages get of it; without a broker."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.contract import CAPABILITIES, codec
from pebble.contract.payloads import Capabilities
from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.people import People
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import robots as robots_module
from pebble.extensions.page.drive.driven_robot import Tab
from pebble.extensions.page.log_lines import MAX_BYTES, MAX_LINE_BYTES, MAX_LINES, PART_BYTES, LogLines, line_of
from pebble.extensions.page.robots import Interest, Robots
from pebble.extensions.page.server import Server
from pebble.extensions.page.setting import WebSettings
from pebble.transports import Message, MqttSettings

_CAPABILITIES = {"t": 1, "value": {"drive": {"available": True}, "estop": {"available": True, "owners": ["serial"]}}}


def published(ref: str, metric: str, value: object) -> Message:
    raw = value if isinstance(value, bytes) else json.dumps(value).encode()
    return Message(f"{ref}/outgoing/{metric}", raw)


GOOB = "pebble/robots/goob"


@pytest.fixture
def server() -> Iterator[Server]:
    people, audit = People(None), Audit(None)
    yield Server(WebSettings(broker=MqttSettings(host="127.0.0.1", port=1)), people, audit)
    people.close()
    audit.close()


def test_what_no_topic_may_be_called_is_refused(server: Server) -> None:
    for topic in (f"{GOOB}/incoming/\x01", "x" * 1100, "a" + "/b" * 250, "#", ""):
        assert server.broker.publish(topic, b"{}") is False


def stop(server: Server, ref: str) -> None:
    server.stops.press(ref, "a" * 16, by="", why="", now=1.0, known=[RobotView(GOOB)])


#: What a page does with a robot, whether it gets a place that way, and whether it keeps one.
USES: dict[str, tuple[Callable[[Server], object], tuple[bool, bool]]] = {
    "nothing": (lambda _: None, (False, False)),
    "it is open": (lambda server: server.open_components.open(GOOB), (True, True)),
    "it is driven": (lambda server: setattr(server.drivers.robot(GOOB), "tab", Tab("", "ann", "")), (True, True)),
    "it is stopped": (lambda server: stop(server, GOOB), (True, True)),
    "all are stopped": (lambda server: stop(server, ""), (False, True)),
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


def test_large_values_are_sent_one_at_a_time() -> None:
    robots, interest = Robots(), Interest(lambda: None)
    robots.join(interest)
    for name in ("a", "b"):
        topic = f"pebble/robots/{name}/outgoing/capabilities"
        robots.receive(Message(topic, codec.encode(CAPABILITIES, Capabilities(t=1, value={"x": "y" * 20_000}))), 0.0)
    robots.set_server_metric("", "web/broker", {"connected": True})

    def taken(*, large: bool) -> tuple[set[str], bool]:
        values, had = robots.take(interest, 1.0, large=large)
        return {ref.rpartition("/")[2] for ref, metric, *_ in values if metric == "capabilities"}, had

    assert taken(large=False) == (set(), False)
    first, had = taken(large=True)
    assert had
    assert taken(large=False) == (set(), False)
    assert (first | taken(large=True)[0], len(first)) == ({"a", "b"}, 1)
    assert taken(large=True) == (set(), False)


# -- what pages get of outlets, microcontrollers and cards


DESCRIBE = "mcu/lamp-1/describe"


FIELD = {"name": "x", "type": "u8"}
INTERFACE = {"name": "a", "dir": "out", "encoding": {"fields": [FIELD]}}
BARE = {"model": "", "firmware_version": "", "interfaces": []}
TAG = {"key": "tag", "type": "int", "min": 0}
FORM = {"key": "tag", "label": "tag", "type": "int", "default": None, "arg": "", "min": 0}
#: Metrics, what a robot publishes, and what pages get of it.
SHOWN: list[tuple[str, Any, Any]] = [
    ("soundboard-files", {"files": ["a.wav"], "more": 1}, {"files": ["a.wav"], "more": 1}),
    ("soundboard-files", {"value": {"files": ["a.wav"]}}, {"files": ["a.wav"]}),
    *[("soundboard-files", value, {}) for value in (7, {"files": ["a", 7]})],
    ("soundboard-status", {"playing": True, "file": {"x": 1}}, {}),
    *[("autonomy-status", value, {}) for value in ({"running": 1}, {"running": True, "dependencies": ["x"]})],
    ("autonomy-status", {"running": True, "file": None}, {"running": True, "file": None}),
    *[("autonomy-files", value, {}) for value in (None, {"files": {}})],
    ("autonomy-files", {"files": [{"file": "a", "configs": [TAG, 7, {}]}, {"file": 7}, "b"]},
     {"files": [{"file": "a", "configs": [FORM]}]}),
    ("autonomy-files", {"files": [{"file": "a", "label": 7}, {"file": ""}]}, {"files": []}),
    (DESCRIBE, 7, BARE),
    (DESCRIBE, {"model": {}, "firmware_version": ["x"], "interfaces": [7, INTERFACE, {**INTERFACE, "dir": "up"}]},
     {**BARE, "interfaces": [INTERFACE]}),
    ("outlets/o1/status", {"value": {"on": True}, "label": "Lamp"}, {"value": {"on": True}, "label": "Lamp"}),
    ("outlets/o1/status", {"value": {"on": "yes"}}, {}),
    ("media-status", {"t": 1, "value": {"camera": {"running": True}}}, {"camera": {"running": True}}),
    ("media-status", {"t": 1, "value": {"camera": {"running": True, "problem": 7}}}, {}),
    ("neighbours", {"receives": ["x"]}, {}),
    *[("capabilities", value, {}) for value in (7, {"t": 1, "value": 7})],
    ("capabilities", {"t": 1, "value": {"drive": {}, "mine": 7}}, {"t": 1, "value": {"drive": {}, "mine": 7}}),
    ("capabilities", {"value": {"lights": 7, "identity": {"name": 7}, "outlets": {"outlets": [1]}, "reboot": True}},
     {"value": {"reboot": True}}),
    ("status", 7, 7),
]  # fmt: skip


@pytest.mark.parametrize(("metric", "payload", "expected"), SHOWN)
def test_pages_get_what_their_cards_rely_on(metric: str, payload: Any, expected: Any) -> None:
    robots = Robots()
    robots.receive(published(GOOB, metric, payload), 1.0)
    assert json.loads(bytes(robots.value(GOOB, metric) or b"null")) == expected


def test_pages_get_a_value_without_the_bytes_around_it() -> None:
    robots = Robots()
    robots.receive(published(GOOB, "status", b'\xef\xbb\xbf{"t":1,"value":{}}\r\n\0'), 1.0)
    assert bytes(robots.value(GOOB, "status") or b"") == b'{"t":1,"value":{}}'
    robots.receive(published(GOOB, "status", b"\0"), 1.0)  # not even an empty payload
    assert robots.value(GOOB, "status") is not None


ODD = (
    b"", b"\xff\xfe", b'{"value":NaN}', b'{"t":1e999}', b'{"value":"\\ud800"}', b"[" * 60_000, b"9" * 60_000,
    b'{"value":"%s"}' % (b"x" * 70_000),
)  # fmt: skip


@pytest.mark.parametrize("metric", ["status", "wheel-odometry", "logs", DESCRIBE, "autonomy-status", "capabilities"])
def test_whatever_a_robot_publishes_pages_get_json(metric: str) -> None:
    robots = Robots()
    for payload in ODD:
        robots.receive(published(GOOB, metric, payload), 1.0)
        json.loads(bytes(robots.value(GOOB, metric) or b"null"), parse_constant=pytest.fail, parse_int=str)


def test_a_value_ends_with_an_empty_message() -> None:
    robots, interest = Robots(), Interest(lambda: None)
    robots.join(interest)
    robots.watch(interest, GOOB)
    robots.receive(published(GOOB, DESCRIBE, {}), 1.0)
    assert [value[:2] for value in robots.take(interest, 2.0, large=False)[0]] == [(GOOB, DESCRIBE)]
    robots.receive(published(GOOB, DESCRIBE, b""), 1.0)
    assert robots.take(interest, 3.0, large=False) == (((GOOB, DESCRIBE, None, 0.0),), False)


# -- log lines


def read(lines: LogLines, after: int = 0) -> list[tuple[int, list[object]]]:
    """All runs behind this number, each with the number of its first line."""
    found = []
    while (run := lines.after(after)) is not None:
        found.append((run.first, [json.loads(bytes(line))["message"] for line in run.lines]))
        after = run.first + len(run.lines) - 1
    return found


def taken(*lines: bytes) -> LogLines:
    made = LogLines()
    for line in lines:
        made.add(line)
    return made


def test_lines_are_numbered_from_1_sent_once_and_leave_a_gap_where_some_are_dropped() -> None:
    lines = taken(b'{"message":"a"}', b'"b"', b'"' + b"x" * MAX_LINE_BYTES + b'"', b'"c"')
    runs = [[(1, ["a", "b"]), (4, ["c"])], [(2, ["b"]), (4, ["c"])], [(4, ["c"])]]
    assert [read(lines, after) for after in range(3)] == runs


def test_plain_text_becomes_a_string() -> None:
    assert bytes(line_of(b"hello [x") or b"") == b'{"message":"hello [x"}'
    assert json.loads(bytes(line_of(b"\xff\x00") or b"")) == {"message": "\ufffd\0"}
    assert bytes(line_of(b'\xef\xbb\xbf{"t":1,"msg":"x"}\r\n\0') or b"") == b'{"message":"x","t":1}'
    assert line_of(b"\x01" * (MAX_LINE_BYTES // 2)) is None  # six bytes each, as JSON


@given(st.lists(st.binary(max_size=2000), max_size=40), st.integers(0, 50))
def test_whatever_arrives_is_bounded_and_valid_json(payloads: list[bytes], after: int) -> None:
    runs = read(taken(*payloads * 8), after)
    sizes = [sum(len(json.dumps(line)) for line in run) for _, run in runs]
    assert sum(sizes) <= 6 * MAX_BYTES  # Python escapes what msgspec does not
    assert sum(len(run) for _, run in runs) <= MAX_LINES
    numbers = [first + index for first, run in runs for index in range(len(run))]
    assert numbers == sorted(set(numbers))
    assert not numbers or (numbers[0] > after and numbers[-1] <= len(payloads) * 8)


def test_a_message_to_a_page_is_short_but_has_a_line() -> None:
    runs = read(taken(*[json.dumps("x" * 2000).encode()] * 30))
    assert max(len(json.dumps(run)) for _, run in runs) <= PART_BYTES + 100
    assert len(read(taken(json.dumps("x" * (MAX_LINE_BYTES - 10)).encode()))) == 1


@pytest.mark.parametrize(
    ("raw", "line"),
    [
        ({"t": 5, "level": "warn", "service": "imu", "message": "[imu] x"}, [5, "WARNING", "imu", "x"]),
        ({"value": {"t": 5, "level": "ERROR", "msg": "x"}}, [5, "ERROR", "", "x"]),
        ({"t": 7, "value": "x"}, [7, "", "", "x"]),
        ({"timestamp": 2, "message": 3}, [2000, "", "", "3"]),
        (None, [None, "", "", ""]),
        ([1, {"a": 2}], [None, "", "", '[1,{"a":2}]']),
        ({"t": "soon", "level": {}, "service": [], "message": {"a": 1}}, [None, "", "", '{"a":1}']),
        ({"t": 1e300, "level": "constructor", "message": "x"}, [None, "CONSTRUCTOR", "", "x"]),
        ({"message": "x" * 5000}, [None, "", "", "x" * 4000 + "…"]),
    ],
)
def test_a_line_may_be_of_any_shape(raw: object, line: list[object]) -> None:
    made = json.loads(bytes(line_of(json.dumps(raw).encode()) or b""))
    assert [made.get("t"), made.get("level", ""), made.get("service", ""), made["message"]] == line
