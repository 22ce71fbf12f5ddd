"""Functions with which a second process answers questions about recordings. They take and return plain data.

That process (:class:`pebble.extensions.page.recordings.archive_process.ArchiveProcess`) has one archive. In the page
server's own process, reading files would delay the loop that passes on drive commands.
"""

from __future__ import annotations

import errno
import os
import signal
import tempfile
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

import msgspec

from pebble.errors import PebbleError
from pebble.extensions.recordings.exports.film import write_film
from pebble.extensions.recordings.exports.unfinished import unfinished
from pebble.extensions.recordings.files.recorded import ACTIVE
from pebble.extensions.recordings.files.rewrite import write_copy
from pebble.extensions.recordings.library import Damages, merged, problems, reported, robot_of
from pebble.extensions.recordings.seek.archive import Archive
from pebble.extensions.recordings.seek.days import Days
from pebble.extensions.recordings.traffic.timeline import timeline as make_timeline
from pebble.runtime.parent import end_with_parent

FILMS: Final = frozenset({"mkv", "mp4"})
_LONGEST_WHY: Final = 500  # characters: a message is sent as a whole
_NICE: Final = 10  # driving comes first
_ALIVE_S: Final = 5.0  # between two signs of life of a job
_ACCESS: Final = "give the user of this server access to it"
_ROOM: Final = "make room on its disk"
_MENDS: Final = {
    errno.ENOSPC: _ROOM,
    errno.EDQUOT: _ROOM,
    errno.EACCES: _ACCESS,
    errno.EPERM: _ACCESS,
    errno.EROFS: _ACCESS,
    errno.EISDIR: "move it away",
    errno.EIO: "look at the disk (dmesg)",
}
_archive: Archive
_days: Days


def begin(folder: Path) -> None:
    """Prepare this process for questions about the recordings in ``folder``."""
    global _archive, _days
    _in_background()
    _archive = Archive(folder)
    _days = Days(_archive)


def days() -> bytes:
    """Return the archive's days as JSON."""
    return msgspec.json.encode(_days.all())


def files(robot: str, since_ns: int, until_ns: int) -> tuple[list[str], bool]:
    """Return a robot's recordings in a period, and whether one is still being written."""
    paths = [str(file.path) for file in _archive.files(robot, since_ns, until_ns)]
    return paths, any(path.endswith(ACTIVE) for path in paths)


# -- jobs, each in a process of its own: they take long


def make_timeline_job(answer: Connection, paths: list[str], target: Path, robot: str, period: tuple[int, int]) -> None:
    """Index recordings that have no index, and write the timeline to ``target`` as JSON."""
    _in_background()

    def work() -> str:
        places, progress = [Path(path) for path in paths], _Progress(answer)
        with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
            timeline = make_timeline(places, Path(scratch), robot, *period, progress.share)
        target.write_bytes(msgspec.json.encode(timeline))
        return ""

    answer_with(answer, work)


def export_job(
    answer: Connection, paths: list[str], target: Path, robot: str, period: tuple[int, int], form: str
) -> None:
    """Write a period as a film or as MCAP to ``target``."""
    _in_background()
    since_ns, until_ns = period

    def work() -> str:
        damages = Damages()
        read = partial(
            merged,
            [Path(path) for path in paths],
            since_ns=since_ns,
            until_ns=until_ns,
            chooses=lambda channel: robot_of(channel.topic) == robot,
            damages=damages,
        )
        progress = _Progress(answer)

        def on_time(log_ns: int) -> None:
            progress.share("", (log_ns - since_ns) / (until_ns - since_ns))

        if form in FILMS:
            write_film(read, target, robot, on_time=on_time)
        else:
            with unfinished(target) as path, path.open("wb") as out:
                if not write_copy(reported(read(), on_time), out):
                    raise PebbleError(f"there is no message of {robot} in this stretch")
        return "; ".join(problems(damages))

    answer_with(answer, work)


class _Progress:
    """A sender of how much of the work is done: in steps of a percent, and as a sign of life."""

    def __init__(self, answer: Connection) -> None:
        self._answer, self._sent, self._sent_at = answer, -1, 0.0

    def share(self, _what: str, share: float) -> None:
        percent, now = int(100 * max(0.0, min(1.0, share))), time.monotonic()
        if percent > self._sent or now - self._sent_at > _ALIVE_S:
            self._sent, self._sent_at = max(percent, self._sent), now
            self._answer.send(("done", self._sent / 100))


def answer_with(answer: Connection, work: Callable[[], str]) -> None:
    """Do a job's ``work``; answer "ready", with the damage in words that ``work`` returns, or "failed" and why."""
    try:
        answer.send(("ready", work()[:_LONGEST_WHY]))
    except Exception as error:
        answer.send(("failed", reason(error)))
        if not isinstance(error, (PebbleError, OSError, ImportError)):
            raise  # its traceback is for the log


def reason(error: Exception) -> str:
    """Return the problem and what to do, in one line."""
    match error:
        case PebbleError():
            words = str(error)
        case ImportError():
            words = f'{error.name or error} is missing: pip install "pebble-robot[archive,media]"'
        case MemoryError():
            words = "there is too little memory: end other programs, or choose less"
        case OSError():
            words = f"{error.filename or 'a file'}: {error.strerror or error}"
            if error.errno in _MENDS:
                words += f"; {_MENDS[error.errno]}"
        case _:
            words = f"{type(error).__name__}: {error}; the log of the server says where"
    return words.partition("\n")[0][:_LONGEST_WHY]


def _in_background() -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal reaches the whole group: the parent ends this
    os.nice(_NICE)
