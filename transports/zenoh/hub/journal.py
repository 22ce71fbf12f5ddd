"""An append-only file that stores records across restarts, and tolerates a torn end and a disk that fails for a while.

Each record is framed by its length and CRC. It reaches the operating system when it is written, so it survives the
death of this process; it reaches the disk within about a second (``SYNC_S``), so a power cut costs at most that. The
file is rewritten when it has grown to several times the size of its current records, and after a failure of its disk.
"""

import logging
import os
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from pebble.transports.own_file import OwnFile

log = logging.getLogger(__name__)

SYNC_S = 1.0
RETRY_S = 30.0  # after a failure of the disk
_FRAME = struct.Struct(">II")  # bytes of the record, its CRC
_MAX_RECORD = 128 << 20  # bytes; a longer one is damage
_SLACK_BYTES = 1 << 20  # growth that is never worth a rewrite
_GROWTH = 4  # times the size after the last rewrite
_NEVER = float("inf")


class Journal:
    """Use: ``load()`` and ``rewrite()`` with the current records, then ``append()``, finally ``close()``.

    A disk that is full, missing or cannot be written is no error of the caller: one line in the log says so, and
    ``rewrite_due`` says when to try again. Until then nothing, or only a part, is stored.
    """

    def __init__(self, path: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self._clock = clock
        self._file: int | None = None
        self._size = self._base = 0
        self._due = _NEVER  # when to rewrite
        self._failing = False
        self._own = OwnFile(path)
        self._began_anew = False  # there was no file to load
        self._dirty = threading.Event()
        self._closing = threading.Event()
        self._lock = threading.Lock()  # the file may be replaced while the syncer uses it
        self._syncer: threading.Thread | None = None

    @property
    def rewrite_due(self) -> bool:
        """Whether it is time to ``rewrite``: the file has grown or was removed, or its disk failed a while ago."""
        return self._clock() >= self._due or not self._in_place

    @property
    def wait_s(self) -> float:
        """How long ``rewrite_due`` need not be checked."""
        return min(RETRY_S, max(0.0, self._due - self._clock()))

    @property
    def _in_place(self) -> bool:
        """False: the file or its folder was removed or replaced, and what is appended is lost with this process."""
        if self._file is None:
            return True  # it is tried again when it is due
        try:
            return self._own.in_place
        except OSError:  # what is there cannot be seen
            return True

    @property
    def appeared(self) -> bool:
        """Whether there was no file at first, and another process's is there now: its folder was mounted late."""
        try:
            return self._began_anew and self._own.replaced
        except OSError:  # what is there cannot be seen
            return False

    def load(self) -> list[bytes] | None:
        """The records of the last run, oldest first, up to the first damaged one; None while they cannot be read.

        What follows the damage is set aside in ``<path>.bad``.
        """
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            self._began_anew = True
            return []
        except OSError as error:
            self._fail(error)
            return None
        self._began_anew = False
        records, end = _records(data)
        if end < len(data):
            bad = self.path.with_name(self.path.name + ".bad")
            log.warning("journal %s is damaged at byte %d of %d: the rest goes to %s", self.path, end, len(data), bad)
            with suppress(OSError):
                os.close(_written(bad, data[end:]))
        return records

    def rewrite(self, records: Iterable[bytes]) -> None:
        """Replace the file by ``records``, all or nothing."""
        framed = b"".join(map(_framed, records))
        in_place = self._in_place
        try:
            descriptor = self._replaced_by(framed)
        except OSError as error:
            if not in_place:
                self._release()  # what is appended there is lost
            self._fail(error)
            return
        if not in_place:
            log.warning("journal %s was removed: it is written anew", self.path)
        self._release()
        with self._lock:
            self._file = descriptor
        self._size = self._base = len(framed)
        self._due = _NEVER
        if self._failing:
            self._failing = False
            log.info("journal %s is written again", self.path)
        if self._syncer is None:
            self._syncer = threading.Thread(target=self._sync, name="pebble-journal", daemon=True)
            self._syncer.start()

    def _replaced_by(self, data: bytes) -> int:
        fresh = self.path.with_name(self.path.name + ".new")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = _written(fresh, data)
        try:
            os.fdatasync(descriptor)
            fresh.replace(self.path)
            self._own = OwnFile(self.path)
        except OSError:
            os.close(descriptor)
            fresh.unlink(missing_ok=True)
            raise
        return descriptor

    def append(self, record: bytes) -> None:
        """Append ``record``; after a failure the next ``rewrite`` has to store it."""
        if self._file is None:
            return
        framed = _framed(record)
        try:
            _write_all(self._file, framed)
        except OSError as error:
            self._release()  # what follows a torn record would not be read
            self._fail(error)
            return
        self._size += len(framed)
        self._dirty.set()
        if self._due == _NEVER and self._size > _GROWTH * self._base + _SLACK_BYTES:
            self._due = self._clock()

    def close(self) -> None:
        self._closing.set()
        self._dirty.set()
        if self._syncer is not None:
            self._syncer.join()
        self._release()

    def _fail(self, error: OSError) -> None:
        """Try again later; say so once."""
        self._due = self._clock() + RETRY_S
        if not self._failing:
            self._failing = True
            log.error(
                "journal %s: %s; a restart of the hub loses retained messages; tried again every %.0f s",
                self.path,
                error.strerror,
                RETRY_S,
            )

    def _sync(self) -> None:
        """Sync to disk on a thread of its own: a slow SD card must not delay ``append``."""
        while not self._closing.is_set():
            self._dirty.wait()
            self._closing.wait(SYNC_S)
            self._dirty.clear()
            with self._lock:
                copy = os.dup(self._file) if self._file is not None else None
            if copy is not None:
                self._flush(copy)

    def _flush(self, descriptor: int) -> None:
        try:
            os.fdatasync(descriptor)
        except OSError as error:
            self._fail(error)
        finally:
            os.close(descriptor)

    def _release(self) -> None:
        with self._lock:
            if self._file is not None:
                os.close(self._file)
                self._file = None


def _records(data: bytes) -> tuple[list[bytes], int]:
    """The whole records at the beginning of ``data``, and where they end."""
    records: list[bytes] = []
    at = 0
    while (record := _record_at(data, at)) is not None:
        records.append(record)
        at += _FRAME.size + len(record)
    return records, at


def _record_at(data: bytes, at: int) -> bytes | None:
    if len(data) - at < _FRAME.size:
        return None
    size, crc = _FRAME.unpack_from(data, at)
    start = at + _FRAME.size
    record = data[start : start + size]
    return record if size <= _MAX_RECORD and len(record) == size and zlib.crc32(record) == crc else None


def _framed(record: bytes) -> bytes:
    return _FRAME.pack(len(record), zlib.crc32(record)) + record


def _written(path: Path, data: bytes) -> int:
    """A descriptor of a new file with ``data``, for this user alone; it is removed again if it cannot be written."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    try:
        _write_all(descriptor, data)
    except OSError:
        os.close(descriptor)
        path.unlink(missing_ok=True)
        raise
    return descriptor


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
