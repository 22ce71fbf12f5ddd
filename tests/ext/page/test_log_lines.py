"""The log lines that the server has for pages."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.extensions.page.log_lines import MAX_BYTES, MAX_LINE_BYTES, MAX_LINES, PART_BYTES, LogLines, line_of


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


def test_lines_are_numbered_from_1_and_sent_once() -> None:
    lines = taken(b'{"message":"a"}', b'"b"')
    runs = [[(1, ["a", "b"])], [(2, ["b"])], []]
    assert [read(lines, after) for after in range(3)] == runs


def test_what_is_dropped_leaves_a_gap() -> None:
    lines = taken(b'"a"', b'"' + b"x" * MAX_LINE_BYTES + b'"', b'"b"')
    assert read(lines) == [(1, ["a"]), (3, ["b"])]


def test_a_page_that_is_too_slow_sees_from_where_there_are_lines() -> None:
    runs = read(taken(*(str(number).encode() for number in range(MAX_LINES + 20))), 5)
    assert (runs[0][0], sum(len(run) for _, run in runs)) == (21, MAX_LINES)


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
        ("plain text", [None, "", "", "plain text"]),
        (None, [None, "", "", ""]),
        ([1, {"a": 2}], [None, "", "", '[1,{"a":2}]']),
        ({"t": "soon", "level": {}, "service": [], "message": {"a": 1}}, [None, "", "", '{"a":1}']),
        ({"t": 1e300, "level": "constructor", "message": "x"}, [None, "CONSTRUCTOR", "", "x"]),
        ({"toString": 1, "a": 2}, [None, "", "", '{"toString":1,"a":2}']),
        ({"message": "x" * 5000}, [None, "", "", "x" * 4000 + "…"]),
    ],
)
def test_a_line_may_be_of_any_shape(raw: object, line: list[object]) -> None:
    made = json.loads(bytes(line_of(json.dumps(raw).encode()) or b""))
    assert [made.get("t"), made.get("level", ""), made.get("service", ""), made["message"]] == line
