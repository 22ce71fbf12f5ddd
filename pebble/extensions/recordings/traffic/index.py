"""The index of a recording: a row for each message, without payloads, in ``NAME.parquet`` beside ``NAME.mcap``.

It may be deleted: it is made again when needed. :data:`COLUMNS` lists its columns; its rows are ordered by robot and
time. Its metadata (``parquet_kv_metadata``) hold the state of the recording from which it was made.
"""
# ruff: noqa: S608  (what is put into queries are names of files and texts, in quotes)

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from pebble.contract.channels import HEARTBEAT, ONLINE
from pebble.contract.identity import parse_topic
from pebble.extensions.media.packets import PBAT
from pebble.extensions.recordings.files.reader import RecordingFile
from pebble.extensions.recordings.files.recorded import SUFFIX, Channel, Recorded
from pebble.extensions.recordings.recorder.intake import EVENTS
from pebble.extensions.recordings.stamps import is_picture
from pebble.extensions.recordings.traffic.activity import Activity, activity_of
from pebble.extensions.recordings.traffic.duck import connected, quoted

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

INDEX: Final = ".parquet"
#: With the types of DuckDB. Times are UTC.
COLUMNS: Final = {
    "ts": "TIMESTAMP_NS",  # received
    "stamp": "TIMESTAMP_NS",  # its own stamp
    "robot": "VARCHAR",  # system/type/id; empty: it belongs to none, and its whole topic is in metric
    "direction": "VARCHAR",  # incoming, outgoing
    "metric": "VARCHAR",
    "size": "UINTEGER",  # bytes of the payload
    "qos": "UTINYINT",
    "retain": "BOOLEAN",  # as published
    "retained": "BOOLEAN",  # an old message, which came after subscribing or was repeated in a new file
    "medium": "UTINYINT",  # PICTURE, SOUND; NULL: neither
    "activity": "UTINYINT",  # activity.Activity
    "online": "BOOLEAN",  # of heartbeats: false in the last one
    "event": "VARCHAR",  # JSON: what the recorder noted about itself
}
PICTURE, SOUND = 1, 2
Advance = Callable[[float], None]

_BATCH: Final = 50_000  # rows
_MEMORY_MB: Final = 128
_LATEST_NS: Final = (1 << 63) - 1
_OFFLINE: Final = re.compile(rb'"online"\s*:\s*false')
#: A row while it is collected. No value is -1 in ``online``, and 0 in ``stamp`` and ``medium``.
_ROW: Final = [
    ("channel", "u2"), ("ts", "i8"), ("stamp", "i8"), ("size", "u4"), ("medium", "u1"), ("activity", "u1"),
    ("online", "i1"),
]  # fmt: skip
_TABLES: Final = """
    CREATE TABLE channels (channel USMALLINT, robot VARCHAR, direction VARCHAR, metric VARCHAR, qos UTINYINT,
                           retain BOOLEAN, retained BOOLEAN);
    CREATE TABLE rows (channel USMALLINT, ts BIGINT, stamp BIGINT, size UINTEGER, medium UTINYINT, activity UTINYINT,
                       online TINYINT);
    CREATE TABLE events (ts BIGINT, event VARCHAR);
"""
_COPY: Final = """
    COPY (
        SELECT make_timestamp_ns(ts) AS ts, make_timestamp_ns(nullif(stamp, 0)) AS stamp, robot, direction, metric,
               size, qos, retain, retained, nullif(medium, 0) AS medium, activity,
               nullif(online, -1)::BOOLEAN AS online, NULL::VARCHAR AS event
        FROM rows JOIN channels USING (channel)
        UNION ALL BY NAME
        SELECT make_timestamp_ns(ts) AS ts, '' AS robot, event FROM events
        ORDER BY robot, ts
    ) TO {path} (FORMAT parquet, COMPRESSION zstd, KV_METADATA {about})
"""


class About(Struct):
    """The facts about a recording that its index holds."""

    recording: str  # its name
    size: int  # of the file, when it was indexed
    changed_ns: int
    missing: int  # messages that damage has taken
    unread: str  # what could not be read, in words; "" if all was


def index_path(recording: Path) -> Path:
    return recording.with_name(recording.name.removesuffix(".active").removesuffix(SUFFIX) + INDEX)


def about(index: Path, connection: DuckDBPyConnection) -> About | None:
    """Return the facts in an index; None if the file is not ours. Raises RecordingError if it cannot be read."""
    metadata = dict(connection.execute(f"SELECT key, value FROM parquet_kv_metadata({quoted(index)})").fetchall())
    try:
        texts = {key.decode(): value.decode() for key, value in metadata.items()}
        size, changed_ns, missing = (int(texts[name]) for name in ("size", "changed_ns", "missing"))
        return About(texts["recording"], size, changed_ns, missing, texts["unread"])
    except (KeyError, ValueError):
        return None


