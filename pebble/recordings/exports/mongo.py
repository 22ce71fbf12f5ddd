"""MongoDB archives of the original's operator page, as mongodump writes them, and back: one document at a time.

A ``.bson`` file is documents one after the other, each behind its length (https://bsonspec.org). The operator page
stores a message as ``{ts, topic, qos, retain, payload, payload_size, payload_truncated}``, with at most 15 MB of the
payload; ``retained`` is ours, see ``pebble.recordings.exports.lines``. A date of BSON has milliseconds.
"""

import gzip
import importlib
import struct
import zlib
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO, Final, NoReturn, cast

from pebble.errors import PebbleError
from pebble.recordings.exports.lines import TRUNCATED, BadLine, Imported, Progress, checked, epoch_ns
from pebble.recordings.files.recorded import Recorded

_MOST_PAYLOAD: Final = 15_000_000
_LARGEST: Final = (16 << 20) + (16 << 10)  # bytes of a document: what MongoDB's server itself takes
_LENGTH: Final = struct.Struct("<i")  # of the whole document, with these four bytes and a zero at its end
_SMALLEST: Final = 5
_GZIP: Final = b"\x1f\x8b"


def write_mongo(messages: Iterable[Recorded], out: BinaryIO, *, on_time: Progress | None = None) -> int:
    """Write a document for each message, for mongorestore; returns how many. Raises PebbleError without pymongo."""
    bson = _bson()
    count = 0
    for message in messages:
        out.write(bson.encode(_document(bson, message)))
        count += 1
        if on_time is not None:
            on_time(message.log_ns)
    return count


def read_mongo(file: BinaryIO) -> Iterator[Imported | BadLine]:
    """The messages of a dump, in its order; also of one that mongodump has compressed.

    Documents that are no messages are yielded as such. A length that cannot be true ends the file, because the next
    document cannot be found. Raises PebbleError without pymongo.
    """
    bson = _bson()
    options = bson.codec_options.CodecOptions(datetime_conversion=bson.codec_options.DatetimeConversion.DATETIME_MS)
    for number, document in enumerate(_documents(file), 1):
        if isinstance(document, str):
            yield BadLine(number, document)
            continue
        try:
            yield _imported(bson, bson.decode(document, options))
        except (ValueError, TypeError, OverflowError, bson.errors.BSONError) as error:
            yield BadLine(number, str(error))


def _bson() -> Any:
    """pymongo's package of this name; there is another one on PyPI."""
    try:
        importlib.import_module("bson.codec_options")
        importlib.import_module("bson.datetime_ms")
        return importlib.import_module("bson")
    except ImportError as error:
        raise PebbleError(f'MongoDB\'s format needs pymongo: pip install "pebble-robot[mongo]" ({error})') from None


def _document(bson: Any, message: Recorded) -> dict[str, Any]:
    metadata, payload = message.channel.metadata, message.payload
    return {
        "ts": bson.datetime_ms.DatetimeMS(message.log_ns // 1_000_000),
        "topic": message.channel.topic,
        "qos": int(metadata.get("qos", "0")),
        "retain": metadata.get("retain") == "1",
        "retained": metadata.get("retained") == "1",
        "payload": payload[:_MOST_PAYLOAD],
        "payload_size": len(payload),
        "payload_truncated": len(payload) > _MOST_PAYLOAD or metadata.get(TRUNCATED) == "1",
    }


def _documents(file: BinaryIO) -> Iterator[bytes | str]:
    """The documents of ``file``; at its end perhaps what is wrong there."""
    try:
        file = _plain(file)
        while head := file.read(_LENGTH.size):
            size = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
            if not _SMALLEST <= size <= _LARGEST:
                yield "no document: the rest of the file cannot be read"
                return
            body = file.read(size - _LENGTH.size)
            if len(body) < size - _LENGTH.size:
                yield "cut off"
                return
            yield head + body
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        yield f"the compressed file is damaged: {error}"


def _plain(file: BinaryIO) -> BinaryIO:
    begin = file.read(len(_GZIP))
    file.seek(-len(begin), 1)
    return cast(BinaryIO, gzip.GzipFile(fileobj=file)) if begin == _GZIP else file


def _imported(bson: Any, document: dict[str, Any]) -> Imported:
    """Raises ValueError."""
    topic, qos, retain = document.get("topic"), document.get("qos", 0), document.get("retain", False)
    retained = document.get("retained", retain)
    if not isinstance(topic, str):
        _refuse("topic")
    if qos not in (0, 1, 2):
        _refuse("qos")
    if not isinstance(retain, bool) or not isinstance(retained, bool):
        _refuse("retain")
    truncated = bool(document.get("payload_truncated", False))
    log_ns, payload = _stamp_ns(bson, document.get("ts")), _payload(document.get("payload"))
    return checked(Imported(log_ns, topic, payload, int(qos), retain, retained, truncated))


def _stamp_ns(bson: Any, stamp: Any) -> int:
    """The time of a date, or of a number of seconds or milliseconds. Raises ValueError."""
    if isinstance(stamp, bson.datetime_ms.DatetimeMS):
        return int(stamp) * 1_000_000
    if isinstance(stamp, int | float) and not isinstance(stamp, bool):
        return epoch_ns(stamp)
    return _refuse("ts")


def _payload(payload: Any) -> bytes:
    if payload is None:
        return b""
    if isinstance(payload, str):
        return payload.encode()
    if isinstance(payload, bytes):
        return bytes(payload)  # a Binary is one, with a subtype
    return _refuse("payload")


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is missing, or not what a message has")
