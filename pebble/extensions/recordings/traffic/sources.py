"""The indexes for an analysis: existing ones, and new ones for recordings without."""
# ruff: noqa: S608  (what is put into queries are names of files in quotes)

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec import Struct, field

from pebble.errors import PebbleError
from pebble.extensions.recordings.files.recorded import ACTIVE, present_path
from pebble.extensions.recordings.library import files
from pebble.extensions.recordings.traffic.duck import connected, parquet
from pebble.extensions.recordings.traffic.index import INDEX, about, index_path, is_of, write_index
from pebble.runtime.as_owner import require_own

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

#: Called with the name of the present step, and how much of the whole work is done (0 to 1).
Progress = Callable[[str, float], None]

_MEMORY_MB: Final = 128


class Sources(Struct):
    """The indexes of recordings, with what they contain."""

    indexes: list[Path] = field(default_factory=list)
    robots: list[str] = field(default_factory=list)
    missing: int = 0  # messages that damage has taken
    unread: list[str] = field(default_factory=list)  # a line for each file that could not be read completely


def sources(places: Iterable[Path], scratch: Path, progress: Progress = lambda _what, _share: None) -> Sources:
    """Return the indexes of all recordings in ``places``, files or folders.

    Missing indexes are made: beside the recording if its folder can be written, otherwise, as for files that are still
    being written, below ``scratch``. Raises RecordingError.
    """
    indexed = Sources()
    scratch.mkdir(parents=True, exist_ok=True)
    with connected(scratch, memory_mb=_MEMORY_MB) as connection:
        for path in _indexes(places, scratch, connection, progress):
            facts = about(path, connection)
            if facts is not None:
                indexed.indexes.append(path)
                indexed.missing += facts.missing
                if facts.unread:
                    indexed.unread.append(f"{facts.recording}: {facts.unread}")
        if indexed.indexes:
            names = f"SELECT DISTINCT robot FROM {parquet(indexed.indexes)} WHERE robot <> '' ORDER BY robot"
            indexed.robots = [robot for (robot,) in connection.execute(names).fetchall()]
    return indexed


def _indexes(
    places: Iterable[Path], scratch: Path, connection: DuckDBPyConnection, progress: Progress
) -> Iterator[Path]:
    """Yield the index of each recording; progress counts their bytes."""
    paths = list(dict.fromkeys(path.resolve() for path in files(places)))
    sizes = [path.stat().st_size if path.exists() else 0 for path in paths]
    done, total = 0, max(1, sum(sizes))
    for number, (path, size) in enumerate(zip(paths, sizes, strict=True)):
        advance = partial(_report, progress, path.name, done / total, size / total)
        index = _index(path, scratch / f"{number}{INDEX}", connection, advance)
        done += size
        if index is not None:
            yield index


def _report(progress: Progress, name: str, before: float, part: float, share: float) -> None:
    progress(f"index {name}", before + share * part)


def _index(path: Path, spare: Path, connection: DuckDBPyConnection, advance: Callable[[float], None]) -> Path | None:
    """Return a recording's index, made if it is missing; None if the recording has been deleted.

    ``spare``: its path where it cannot be beside the recording.
    """
    recording = present_path(path)
    if recording is None:
        return None
    is_active = recording.name.endswith(ACTIVE)
    index = index_path(recording)
    if not is_active and is_of(index, recording, connection):
        return index
    if is_active or not _may_write(recording.parent):
        index = spare
    write_index(recording, index, spare.parent, advance)
    return index


def _may_write(folder: Path) -> bool:
    try:
        require_own(folder)
    except PebbleError:
        return False
    return os.access(folder, os.W_OK, effective_ids=os.access in os.supports_effective_ids)
