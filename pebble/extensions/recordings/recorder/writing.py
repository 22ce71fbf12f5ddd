"""The work of the recorder's writer thread: it writes messages, deletes files for room, and waits without room."""

import errno
import logging
import os
from collections import Counter
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import Final, NamedTuple

from pebble.errors import PebbleError
from pebble.extensions.recordings.recorder.background import Background
from pebble.extensions.recordings.recorder.clock import Due, RecordingClock
from pebble.extensions.recordings.recorder.disk_space import Disk, outdated, surplus
from pebble.extensions.recordings.recorder.finisher import Finisher
from pebble.extensions.recordings.recorder.folder import STATE, Folder
from pebble.extensions.recordings.recorder.intake import EVENTS, FORGET, Intake
from pebble.extensions.recordings.recorder.lane import Item, OpenFile
from pebble.extensions.recordings.recorder.open_files import OpenFiles
from pebble.extensions.recordings.recorder.settings import Options
from pebble.runtime.rate_limit import RateLimitedLog

log = logging.getLogger(__name__)

ROTATE_BYTES: Final = 512 << 20  # of one file
_SPACE_S: Final = 2.0  # between two looks at the disk
_LISTED_S: Final = 60.0  # between two looks at all files
_AGE_S: Final = 60.0  # between two files that are deleted for their age
_IDLE_NS: Final = 60 * 10**9  # a robot's media file without pictures is finished after this
_INDEX: Final = ".parquet"  # which an analysis has made beside a file
_when = attrgetter("boot_ns")
_FULL: Final = (errno.ENOSPC, errno.EDQUOT)


class _Blocked(NamedTuple):
    """A time in which no file can be written, and the reason."""

    why: str
    since_ns: int
    dropped: int  # messages until then
    is_full: bool  # the disk


class Context(NamedTuple):
    """The objects that the parts of a recorder share."""

    folder: Folder
    options: Options
    clock: RecordingClock
    counters: Counter[str]
    about: Mapping[str, str]  # of the recording, for each file


