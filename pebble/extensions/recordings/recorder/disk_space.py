"""Chooses the recordings to delete for new ones. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass

from pebble.extensions.recordings.recorder.folder import Entry
from pebble.extensions.recordings.recorder.settings import Options

_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Disk:
    """The file system of the recordings' folder."""

    free_bytes: int
    has_inodes: bool = True
    size_bytes: int = 1 << 60

    def wanted_bytes(self, options: Options) -> int:
        """Return how much must stay free: a tenth of a small disk, and nothing of a share that tells no sizes."""
        return min(options.free_bytes, self.size_bytes // 10)


def surplus(entries: Iterable[Entry], options: Options, disk: Disk) -> list[Entry]:
    """Return the files to delete now: the oldest first, pictures and sound before state.

    Files that are being written are never among them. Nor are damaged ones, which may hold what could not be read yet;
    they do not count towards ``keep_bytes``. The newest file of each kind stays.
    """
    listed = [entry for entry in entries if entry.is_active or entry.is_finished]
    used, free, has_inodes = sum(entry.size for entry in listed), disk.free_bytes, disk.has_inodes
    deleted = []
    for entry in _deletable(listed):
        is_too_much = options.keep_bytes and used > options.keep_bytes
        if not is_too_much and free >= disk.wanted_bytes(options) and has_inodes:
            break
        deleted.append(entry)
        used -= entry.size
        free += entry.size
        has_inodes = True  # that of the deleted file
    return deleted


def outdated(entries: Iterable[Entry], options: Options, now: float) -> Entry | None:
    """Return a file of pictures and sound that is too old, or None.

    Only one, and the caller asks once a minute: a clock that is set wrong for a while costs few files.
    """
    if not options.keep_media_days:
        return None
    oldest = now - options.keep_media_days * _DAY_S
    return next((entry for entry in _deletable(list(entries)) if entry.is_media and entry.ended < oldest), None)


def _deletable(entries: list[Entry]) -> list[Entry]:
    """Return the files that may be deleted, the first to delete first."""
    finished = sorted((entry for entry in entries if entry.is_finished), key=lambda entry: entry.number)
    media = [entry for entry in finished if entry.is_media]
    state = [entry for entry in finished if not entry.is_media]
    return media[:-1] + state[:-1]
