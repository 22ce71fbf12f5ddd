"""Recordings as JSON lines, in the form of the original's broker logger, and back: one line at a time.

A line is ``{"timestamp", "topic", "qos", "retain", "payload_size_bytes", "payload_truncated", "payload_b64"}``, and
``payload_text`` and ``payload_json`` where the payload is text or JSON. The logger stamps with seconds since 1970 and
cuts payloads at 8192 bytes unless asked otherwise. We add ``retained``: the logger's subscriptions set ``retain`` for
messages that are from before them only, ours as they were published.
"""

from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import Annotated, Any, BinaryIO, Final

import msgspec
from msgspec import UNSET, Meta, Raw, Struct, UnsetType

from pebble.errors import TransportError
from pebble.recordings.files.recorded import Recorded
from pebble.transports.topics import check_topic

TRUNCATED: Final = "truncated"  # of a channel: its payloads were cut before they were recorded here

_TEXT_MOST: Final = 1 << 16  # bytes of a payload that is written as text, too
_MILLISECONDS_FROM: Final = 10**11  # a number as large as this counts milliseconds (paper A.4.2)
_LATEST_NS: Final = (1 << 63) - 1
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND: Final = timedelta(microseconds=1)

Progress = Callable[[int], None]  # called with the log time of each message


class Imported(Struct, frozen=True):
    """A message that another program recorded."""

    log_ns: int  # when it was received, since 1970
    topic: str
    payload: bytes
    qos: int = 0
    retain: bool = False
    retained: bool = False  # it was from before the subscription
    truncated: bool = False  # the payload is only the beginning of what was published

    @property
    def metadata(self) -> dict[str, str]:
        """The form is that of a recording's channel."""
        flags = {"retained": self.retained, TRUNCATED: self.truncated}
        known = {"qos": str(self.qos), "retain": str(int(self.retain))}
        return known | {name: "1" for name, is_set in flags.items() if is_set}


class BadLine(Struct, frozen=True):
    """A line that holds no message."""

    number: int  # from 1
    problem: str


class _Line(Struct):
    timestamp: Raw
    topic: str
    qos: Annotated[int, Meta(ge=0, le=2)] = 0
    retain: bool = False
    retained: bool | None = None
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


def write_lines(
    messages: Iterable[Recorded], out: BinaryIO, *, text: bool = True, on_time: Progress | None = None
) -> int:
    """Write a line for each message; returns how many.

    Stamps have nine decimals, so that reading the lines again gives the same nanoseconds. With ``text``, payloads of
    up to 64 KiB are readable, too, where they are text or JSON.
    """
    count = 0
    for message in messages:
        out.write(_encoder.encode(_line(message, text)) + b"\n")
        count += 1
        if on_time is not None:
            on_time(message.log_ns)
    return count


def read_lines(file: BinaryIO) -> Iterator[Imported | BadLine]:
    """The messages of a logger's file, in its order. Lines that are none are yielded as such; empty ones are not."""
    for number, line in enumerate(file, 1):
        if not line.isspace():
            yield _imported(number, line)


def checked(message: Imported) -> Imported:
    """The message, if a recording can hold it. Raises ValueError."""
    try:
        check_topic(message.topic.removeprefix("$"))  # our own events have one
    except TransportError as error:
        raise ValueError(str(error)) from None
    if not 0 <= message.log_ns <= _LATEST_NS:
        raise ValueError("the stamp is no time between 1970 and 2262")
    return message


def _line(message: Recorded, text: bool) -> _Written:
    metadata, payload = message.channel.metadata, message.payload
    seconds, fraction = divmod(message.log_ns, 10**9)
    line = _Written(
        timestamp=Raw(b"%d.%09d" % (seconds, fraction)),
        topic=message.channel.topic,
        qos=int(metadata.get("qos", "0")),
        retain=metadata.get("retain") == "1",
        retained=metadata.get("retained") == "1",
        payload_size_bytes=len(payload),
        payload_truncated=metadata.get(TRUNCATED) == "1",
        payload_b64=payload,
    )
    if text and len(payload) <= _TEXT_MOST:
        _add_text(line, payload)
    return line


def _add_text(line: _Written, payload: bytes) -> None:
    try:
        line.payload_text = payload.decode()
        line.payload_json = msgspec.json.decode(payload)
    except (UnicodeDecodeError, msgspec.DecodeError, RecursionError):
        pass


def _imported(number: int, line: bytes) -> Imported | BadLine:
    try:
        found = _decoder.decode(line)
        retained = found.retain if found.retained is None else found.retained
        return checked(
            Imported(
                _stamp_ns(bytes(found.timestamp)),
                found.topic,
                found.payload_b64,
                found.qos,
                found.retain,
                retained,
                found.payload_truncated,
            )
        )
    except (ValueError, OverflowError, RecursionError) as error:  # msgspec's and UnicodeDecodeError are ValueErrors
        return BadLine(number, str(error))


def _stamp_ns(stamp: bytes) -> int:
    """The time of a number, or of a text in ISO 8601, which is UTC unless it names another zone. Raises ValueError."""
    if not stamp.startswith(b'"'):
        try:
            return _epoch_ns(Decimal(stamp.decode()))
        except ArithmeticError:
            raise ValueError("the stamp is no number") from None
    moment = datetime.fromisoformat(msgspec.json.decode(stamp, type=str))
    moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    return (moment - _EPOCH) // _MICROSECOND * 1000


def _epoch_ns(stamp: Decimal) -> int:
    """Nanoseconds since 1970 of a stamp in seconds or milliseconds. Raises ValueError."""
    if not 0 <= stamp < _LATEST_NS // 1_000_000:  # false for NaN, too
        raise ValueError("the stamp is no time")
    return int(stamp * (10**6 if stamp >= _MILLISECONDS_FROM else 10**9))
