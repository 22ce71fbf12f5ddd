"""Recordings as JSON lines, in the form of the original's broker logger, and back: one line at a time.

A line is ``{"timestamp", "topic", "qos", "retain", "payload_size_bytes", "payload_truncated", "payload_b64"}``, and
``payload_text`` and ``payload_json`` where the payload is text or JSON. The logger stamps with seconds since 1970 and
cuts payloads at 8192 bytes unless asked otherwise. We add ``retained``: the message is from before the subscription.
The logger sets ``retain`` for such messages only; here it says that a message was published to be retained.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from decimal import Decimal
from functools import partial
from typing import Annotated, Any, BinaryIO, Final

import msgspec
from msgspec import UNSET, Meta, Raw, Struct, UnsetType

from pebble.errors import TransportError
from pebble.extensions.recordings.files.recorded import Channel, Recorded, RecordingError
from pebble.extensions.recordings.stamps import stamp_ns
from pebble.transports.topics import check_topic

TRUNCATED: Final = "truncated"  # of a channel: its payloads were cut before they were recorded here

LONGEST_LINE: Final = 96 << 20  # bytes; the largest message of a recording takes less
_TEXT_MOST: Final = 1 << 16  # bytes of a payload that is written as text, too
_LATEST_NS: Final = (1 << 63) - 1


class BadLine(Struct, frozen=True):
    """A line that holds no valid message."""

    number: int  # from 1
    problem: str


class _Line(Struct):
    timestamp: Raw
    topic: str
    qos: Annotated[int, Meta(ge=0, le=2)] = 0
    retain: bool = False
    retained: bool | None = None  # it was from before the subscription; None: the logger's "retain" says so
    payload_truncated: bool = False
    payload_b64: bytes = b""


class _Written(Struct):
    timestamp: Raw
    topic: str
    qos: int
    retain: bool
    retained: bool
    payload_size_bytes: int
    payload_truncated: bool
    payload_b64: bytes
    payload_text: str | UnsetType = UNSET
    payload_json: Any = UNSET


_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder(_Line)


def write_lines(messages: Iterable[Recorded], out: BinaryIO) -> int:
    """Write a line for each message; return their number.

    Stamps have nine decimals, so that reading the lines restores the same nanoseconds. Payloads of up to 64 KiB are
    also written readably if they are text or JSON.
    """
    count = 0
    for message in messages:
        out.write(_encoder.encode(_line(message)) + b"\n")
        count += 1
    return count


def read_lines(file: BinaryIO) -> Iterator[Recorded | BadLine]:
    """Yield the messages of a logger's file, in its order; invalid lines as :class:`BadLine`; empty ones not at all.

    Raises RecordingError at a line that is too long for memory.
    """
    bounded_lines = iter(partial(file.readline, LONGEST_LINE + 1), b"")  # until it returns no bytes
    for number, line in enumerate(bounded_lines, 1):
        if len(line) > LONGEST_LINE:
            raise RecordingError(f"{file.name}: line {number} is longer than {LONGEST_LINE:,} bytes")
        if not line.isspace():
            yield _message(number, line)


def _line(message: Recorded) -> _Written:
    metadata, payload = message.channel.metadata, message.payload
    seconds, fraction = divmod(message.log_ns, 10**9)
    line = _Written(
        timestamp=Raw(b"%d.%09d" % (seconds, fraction)),
        topic=message.channel.topic,
        qos={"1": 1, "2": 2}.get(metadata.get("qos", ""), 0),  # other programs write words there
        retain=metadata.get("retain") == "1",
        retained=metadata.get("retained") == "1",
        payload_size_bytes=len(payload),
        payload_truncated=metadata.get(TRUNCATED) == "1",
        payload_b64=payload,
    )
    if len(payload) <= _TEXT_MOST:
        with suppress(UnicodeDecodeError, msgspec.DecodeError, RecursionError):
            line.payload_text = payload.decode()
            line.payload_json = msgspec.json.decode(payload)
    return line


def _message(number: int, line: bytes) -> Recorded | BadLine:
    try:
        parsed = _decoder.decode(line)
        check_topic(parsed.topic.removeprefix("$"))  # our own events have one
        log_ns = _ns_of_seconds(bytes(parsed.timestamp))
    except (ValueError, OverflowError, RecursionError, TransportError) as error:  # msgspec's are ValueErrors
        return BadLine(number, str(error))
    payload = parsed.payload_b64
    encoding = "json" if payload[:1] in (b"{", b"[") else "application/octet-stream"
    channel = Channel(0, parsed.topic, encoding, _metadata(parsed))  # 0: a line numbers neither channel nor message
    return Recorded(channel, 0, log_ns, stamp_ns(payload), payload)


def _metadata(line: _Line) -> dict[str, str]:
    """Return the metadata of a recording's channel."""
    flags = {"retained": line.retain if line.retained is None else line.retained, TRUNCATED: line.payload_truncated}
    delivery = {"qos": str(line.qos), "retain": str(int(line.retain))}
    return delivery | {name: "1" for name, is_set in flags.items() if is_set}


def _ns_of_seconds(stamp: bytes) -> int:
    """Convert a number of seconds since 1970 to nanoseconds. Raises ValueError."""
    with suppress(ArithmeticError):
        ns = Decimal(stamp.decode()) * 10**9
        if 0 <= ns <= _LATEST_NS:  # false for NaN, too
            return int(ns)
    raise ValueError("the stamp is no time between 1970 and 2262")
