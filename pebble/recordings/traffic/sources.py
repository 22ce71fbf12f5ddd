"""Finds the index of recordings for an analysis, and makes what is missing of it."""

import os
from collections.abc import Callable, Collection, Iterable
from datetime import UTC, datetime
from pathlib import Path

from msgspec import Struct, field

from pebble.recordings.files.recorded import RecordingError
from pebble.recordings.library import ACTIVE, files
from pebble.recordings.recorder.folder import finished_path
from pebble.recordings.traffic.index import FOLDER, NO_ROBOT, Entry, Index, archive_of

#: Called with what is done now, and the share of all that is done.
Progress = Callable[[str, float], None]


class Sources(Struct):
    """Parquet files to analyse."""

    parts: dict[str, list[Path]] = field(default_factory=dict)  # by robot
    events: list[Path] = field(default_factory=list)
    recordings: int = 0
    missing: int = 0  # messages that damage has taken
    robots: set[str] = field(default_factory=set)  # all in these recordings, also those that were not chosen
    unread: list[str] = field(default_factory=list)  # a line for each file that could not be read completely

    def add(self, index: Index, entry: Entry, chosen: Collection[str], days: tuple[str, str]) -> None:
        """Take over what an index holds of one recording, as far as it belongs to the robots and days."""
        if entry.unread:
            self.unread.append(f"{entry.recording}: {entry.unread}")
        self.events += [index.folder / path for path in entry.events]
        of_robots = [part for part in entry.parts if part.robot != NO_ROBOT]
        self.robots.update(part.robot for part in of_robots)
        parts = [part for part in of_robots if days[0] <= part.day <= days[1]]
        parts = [part for part in parts if not chosen or part.robot in chosen]
        for part in parts:
            self.parts.setdefault(part.robot, []).append(index.folder / part.path)
        if parts:
            self.recordings += 1
            self.missing += entry.missing


def sources(
    places: Iterable[Path],
    scratch: Path,
    *,
    robots: Collection[str] = (),
    since_ns: int,
    until_ns: int,
    progress: Progress = lambda _what, _share: None,
) -> Sources:
    """The index of all recordings in ``places``, files or folders; ``robots``: all, unless some are named.

    What is not indexed yet is indexed now: below the archive if that can be written, else, as for files that are still
    being written, below ``scratch``. In a folder, recordings count that were deleted after they had been indexed.
    Raises RecordingError.
    """
    found, days = Sources(), (_day(since_ns), _day(until_ns - 1))
    seen: set[Path] = set()
    for place in places:
        collecting = _Collecting(place, scratch, seen, progress)
        for index, entry in collecting.entries():
            found.add(index, entry, robots, days)
    return found


class _Share(Struct, frozen=True):
    """The part of all work that one file is."""

    before: float
    own: float

    def of(self, done: float) -> float:
        return self.before + done * self.own


class _Collecting:
    """The recordings of one place."""

    def __init__(self, place: Path, scratch: Path, seen: set[Path], progress: Progress) -> None:
        self._place, self._seen, self._progress = place.resolve(), seen, progress
        archive = archive_of(place if place.is_dir() else place.resolve().parent)
        self._temporary = Index(archive, scratch / f"index-{len(seen)}")
        self._index = Index(archive)
        lasting = place.is_dir() or self._index.folder.is_dir()
        if not lasting or not os.access(archive / FOLDER if self._index.folder.is_dir() else archive, os.W_OK):
            self._index = self._temporary

    def entries(self) -> Iterable[tuple[Index, Entry]]:
        deleted = list(self._deleted())
        try:
            paths = self._new(files([self._place]))
        except RecordingError:
            if not deleted:
                raise
            paths = []
        yield from deleted
        sizes = [path.stat().st_size if path.exists() else 0 for path in paths]
        done, total = 0, max(1, sum(sizes))
        for path, size in zip(paths, sizes, strict=True):
            added = self._add(path, _Share(done / total, size / total))
            done += size
            if added is not None:
                yield added

    def _new(self, paths: list[Path]) -> list[Path]:
        """Those that no earlier place held."""
        new = [path for path in dict.fromkeys(path.resolve() for path in paths) if path not in self._seen]
        self._seen.update(new)
        return new

    def _add(self, path: Path, part: _Share) -> tuple[Index, Entry] | None:
        """None for a file that has been deleted meanwhile."""
        index = self._temporary if path.name.endswith(ACTIVE) else self._index
        try:
            return index, index.add(path, lambda share: self._progress(f"index {path.name}", part.of(share)))
        except FileNotFoundError:
            if not path.name.endswith(ACTIVE) or not finished_path(path).exists():
                return None
            return self._add(finished_path(path), part)  # its recorder finished it a moment ago
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from None

    def _deleted(self) -> Iterable[tuple[Index, Entry]]:
        """What is indexed of recordings that are not there any more."""
        if self._place.is_dir():
            for entry in self._index.entries():
                path = self._index.archive / entry.recording
                if path not in self._seen and path.is_relative_to(self._place) and not path.exists():
                    self._seen.add(path)
                    yield self._index, entry


def _day(ns: int) -> str:
    return datetime.fromtimestamp(max(0, ns) // 10**9, UTC).strftime("%Y-%m-%d")
