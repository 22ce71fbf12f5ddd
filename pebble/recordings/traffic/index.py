"""The index of recordings: one row per message, without payloads. It may be deleted: it is made again when needed.

Below ``ARCHIVE/index``, where every name is that of a recording in percent-encoding:

* ``day=2026-11-20/robot=pebble%2Frobots%2Fgoob/NAME.parquet``: the columns of :data:`COLUMNS`. Days are those of UTC.
  The robot ``_`` stands for all topics that belong to none, which are in ``metric`` as a whole.
* ``events/day=2026-11-20/NAME.parquet``: what the recorder noted about itself (``ts``, ``event``, ``since``, ``until``,
  ``json``).
* ``recordings/NAME.json``: which files were made from which state of the recording; written last.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import date, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

import msgspec

from pebble.contract.channels import HEARTBEAT, ONLINE
from pebble.contract.identity import parse_topic
from pebble.recordings.files.reader import RecordingFile
from pebble.recordings.files.recorded import Channel, Damage, Recorded, RecordingError
from pebble.recordings.library import ACTIVE, SUFFIX, files
from pebble.recordings.media_numbers import media_number
from pebble.recordings.recorder.intake import EVENTS
from pebble.recordings.traffic.activity import Activity, activity_of
from pebble.recordings.traffic.duck import connected, quoted

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

FOLDER: Final = "index"
#: The name that stands for all topics without a robot.
NO_ROBOT: Final = "_"
#: Of Parquet, with the types of DuckDB. Times are UTC.
COLUMNS: Final = {
    "ts": "TIMESTAMP_NS",  # received
    "stamp": "TIMESTAMP_NS",  # its own stamp
    "direction": "VARCHAR",  # incoming, outgoing
    "metric": "VARCHAR",
    "size": "UINTEGER",  # bytes of the payload
    "qos": "UTINYINT",
    "retain": "BOOLEAN",  # as published
    "retained": "BOOLEAN",  # an old message, which came after subscribing or was repeated in a new file
    "number": "UINTEGER",  # of media: frame, id or sequence
    "keyframe": "BOOLEAN",  # of pictures
    "kind": "UTINYINT",  # of media: media_numbers.NAMES
    "activity": "UTINYINT",  # activity.Activity
    "online": "BOOLEAN",  # of heartbeats: false in the last one
    "file": "VARCHAR",  # the recording
}
Advance = Callable[[float], None]

_FORMAT: Final = 1
_BATCH: Final = 50_000  # rows
_MEMORY_MB: Final = 128
_MAKING: Final = ".making-"
_ABANDONED_S: Final = 86_400.0
_LATEST_NS: Final = (1 << 63) - 1
_DAY_NS: Final = 86_400 * 10**9
_LONGEST_NAME: Final = 200  # bytes of a folder's name; file systems allow 255
_DATE: Final = re.compile(r"\d{2}|\d{4}", re.ASCII)
_OFFLINE: Final = re.compile(rb'"online"\s*:\s*false')
#: A row while it is collected; -1, and 0 for stamp and kind: none.
_ROW: Final = [
    ("channel", "u2"), ("ts", "i8"), ("stamp", "i8"), ("size", "u4"), ("number", "i8"), ("keyframe", "i1"),
    ("kind", "u1"), ("activity", "u1"), ("online", "i1"),
]  # fmt: skip
_TABLES: Final = """
    CREATE TABLE channels (channel USMALLINT, robot VARCHAR, direction VARCHAR, metric VARCHAR, qos UTINYINT,
                           retain BOOLEAN, retained BOOLEAN);
    CREATE TABLE rows (channel USMALLINT, ts BIGINT, stamp BIGINT, size UINTEGER, number BIGINT, keyframe TINYINT,
                       kind UTINYINT, activity UTINYINT, online TINYINT);
    CREATE TABLE events (ts BIGINT, event VARCHAR, since BIGINT, until BIGINT, json VARCHAR);
