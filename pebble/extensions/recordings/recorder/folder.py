"""The folder of recordings: its files' names and numbers, its lock, and files to delete. One recorder uses it."""

import errno
import logging
import os
import re
import stat
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from pebble.extensions.recordings.files.recorded import ACTIVE, SUFFIX, RecordingError
from pebble.extensions.recordings.files.rewrite import PART
from pebble.runtime.as_owner import as_owner, require_own
from pebble.runtime.whole_file import sync_folder
from pebble.transports.own_file import OwnFile

log = logging.getLogger(__name__)

STATE: Final = "state"
MEDIA: Final = "media."
DAMAGED: Final = ".damaged"
LOCK: Final = "recorder.lock"
NAME: Final = re.compile(
    r"(?P<stamp>\d{8}T\d{6}Z)-(?P<number>\d{6,})\.(?P<lane>state|media\.[A-Za-z0-9_.-]{1,120})\.mcap(?P<state>|\.active|\.damaged)"
)
_COPY: Final = re.compile(rf"\.{NAME.pattern}\.\d+{re.escape(PART)}")
_DAY: Final = "%Y/%m/%d"


@dataclass(frozen=True, slots=True)
class Entry:
    """A file of a recorder."""

    path: Path
    number: int  # of a newer file it is greater; times are not, because clocks are set
    lane: str
    size: int
    ended: float  # when it was written last, seconds since 1970

    @property
    def is_media(self) -> bool:
        return self.lane != STATE

    @property
    def is_active(self) -> bool:
        """True if it is being written, or its recorder was killed."""
        return self.path.name.endswith(ACTIVE)

    @property
    def is_finished(self) -> bool:
        return self.path.name.endswith(SUFFIX)


class Folder:
    """A recorder's folder. ``root`` holds ``2026/11/20/20261120T232921Z-000017.state.mcap`` and the like."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.is_locked = False  # also where there are no locks: another recorder may write here
        self._number = 0  # of the newest file
        self._lock = ExitStack()
        self._lock_file = OwnFile(root / LOCK)

    def take(self) -> None:
        """Create the folder and lock it against a second recorder. Raises PebbleError."""
        require_own(self.root)
        try:
            self.root.mkdir(mode=0o750, parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(f"{self.root}: {error.strerror}: name another folder") from None
        require_own(self.root)  # another user may have been faster
        problem = f"{self.root}: a recorder writes here: stop it first, or name another folder"
        self.is_locked = self._lock.enter_context(_locked(self.root / LOCK, problem))
        self._lock_file = OwnFile(self.root / LOCK)  # the file that is locked now
        for path in self._files():
            if self.is_locked and _COPY.fullmatch(path.name):  # was being written when its process was killed
                path.unlink(missing_ok=True)
        self._number = max((self._number, *(entry.number for entry in self.entries())))

    @property
    def in_place(self) -> bool:
        """True if the path still leads to the folder that was taken; its disk may have been removed or brought back."""
        return self._lock_file.in_place

    def release(self) -> None:
        self._lock.close()

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Hold the lock during the block, so that no recorder starts. Raises PebbleError."""
        self.take()
        try:
            yield
        finally:
            self.release()

    @classmethod
    def is_in_use(cls, root: Path) -> bool:
        """True if a recorder writes in ``root``, or if one may do so because the file system has no locks."""
        with as_owner(root):
            if not (root / LOCK).exists():
                return False
            try:
                with _locked(root / LOCK, "") as is_locked:  # "": its error is caught here
                    return not is_locked
            except RecordingError:
                return True

    def create(self, lane: str, now_ns: int) -> tuple[BinaryIO, Path]:
        """Create a file to write to; ``lane``: what it holds, STATE or MEDIA with a name. Raises OSError."""
        self._number += 1
        moment = time.gmtime(max(0, now_ns) // 10**9)
        day = self.root / time.strftime(_DAY, moment)
        for folder in (day.parent.parent, day.parent, day):
            folder.mkdir(mode=0o750, exist_ok=True)
        path = day / f"{time.strftime('%Y%m%dT%H%M%SZ', moment)}-{self._number:06d}.{lane}{ACTIVE}"
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        return os.fdopen(descriptor, "r+b", buffering=0), path

    def entries(self) -> list[Entry]:
        """Return the recorder's files, the oldest first; links and foreign files are left out."""
        entries = []
        for path in self._files():
            match = NAME.fullmatch(path.name)
            try:
                about = path.lstat()
            except OSError:
                continue
            if match is not None and stat.S_ISREG(about.st_mode):
                entries.append(Entry(path, int(match["number"]), match["lane"], about.st_size, about.st_mtime))
        return sorted(entries, key=lambda entry: entry.number)

    def _files(self) -> Iterator[Path]:
        for folder, _, names in os.walk(self.root):
            for name in names:
                if SUFFIX in name:
                    yield Path(folder, name)


@contextmanager
def _locked(path: Path, problem: str) -> Iterator[bool]:
    """Lock the folder; yield False if the file system has no locks.

    Raises RecordingError(problem) if another process holds the lock.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        raise RecordingError("recording needs a system with file locks, such as Linux or macOS") from None
    try:
        file = path.open("a+b")
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}: name another folder") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_locked = True
        except BlockingIOError:
            raise RecordingError(problem) from None
        except OSError as error:
            text = "%s cannot be locked (%s): see that nothing else records into its folder, which is not noticed"
            log.error(text, path, error.strerror)
            is_locked = False
        yield is_locked


def rename(path: Path, target: Path) -> None:
    """Rename a file durably; never over another file. Raises OSError."""
    if target.exists():
        raise FileExistsError(errno.EEXIST, "there is another file of this name", str(target))
    path.rename(target)
    sync_folder(path.parent)