def is_of(index: Path, recording: Path, connection: DuckDBPyConnection) -> bool:
    """True if the index was made from the recording in its present state."""
    if not index.is_file():
        return False
    facts, now = about(index, connection), recording.stat()
    return facts is not None and (facts.size, facts.changed_ns) == (now.st_size, now.st_mtime_ns)


def write_index(recording: Path, index: Path, scratch: Path, advance: Advance = lambda _share: None) -> None:
    """Index a recording in any state.

    ``advance`` is called with how much of the file is done (0 to 1). Raises RecordingError, OSError.
    """
    state = recording.stat()
    part = index.with_name(f".{index.name}.{os.getpid()}")
    with connected(scratch, memory_mb=_MEMORY_MB) as connection:
        rows = _Rows(connection)
        missing, unread = rows.read(recording, advance)
        facts = About(recording.name, state.st_size, state.st_mtime_ns, missing, unread)
        pairs = ", ".join(f"{name}: {quoted(getattr(facts, name))}" for name in About.__struct_fields__)
        about = "{" + pairs + "}"  # as DuckDB writes a struct
        try:
            connection.execute(_COPY.format(path=quoted(part), about=about))
            part.replace(index)
        finally:
            part.unlink(missing_ok=True)


class _Rows:
    """The rows of a recording, collected in tables of DuckDB."""

    def __init__(self, connection: DuckDBPyConnection) -> None:
        connection.execute(_TABLES)
        self._connection = connection
        self._count = 0  # of rows in the tables
        self._batch: list[tuple[int, ...]] = []  # rows that are not in the tables yet
        self._activities: dict[int, Callable[[bytes], Activity]] = {}  # by channel
        self._heartbeats: set[int] = set()  # the channels with heartbeats

    def read(self, recording: Path, advance: Advance) -> tuple[int, str]:
        """Read the recording; return how many messages the index lacks, and why. Raises RecordingError."""
        with RecordingFile(recording) as file:
            damage, expected = file.damage, 0 if file.statistics is None else file.statistics.message_count
            for message in file.read():
                if message.log_ns > _LATEST_NS:
                    damage.missing += 1  # the index cannot store it
                    damage.why = "times after 2262"
                elif message.channel.topic == EVENTS:
                    self._add_event(message)
                else:
                    self._add(message)
                if len(self._batch) >= _BATCH:
                    self._flush()
                    advance(min(1.0, self._count / expected) if expected else 0.5)
            unread = file.problem  # the damage in words
        self._flush()
        advance(1.0)
        return damage.missing, unread

    def _add(self, message: Recorded) -> None:
        channel, payload = message.channel.id, message.payload
        activity = self._activities.get(channel)
        if activity is None:
            activity = self._declare(message.channel)
        stamp = message.publish_ns if message.publish_ns <= _LATEST_NS else 0  # later ones cannot be stored
        medium, online = 0, -1  # of no media, and no heartbeat
        if payload.startswith(PBAT):
            medium = SOUND
        elif is_picture(payload):
            medium = PICTURE
        elif channel in self._heartbeats:
            online = int(_OFFLINE.search(payload) is None)
        shown = Activity.MEDIA if medium else activity(payload)  # the use of the robot that it shows
        self._batch.append((channel, message.log_ns, stamp, len(payload), medium, shown, online))

    def _declare(self, channel: Channel) -> Callable[[bytes], Activity]:
        """Add a channel to the table of channels; return the function that finds the activity in a payload."""
        topic = parse_topic(channel.topic)
        robot, direction, metric = "", "", channel.topic
        if topic is not None:
            robot, direction, metric = topic.identity.base, str(topic.direction), topic.metric
        suffix = f"{direction}/{metric}"
        self._activities[channel.id] = activity_of(suffix)
        if suffix in (ONLINE.suffix, HEARTBEAT.suffix):
            self._heartbeats.add(channel.id)
        metadata = channel.metadata
        qos = {"1": 1, "2": 2}.get(metadata.get("qos", ""), 0)
        flags = [metadata.get(name, "0") not in ("", "0") for name in ("retain", "retained")]  # see COLUMNS
        self._connection.execute(
            "INSERT INTO channels VALUES (?, ?, ?, ?, ?, ?, ?)", [channel.id, robot, direction, metric, qos, *flags]
        )
        return self._activities[channel.id]

    def _add_event(self, message: Recorded) -> None:
        try:
            text = message.payload.decode()
        except UnicodeDecodeError:
            return
        self._connection.execute("INSERT INTO events VALUES (?, ?)", [message.log_ns, text])

    def _flush(self) -> None:
        import numpy as np

        if not self._batch:
            return
        batch = np.array(self._batch, dtype=_ROW)
        columns: dict[str, Any] = {name: np.ascontiguousarray(batch[name]) for name, _ in _ROW}
        self._connection.register("batch", columns)
        self._connection.execute("INSERT INTO rows SELECT * FROM batch")
        self._connection.unregister("batch")
        self._count += len(self._batch)
        self._batch.clear()
