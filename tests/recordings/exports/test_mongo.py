"""Dumps of the original's archive become messages, and messages dumps."""

from __future__ import annotations

import datetime
import gzip
import io
import sys
from typing import Any

import bson
import pytest
from bson.binary import Binary
from bson.codec_options import CodecOptions
from bson.int64 import Int64
from bson.objectid import ObjectId

from pebble.errors import PebbleError
from pebble.recordings.exports.lines import BadLine, Imported
from pebble.recordings.exports.mongo import read_mongo, write_mongo
from pebble.recordings.files.recorded import Channel, Recorded

T_MS = 1_732_300_000_123
TOPIC = "pebble/robots/goob/outgoing/audio"
MOMENT = datetime.datetime(2024, 11, 22, 18, 26, 40, 123_000, tzinfo=datetime.UTC)
DOCUMENT: dict[str, Any] = {
    "_id": ObjectId(b"twelve bytes"),
    "ts": MOMENT,
    "topic": TOPIC,
    "qos": 1,
    "retain": False,
    "payload": b"\0\1\xff",
    "payload_size": 3,
    "payload_truncated": False,
}


def recorded(payload: bytes, log_ns: int = T_MS * 10**6, **metadata: str) -> Recorded:
    return Recorded(Channel(1, TOPIC, "json", {"qos": "0", "retain": "0"} | metadata), 0, log_ns, 0, payload)


def written(messages: list[Recorded]) -> bytes:
    out = io.BytesIO()
    assert write_mongo(messages, out) == len(messages)
    return out.getvalue()


def read(raw: bytes) -> list[Imported | BadLine]:
    return list(read_mongo(io.BytesIO(raw)))


def test_a_document_of_the_operator_pages() -> None:
    assert read(bson.encode(DOCUMENT)) == [Imported(T_MS * 10**6, TOPIC, b"\0\1\xff", qos=1)]


def test_a_document_of_ours() -> None:
    (document,) = bson.decode_all(written([recorded(b"{}", qos="1")]), CodecOptions(tz_aware=True))
    assert document == {
        "ts": MOMENT,
        "topic": TOPIC,
        "qos": 1,
        "retain": False,
        "retained": False,
        "payload": b"{}",
        "payload_size": 2,
        "payload_truncated": False,
    }


def test_there_and_back() -> None:
    payloads = [b"", b'{"t":1}', bytes(range(256)), "größer".encode(), b"x" * 3_000_000]
    flags = [{}, {"qos": "1", "retain": "1"}, {"retain": "1", "retained": "1"}, {"qos": "2"}, {"truncated": "1"}]
    messages = [
        recorded(payload, (T_MS + number) * 10**6, **metadata)
        for number, (payload, metadata) in enumerate(zip(payloads, flags, strict=True))
    ]
    back = read(written(messages))
    assert [(one.log_ns, one.topic, one.payload, one.metadata) for one in back if isinstance(one, Imported)] == [
        (one.log_ns, TOPIC, one.payload, one.channel.metadata) for one in messages
    ]


def test_a_compressed_dump() -> None:
    raw = written([recorded(b"one"), recorded(b"two")])
    assert read(gzip.compress(raw)) == read(raw)


def test_a_payload_that_no_document_can_hold_is_cut_and_marked() -> None:
    (document,) = bson.decode_all(written([recorded(b"x" * 17_000_000)]))
    assert (len(document["payload"]), document["payload_size"], document["payload_truncated"]) == (
        15_000_000,
        17_000_000,
        True,
    )


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"ts": 1732300000.25}, {"log_ns": 1_732_300_000_250_000_000}),
        ({"ts": Int64(T_MS)}, {"log_ns": T_MS * 10**6}),
        ({"payload": "on"}, {"payload": b"on"}),
        ({"payload": None}, {"payload": b""}),
        ({"payload": Binary(b"abc", 128)}, {"payload": b"abc"}),
        ({"qos": Int64(2)}, {"qos": 2}),
        ({"payload_truncated": True}, {"truncated": True}),
        ({"retain": True}, {"retain": True, "retained": True}),
        ({"retain": True, "retained": False}, {"retain": True, "retained": False}),
    ],
)
def test_other_types(changes: dict[str, Any], expected: dict[str, Any]) -> None:
    (message,) = read(bson.encode(DOCUMENT | changes))
    assert {name: getattr(message, name) for name in expected} == expected


@pytest.mark.parametrize(
    "changes",
    [
        {"ts": None},
        {"ts": "2024-11-22"},
        {"ts": True},
        {"ts": float("nan")},
        {"ts": datetime.datetime(1960, 1, 1, tzinfo=datetime.UTC)},
        {"ts": bson.datetime_ms.DatetimeMS(1 << 62)},
        {"topic": None},
        {"topic": "a/#"},
        {"qos": 7},
        {"qos": "1"},
        {"retain": "yes"},
        {"payload": 5},
        {"payload": {"x": 1}},
    ],
)
def test_bad_documents_are_reported_and_the_others_read(changes: dict[str, Any]) -> None:
    good = bson.encode(DOCUMENT)
    first, bad, last = read(good + bson.encode(DOCUMENT | changes) + good)
    assert isinstance(bad, BadLine)
    assert bad.number == 2
    assert first == last == Imported(T_MS * 10**6, TOPIC, b"\0\1\xff", qos=1)


def test_damage_within_a_document_costs_that_document() -> None:
    good = bson.encode(DOCUMENT)
    damaged = good[:4] + b"\x7f" + good[5:]  # a type that does not exist
    assert [type(one) for one in read(good + damaged + good)] == [Imported, BadLine, Imported]


@pytest.mark.parametrize(
    "end", [b"\x05", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\x00\x00\x00\xff", bson.encode(DOCUMENT)[:-7]]
)
def test_an_end_that_is_no_document_is_reported(end: bytes) -> None:
    *good, bad = read(bson.encode(DOCUMENT) * 2 + end)
    assert [type(one) for one in good] == [Imported, Imported]
    assert isinstance(bad, BadLine)


@pytest.mark.parametrize(("cut", "expected"), [(5, [Imported, BadLine]), (40, [BadLine])])
def test_a_damaged_compressed_dump_is_reported(cut: int, expected: list[type]) -> None:
    packed = gzip.compress(bson.encode(DOCUMENT))
    assert [type(one) for one in read(packed[:-cut])] == expected


def test_an_empty_dump() -> None:
    assert read(b"") == []


@pytest.mark.parametrize("module", ["bson", "bson.codec_options"])  # another package of that name lacks the second
def test_without_pymongo_one_line_names_it(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(PebbleError, match=r'pip install "pebble-robot\[mongo\]"'):
        read(b"")
    with pytest.raises(PebbleError, match="pymongo"):
        written([])