"""
_PARTS: Final = """
    SELECT robot, ts // $day_ns AS day, count(*) FROM rows JOIN channels USING (channel) GROUP BY ALL ORDER BY ALL
"""
_PART: Final = """
    SELECT make_timestamp_ns(ts) AS ts, make_timestamp_ns(nullif(stamp, 0)) AS stamp, direction, metric, size, qos,
           retain, retained, nullif(number, -1)::UINTEGER AS number, nullif(keyframe, -1)::BOOLEAN AS keyframe,
           nullif(kind, 0) AS kind, activity, nullif(online, -1)::BOOLEAN AS online, ? AS file
    FROM rows JOIN channels USING (channel)
    WHERE robot = ? AND ts >= ? AND ts < ? ORDER BY rows.ts, rows.rowid
"""
_EVENT_DAYS: Final = "SELECT DISTINCT ts // $day_ns FROM events ORDER BY 1"
_EVENTS: Final = """
    SELECT make_timestamp_ns(ts) AS ts, event, make_timestamp_ns(since) AS since, make_timestamp_ns(until) AS until,
           json
    FROM events WHERE ts >= ? AND ts < ? ORDER BY events.ts, events.rowid
"""


class Part(msgspec.Struct, frozen=True):
    """One Parquet file: the rows of a recording that are of one robot and day."""

    robot: str
    day: str
    path: str  # in the index
    rows: int


class Entry(msgspec.Struct, frozen=True):
    """What is known of one recording."""

    format: int
    recording: str  # its path in the archive
    size: int
    changed_ns: int
    rows: int
    missing: int  # messages that damage has taken
    parts: list[Part]
    events: list[str]  # Parquet files in the index
    unread: str | None = None  # what could not be read, in words; None: not known, of an older version


class Index:
    """The index of one archive; ``folder`` for one that is kept elsewhere. One process adds a recording at a time."""

    def __init__(self, archive: Path, folder: Path | None = None) -> None:
        self.archive = archive.resolve()
        self.folder = (folder or self.archive / FOLDER).resolve()

    def entry(self, recording: Path) -> Entry | None:
        """What is indexed of a recording; None if that is not how the file is now."""
        entry = _load(self._entry_path(recording))
        if entry is None or entry.format != _FORMAT or entry.unread is None:
            return None
        about = recording.stat()
        if (entry.recording, entry.size, entry.changed_ns) != (self._name(recording), about.st_size, about.st_mtime_ns):
            return None
        return entry if all((self.folder / path).exists() for path in _paths(entry)) else None

    def entries(self) -> Iterator[Entry]:
        """All that is indexed, also of recordings that have been deleted since."""
        for path in sorted((self.folder / "recordings").glob("*.json")):
            entry = _load(path)
            if entry is not None and entry.format == _FORMAT:
                yield entry

    def add(self, recording: Path, advance: Advance = lambda _share: None) -> Entry:
        """Index a recording, in whatever state it is, unless its entry is up to date.

        ``advance`` is called with the share of the file that is done. Raises RecordingError, OSError.
        """
        known = self.entry(recording)
        if known is not None:
            return known
        self.folder.mkdir(mode=0o750, parents=True, exist_ok=True)
        self._remove_leftovers()
        about = recording.stat()
        with (
            tempfile.TemporaryDirectory(dir=self.folder, prefix=_MAKING) as scratch,
            connected(Path(scratch), memory_mb=_MEMORY_MB) as connection,
        ):
            rows = _Rows(connection)
            damage = rows.read(recording, advance)
            unread = damage.report(active=recording.name.endswith(ACTIVE))
            making = _Making(self, connection, Path(scratch), self._name(recording), _key(self._name(recording)))
            entry = Entry(
                _FORMAT, self._name(recording), about.st_size, about.st_mtime_ns, rows.count, damage.missing,
                making.parts(), making.events(), unread,
            )  # fmt: skip
            self._delete_parts(recording, spared=_paths(entry))
            made = Path(scratch, "entry")
            made.write_bytes(msgspec.json.encode(entry))
            _move(made, self._entry_path(recording))
        return entry

    def remove(self, recording: Path) -> None:
        """Delete what is indexed of a recording."""
        self._delete_parts(recording, spared=[])
        self._entry_path(recording).unlink(missing_ok=True)

    def _remove_leftovers(self) -> None:
        """What was being made when a process was killed."""
        for folder in self.folder.glob(f"{_MAKING}*"):
            if time.time() - folder.stat().st_mtime > _ABANDONED_S:
                shutil.rmtree(folder, ignore_errors=True)

    def _delete_parts(self, recording: Path, spared: list[str]) -> None:
        entry = _load(self._entry_path(recording))
        for path in set() if entry is None else {*_paths(entry)} - {*spared}:
            (self.folder / path).unlink(missing_ok=True)

    def _name(self, recording: Path) -> str:
        recording = recording.resolve()
        inside = recording.is_relative_to(self.archive)
        return str(recording.relative_to(self.archive) if inside else recording)

    def _entry_path(self, recording: Path) -> Path:
        return self.folder / "recordings" / f"{_key(self._name(recording))}.json"


def not_indexed(archive: Path) -> list[Path]:
    """The finished recordings of an archive that are not in its index as they are now. Raises RecordingError."""
    index = Index(archive)
    return [path for path in files([archive]) if not path.name.endswith(ACTIVE) and index.entry(path) is None]


def archive_of(folder: Path) -> Path:
    """The folder that a recorder writes to, of one of its folders for a year, a month or a day."""
    folder = folder.resolve()
    while _DATE.fullmatch(folder.name):
        folder = folder.parent
    return folder


class _Rows:
    """Collects the rows of one recording in tables of DuckDB."""

    def __init__(self, connection: DuckDBPyConnection) -> None:
        connection.execute(_TABLES)
        self.count = 0
        self._connection = connection
        self._batch: list[tuple[int, ...]] = []
        self._activities: dict[int, Callable[[bytes], Activity]] = {}  # by channel
        self._heartbeats: set[int] = set()
        self._events: set[int] = set()

    def read(self, recording: Path, advance: Advance) -> Damage:
        """Returns what could not be read. Raises RecordingError."""
        with RecordingFile(recording) as file:
            damage, expected = file.damage, 0 if file.statistics is None else file.statistics.message_count
            for message in file.read():
                if message.log_ns <= _LATEST_NS:
                    self._add(message)
                else:
                    damage.missing += 1
                    damage.why = "times after 2262"
                if len(self._batch) >= _BATCH:
                    self._flush()
                    advance(min(1.0, self.count / expected) if expected else 0.5)
        self._flush()
        advance(1.0)
        return damage

    def _add(self, message: Recorded) -> None:
        channel, payload = message.channel.id, message.payload
        activity = self._activities.get(channel)
        if activity is None:
            activity = self._declare(message.channel)
        if channel in self._events:
            self._add_event(message)
        stamp = message.publish_ns if message.publish_ns <= _LATEST_NS else 0
        media = media_number(payload)
        if media is None:
            online = -1 if channel not in self._heartbeats else int(_OFFLINE.search(payload) is None)
            row = channel, message.log_ns, stamp, len(payload), -1, -1, 0, activity(payload), online
        else:
            kind, number, keyframe = media
            row = (
                channel, message.log_ns, stamp, len(payload), -1 if number is None else number,
                -1 if keyframe is None else int(keyframe), kind, Activity.MEDIA, -1,
            )  # fmt: skip
        self._batch.append(row)

    def _declare(self, channel: Channel) -> Callable[[bytes], Activity]:
        topic = parse_topic(channel.topic)
        if topic is None or len(quote(topic.identity.base, safe="")) > _LONGEST_NAME:
            robot, direction, metric = NO_ROBOT, "", channel.topic
        else:
            robot, direction, metric = topic.identity.base, str(topic.direction), topic.metric
        suffix = f"{direction}/{metric}"
        self._activities[channel.id] = activity_of(suffix)
        if suffix in (ONLINE.suffix, HEARTBEAT.suffix):
            self._heartbeats.add(channel.id)
        if channel.topic == EVENTS:
            self._events.add(channel.id)
        about = channel.metadata
        qos = {"1": 1, "2": 2}.get(about.get("qos", ""), 0)
        flags = [about.get(name, "0") not in ("", "0") for name in ("retain", "retained")]
        self._connection.execute(
            "INSERT INTO channels VALUES (?, ?, ?, ?, ?, ?, ?)", [channel.id, robot, direction, metric, qos, *flags]
        )
        return self._activities[channel.id]

    def _add_event(self, message: Recorded) -> None:
        try:
            event = msgspec.json.decode(message.payload, type=_Event)
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return
        since, until = (None if ms is None else int(ms * 1e6) for ms in (event.since, event.until))
        self._connection.execute(
            "INSERT INTO events VALUES (?, ?, ?, ?, ?)",
            [message.log_ns, event.event, since, until, message.payload.decode()],
        )

    def _flush(self) -> None:
        import numpy as np

        if not self._batch:
            return
        batch = np.array(self._batch, dtype=_ROW)
        columns: dict[str, Any] = {name: np.ascontiguousarray(batch[name]) for name, _ in _ROW}
        self._connection.register("batch", columns)
        self._connection.execute("INSERT INTO rows SELECT * FROM batch")
        self._connection.unregister("batch")
        self.count += len(self._batch)
        self._batch.clear()


class _Event(msgspec.Struct):
    """An event of the recorder; ``since`` and ``until`` in milliseconds since 1970."""

    event: str
    since: float | None = None
    until: float | None = None


class _Making:
    """Writes the Parquet files of one recording."""

    def __init__(self, index: Index, connection: DuckDBPyConnection, scratch: Path, name: str, key: str) -> None:
        self._folder, self._connection, self._scratch = index.folder, connection, scratch
        self._name, self._key = name, key

    def parts(self) -> list[Part]:
        found = []
        for robot, day, rows in self._connection.execute(_PARTS, {"day_ns": _DAY_NS}).fetchall():
            path = f"day={_date(day)}/robot={quote(robot, safe='')}/{self._key}.parquet"
            self._copy(_PART, [self._name, robot, *_bounds(day)], path)
            found.append(Part(robot, _date(day), path, rows))
        return found

    def events(self) -> list[str]:
        found = []
        for (day,) in self._connection.execute(_EVENT_DAYS, {"day_ns": _DAY_NS}).fetchall():
            found.append(f"events/day={_date(day)}/{self._key}.parquet")
            self._copy(_EVENTS, _bounds(day), found[-1])
        return found

    def _copy(self, query: str, parameters: list[Any], path: str) -> None:
        made = self._scratch / "part.parquet"
        self._connection.execute(f"COPY ({query}) TO {quoted(made)} (FORMAT parquet, COMPRESSION zstd)", parameters)
        _move(made, self._folder / path)


def _move(made: Path, path: Path) -> None:
    """Put a finished file at its place, durably."""
    with made.open("rb") as file:
        os.fsync(file.fileno())
    path.parent.mkdir(parents=True, exist_ok=True)
    made.replace(path)


def _key(name: str) -> str:
    key = quote(name.removesuffix(".active").removesuffix(SUFFIX), safe="")
    return key if len(key) <= _LONGEST_NAME else hashlib.sha256(key.encode()).hexdigest()


def _paths(entry: Entry) -> list[str]:
    return [*(part.path for part in entry.parts), *entry.events]


def _load(path: Path) -> Entry | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Entry)
    except (FileNotFoundError, msgspec.MsgspecError, UnicodeDecodeError):
        return None
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from None


def _date(day: int) -> str:
    return str(date(1970, 1, 1) + timedelta(days=day))


def _bounds(day: int) -> list[int]:
    return [day * _DAY_NS, min((day + 1) * _DAY_NS, _LATEST_NS)]