class Writing:
    """A writer of a recorder's messages, each into the file of its lane (see .lane). Not thread-safe."""

    def __init__(self, context: Context, intake: Intake, background: Background) -> None:
        self._folder, self._options, self._clock, self._counters, about = context
        self._intake = intake
        self._files = OpenFiles(self._folder, about, background.watch)
        self._finisher = Finisher(background, self._intake.note, self._note_finished)
        self._blocked: _Blocked | None = None  # why nothing can be written now
        self._lacking: list[Item] = []  # what no file has taken; bounded: a second of messages
        self._noted_drops = 0  # messages that were dropped, as recorded last
        self._changed = False  # files were finished since the folder was listed
        self._quiet_log = RateLimitedLog(log, period_s=60.0)

    @property
    def blocked(self) -> str:
        return "" if self._blocked is None else self._blocked.why

    def mend_leftovers(self) -> int:
        """Finish the files that an earlier recorder has left; return their number.

        Where the folder cannot be locked, a recorder that runs may still write them: then they stay as they are.
        """
        open_paths = {file.path for file in self._files.by_lane.values()}
        leftovers = [entry.path for entry in self._folder.entries() if entry.is_active and entry.path not in open_paths]
        if self._folder.is_locked:
            for path in leftovers:
                self._finisher.mend(path)
        return len(leftovers)

    # -- messages

    def add(self, item: Item) -> None:
        """Write a message or an event, or forget retained values, as the item says. Never raises."""
        try:
            self._add(item)
        except Exception:  # noqa: BLE001  one message must not take others with it
            self._counters["errors"] += 1
            self._intake.drop(1)
            self._quiet_log.exception("message", "a message of %s cannot be recorded", item.topic[:100])

    def _add(self, item: Item) -> None:
        """Write a message, an event of the recorder (EVENTS), or forget a connection's retained values (FORGET).

        While nothing can be written, an event goes back into the queue, and a message is counted as dropped.
        """
        if item.topic == FORGET:
            self._files.retained.forget(item.source)
            return
        lane = STATE if item.topic == EVENTS else self._files.lane(item)
        if lane == STATE and item.topic != EVENTS:
            self._files.retained.note(item)
        if self._blocked is not None:
            if item.topic == EVENTS:
                self._intake.put_back(item)
            else:
                self._intake.drop(1)
            return
        at_ns = self._clock.at(item.boot_ns)
        try:
            file = self._files.get(lane, now_ns=self._clock.now(), at_ns=at_ns)
            if file.is_full:
                self._flush(lane, file)
                self._finish(lane)
                file = self._files.get(lane, now_ns=self._clock.now(), at_ns=at_ns)
        except OSError as error:
            self._lacking.append(item)
            self._block(lane, error)
            return
        try:
            file.add(item, at_ns)
        except OSError as error:
            self._fail(lane, error)  # this item is among the unwritten ones, which go into the next file

    def flush(self) -> None:
        """Write all added messages to the files."""
        for lane, file in self._files.by_lane.items():
            self._flush(lane, file)

    def rotate(self, *, all_of_them: bool = False) -> None:
        """Finish the files that are old or large, and those of media that are idle; or ``all_of_them``."""
        now_ns = self._clock.now()
        for lane, file in self._files.by_lane.items():
            old = now_ns - file.began_ns > self._options.rotate_seconds * 1e9
            idle = lane != STATE and now_ns - max(file.last_ns, file.began_ns) > _IDLE_NS
            if all_of_them or old or idle or file.writer.size > ROTATE_BYTES:
                self._finish(lane)

    def _flush(self, lane: str, file: OpenFile) -> None:
        try:
            self._counters["written"] += file.flush()
        except OSError as error:
            self._fail(lane, error)
            return
        if not file.is_there():
            self._forget_removed(lane)

    def _finish(self, lane: str) -> None:
        """Finish the file of a lane, unless it has failed."""
        if lane in self._files.by_lane:
            self._finisher.finish(self._files.take(lane))

    def note_drops(self) -> None:
        """Record, as an event, how much was dropped because the queue was full."""
        total = self._counters["dropped"]
        if total > self._noted_drops and self._blocked is None:
            self._intake.note("dropped", messages=total - self._noted_drops, why="the disk is too slow")
            self._noted_drops = total

    # -- when files cannot be written

    def _fail(self, lane: str, error: OSError) -> None:
        """Close a failed file as it is. Its unwritten messages go into the next one."""
        file = self._files.take(lane)
        self._lacking += file.take_lacking()
        self._counters["written"] += file.take_written()
        file.file.close()
        self._finisher.postpone(file.path)
        self._block(lane, error)

    def _forget_removed(self, lane: str) -> None:
        file = self._files.take(lane)
        file.file.close()
        self._counters["errors"] += 1
        self._intake.note("removed", file=file.path.name, by="another program")

    def _block(self, lane: str, error: OSError) -> None:
        self._counters["errors"] += 1
        if error.errno in _FULL:
            self._stand_still("the disk is full", full=True)
        else:
            self._stand_still(f"{error.filename or lane}: {error.strerror}")

    def _stand_still(self, why: str, *, full: bool = False) -> None:
        if self._blocked is None:
            self._quiet_log.log("blocked", logging.ERROR, "%s: nothing is recorded until that is mended", why)
            self._blocked = _Blocked(why, self._clock.now(), self._counters["dropped"], full)

    def try_again(self) -> None:
        """Resume writing if that is possible now."""
        blocked = self._blocked
        if blocked is None:
            return
        lacking, self._lacking = sorted(self._lacking, key=_when), []
        try:
            now_ns = self._clock.now()
            first_ns = self._clock.at(lacking[0].boot_ns) if lacking else now_ns
            self._files.get(STATE, now_ns=now_ns, at_ns=first_ns)  # if it can be opened, writing is possible
        except OSError:
            self._lacking = lacking
            return
        self._blocked = None
        for item in lacking:
            self.add(item)
        if self._blocked is not None:  # it failed at once: the earlier block goes on
            self._blocked = blocked
            return
        self._finisher.retry()
        dropped = self._counters["dropped"]
        self._intake.note_gap(blocked.since_ns, blocked.why, messages=dropped - blocked.dropped)
        self._noted_drops = dropped
        log.warning("recording again")

    def give_up(self) -> None:
        """Count, at the end, the messages that could not be written."""
        self._intake.drop(len(self._lacking))
        self._lacking = []
        self._finisher.retry()

    # -- room

    def check_space(self, due: Due, *, now_s: float) -> None:
        """Look at the disk if that is due; delete files for room, and stop or resume writing.

        With less free than is wanted, old files are deleted. With less than half of that, nothing is written until as
        much is free again.
        """
        if not (due.every("space", _SPACE_S) or self._changed):
            return
        options = self._options
        try:
            self._follow_folder()
            disk = _disk(self._folder.root)
        except PebbleError as error:
            self._stand_still(str(error))
            return
        except OSError as error:
            self._stand_still(f"{self._folder.root}: {error.strerror}")
            return
        wanted = disk.wanted_bytes(options)
        if disk.free_bytes < wanted or not disk.has_inodes or self._changed or due.every("list", _LISTED_S):
            self._changed = False
            self._make_room(disk, due, now_s)
        if due.every("finish", _LISTED_S):
            self._finisher.retry()
        # ``disk`` is as before the deletions: whether there is room again shows at the next look.
        if disk.free_bytes < wanted // 2 or not disk.has_inodes:
            self.flush()
            self.rotate(all_of_them=True)  # while there is room to finish them
            free_mb, wanted_mb = disk.free_bytes >> 20, wanted >> 20
            self._stand_still(f"the disk is full ({free_mb} MB are free, and {wanted_mb} MB must stay)", full=True)
        elif self._blocked is not None and (disk.free_bytes >= wanted or not self._blocked.is_full):
            self.try_again()

    def _follow_folder(self) -> None:
        """Use the folder that is now at the path. Raises PebbleError and OSError."""
        if self._folder.in_place:
            return
        self.flush()  # forgets the files that are not there any more
        self._folder.release()
        self._folder.take()
        self.mend_leftovers()
        log.warning("%s was removed, or is on another disk now: recording into what is there", self._folder.root)

    def _make_room(self, disk: Disk, due: Due, now_s: float) -> None:
        """Delete the files that leave too little room and, one at a time, those that are kept for too long."""
        entries = self._folder.entries()
        for entry in surplus(entries, self._options, disk):
            self._delete(entry.path, entry.size)
        if due.every("age", _AGE_S):
            old = outdated(entries, self._options, now_s)
            if old is not None:
                self._delete(old.path, old.size)

    def _delete(self, path: Path, size: int) -> None:
        try:
            path.unlink()
            path.with_suffix(_INDEX).unlink(missing_ok=True)
        except OSError as error:
            self._quiet_log.warning("delete", "%s cannot be deleted: %s", path, error.strerror)
            return
        self._counters["pruned_bytes"] += size
        self._intake.note("pruned", file=path.name, bytes=size)

    def _note_finished(self) -> None:
        self._changed = True


def _disk(root: Path) -> Disk:
    about = os.statvfs(root)
    has_inodes = about.f_files == 0 or about.f_favail > 0
    return Disk(about.f_bavail * about.f_frsize, has_inodes, about.f_blocks * about.f_frsize)
