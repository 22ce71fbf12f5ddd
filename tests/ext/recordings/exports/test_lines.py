"""Lines of a broker logger become messages, and messages lines; the same bytes come back."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.extensions.media import json_video
from pebble.extensions.recordings.exports import lines
from pebble.extensions.recordings.exports.lines import BadLine, read_lines, write_lines
from pebble.extensions.recordings.files.recorded import Channel, Recorded, RecordingError

T_NS = 1_732_300_000_123_456_789
TOPIC = "pebble/robots/goob/outgoing/online"
LINE = {
    "timestamp": 1732300000.25,
    "topic": TOPIC,
    "qos": 1,
    "retain": False,
    "payload_size_bytes": 3,
    "payload_truncated": False,
    "payload_b64": "AAH/",
}

BYTES = Channel(0, TOPIC, "application/octet-stream", {"qos": "1", "retain": "0"})
MESSAGE = Recorded(BYTES, 0, 1_732_300_000_250_000_000, 0, b"\0\1\xff")


def recorded(payload: bytes, topic: str = TOPIC, log_ns: int = T_NS, **metadata: str) -> Recorded:
    return Recorded(Channel(1, topic, "json", {"qos": "0", "retain": "0"} | metadata), 0, log_ns, 0, payload)


def written(messages: list[Recorded]) -> bytes:
    out = io.BytesIO()
    assert write_lines(messages, out) == len(messages)
    return out.getvalue()


def read(raw: bytes) -> list[Recorded | BadLine]:
    return list(read_lines(io.BytesIO(raw)))


def test_a_line_of_ours() -> None:
    line = json.loads(written([recorded(b'{"t": 1, "online": true}', qos="1", retain="1")]))
    assert line.pop("timestamp") == pytest.approx(T_NS / 1e9)
    assert base64.b64decode(line.pop("payload_b64")) == b'{"t": 1, "online": true}'
    assert line == {
        "topic": TOPIC,
        "qos": 1,
        "retain": True,
        "retained": False,
        "payload_size_bytes": 24,
        "payload_truncated": False,
        "payload_text": '{"t": 1, "online": true}',
        "payload_json": {"t": 1, "online": True},
    }


@pytest.mark.parametrize(
    ("payload", "readable"),
    [
        (b"true", {"payload_text", "payload_json"}),
        (b"", {"payload_text"}),
        (b"[NaN]", {"payload_text"}),
        (b'{"a":\n1}', {"payload_text", "payload_json"}),
        (b"[" * 100_000, set()),
        (b"9" * 400, {"payload_text", "payload_json"}),
        (b"\xff\xd8\xff", set()),
        (json_video.pack(1, True, 1, bytes(range(256)) * 999), {"payload_text", "payload_json"}),
    ],
)
def test_payloads_are_readable_where_they_are_text_or_json(payload: bytes, readable: set[str]) -> None:
    raw = written([recorded(payload)])
    assert raw.count(b"\n") == 1
    assert {name for name in json.loads(raw) if name in ("payload_text", "payload_json")} == readable
    assert [message.payload for message in read(raw) if isinstance(message, Recorded)] == [payload]


@pytest.mark.parametrize("qos", ["", "reliable", "9"])
def test_a_qos_of_another_program_is_none(qos: str) -> None:
    assert json.loads(written([recorded(b"{}", qos=qos)]))["qos"] == 0


def shown(message: Recorded) -> tuple[object, ...]:
    return message.log_ns, message.channel.topic, message.payload, message.channel.metadata


@given(
    st.lists(
        st.builds(
            recorded,
            st.binary(max_size=200) | st.text().map(str.encode) | st.sampled_from([b"{}", b"null", b"\n"]),
            topic=st.sampled_from([TOPIC, "pebble/infrastructure", "$recorder/events", "a/ü/ö", 'a"b\\c']),
            log_ns=st.integers(0, 4 * 10**18),
            qos=st.sampled_from("012"),
            retain=st.sampled_from("01"),
        )
        | st.builds(recorded, st.binary(), retain=st.just("1"), retained=st.just("1"))
        | st.builds(recorded, st.binary(), qos=st.just("2"), truncated=st.just("1")),
        max_size=5,
    )
)
def test_there_and_back(messages: list[Recorded]) -> None:
    back = [message for message in read(written(messages)) if isinstance(message, Recorded)]
    assert list(map(shown, back)) == list(map(shown, messages))


@pytest.mark.parametrize(
    ("changes", "flags"),
    [
        ({}, {"qos": "1", "retain": "0"}),
        ({"payload_truncated": None}, {"qos": "1", "retain": "0"}),
        ({"retain": True}, {"qos": "1", "retain": "1", "retained": "1"}),  # from before its subscription
        ({"payload_truncated": True, "payload_size_bytes": 9000}, {"qos": "1", "retain": "0", "truncated": "1"}),
    ],
)
def test_a_line_of_the_loggers(changes: dict[str, object], flags: dict[str, str]) -> None:
    line = {key: value for key, value in (LINE | changes).items() if value is not None}
    (message,) = read(json.dumps(line).encode() + b"\n")
    assert isinstance(message, Recorded)
    assert shown(message) == (MESSAGE.log_ns, TOPIC, MESSAGE.payload, flags)


def test_a_line_without_an_end_is_refused_by_file_and_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lines, "LONGEST_LINE", 1000)
    path = tmp_path / "day.jsonl"
    path.write_bytes(json.dumps(LINE).encode() + b"\n" + b" " * 999 + b"\n" + b"x" * 1001)
    with path.open("rb") as file:
        messages = read_lines(file)
        next(messages)
        with pytest.raises(RecordingError, match=r"day\.jsonl: line 3 is longer than 1,000 bytes"):
            next(messages)


@pytest.mark.parametrize(
    ("stamp", "expected_ns"),
    [
        ("1732300000", 1_732_300_000 * 10**9),
        ("1732300000.123456789", 1_732_300_000_123_456_789),
        ("0", 0),
    ],
)
def test_stamps(stamp: str, expected_ns: int) -> None:
    raw = json.dumps(LINE | {"timestamp": "STAMP"}).replace('"STAMP"', stamp).encode()
    assert [one.log_ns for one in read(raw) if isinstance(one, Recorded)] == [expected_ns]


@pytest.mark.parametrize(
    "line",
    [
        b"hello",
        b"[1, 2]",
        b"\xff\xfe",
        b"[" * 200_000,
        json.dumps(LINE | {"topic": "a/#"}).encode(),
        json.dumps(LINE | {"topic": 5}).encode(),
        json.dumps(LINE | {"qos": 3}).encode(),
        json.dumps(LINE | {"payload_b64": "%%"}).encode(),
        json.dumps(LINE | {"timestamp": "0001-01-01T00:00:00"}).encode(),
        json.dumps(LINE | {"timestamp": -1}).encode(),
        json.dumps(LINE).replace("1732300000.25", "NaN").encode(),
        json.dumps(LINE).replace("1732300000.25", "9223372036.854775808").encode(),
    ],
)
def test_bad_lines_are_reported_and_the_others_read(line: bytes) -> None:
    good = json.dumps(LINE).encode()
    first, bad, last = read(good + b"\n" + line + b"\r\n\n" + good)
    assert isinstance(bad, BadLine)
    assert bad.number == 2
    assert bad.problem
    assert first == last == MESSAGE
