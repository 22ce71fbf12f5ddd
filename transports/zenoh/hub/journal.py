"""An append-only file that stores records across restarts, and tolerates a torn end.

Each record is framed by its length and CRC. It reaches the operating system when it is written, so it survives the
death of this process; it reaches the disk within about a second (``SYNC_S``), so a power cut costs at most that. The
file is rewritten when it has grown to several times the size of its current records.
"""

from __future__ import annotations

import logging
import os
import struct
import threading
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from pebble.errors import TransportError

log = logging.getLogger(__name__)

SYNC_S = 1.0
_FRAME = struct.Struct(">II")  # bytes of the record, its CRC
_MAX_RECORD = 128 << 20
_SLACK_BYTES = 1 << 20  # growth that is never worth a rewrite
_GROWTH = 4  # times the size after the last rewrite


class Journal:
    """Use: ``load()`` once, then ``rewrite()`` with the current records, then ``append()``, then ``close()``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: int | None = None
        self._size = self._base = 0
        self._dirty = threading.Event()
        self._closing = threading.Event()
        self._lock = threading.Lock()  # the file may be replaced while the syncer uses it
        self._syncer: threading.Thread | None = None

    def load(self) -> Iterator[bytes]:
        """The records of the last run, oldest first, up to the first damaged one. Raises TransportError."""
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            raise TransportError(f"journal {self.path}: {error.strerror}") from None
        yield from _records(data, self.path)

    def rewrite(self, records: Iterable[bytes]) -> None:
        """Replace the file by ``records``, all or nothing. Raises TransportError if that is impossible."""
        framed = b"".join(map(_framed, records))
        self._base = self._size  # if this fails it is not tried again at once
        try:
            descriptor = self._replaced_by(framed)
        except OSError as error:
            raise TransportError(f"journal {self.path}: {error.strerror}") from None
        self._release()
        with self._lock:
            self._file = descriptor
        self._size = self._base = len(framed)
        self._start_syncer()

    def _replaced_by(self, data: bytes) -> int:
        fresh = self.path.with_name(self.path.name + ".new")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        try:
            _write_all(descriptor, data)
            os.fdatasync(descriptor)
            fresh.replace(self.path)
        except OSError:
            os.close(descriptor)
            raise
        return descriptor

    def append(self, record: bytes) -> bool:
        """Append ``record``; return whether it is time to ``rewrite``. A full disk ends the journal."""
        if self._file is None:
            return False
        framed = _framed(record)
        try:
            _write_all(self._file, framed)
        except OSError as error:
            log.error("journal %s ends here, nothing more will be stored: %s", self.path, error.strerror)
            self._release()
            return False
        self._size += len(framed)
        self._dirty.set()
        return self._size > _GROWTH * self._base + _SLACK_BYTES

    def close(self) -> None:
        self._closing.set()
        self._dirty.set()
        if self._syncer is not None:
            self._syncer.join()
        self._release()

    def _start_syncer(self) -> None:
        if self._syncer is None:
            self._syncer = threading.Thread(target=self._sync, name="pebble-journal", daemon=True)
            self._syncer.start()

    def _sync(self) -> None:
        """Sync to disk on a thread of its own: a slow SD card must not delay ``append``."""
        while not self._closing.is_set():
            self._dirty.wait()
            self._closing.wait(SYNC_S)
            self._dirty.clear()
            with self._lock:
                copy = os.dup(self._file) if self._file is not None else None
            if copy is not None:
                _flush(copy)

    def _release(self) -> None:
        with self._lock:
            if self._file is not None:
                os.close(self._file)
                self._file = None


def _records(data: bytes, path: Path) -> Iterator[bytes]:
    at = 0
    while at < len(data):
        record = _record_at(data, at)
        if record is None:
            log.warning("journal %s is damaged at byte %d of %d: the rest is ignored", path, at, len(data))
            return
        yield record
        at += _FRAME.size + len(record)


def _record_at(data: bytes, at: int) -> bytes | None:
    if len(data) - at < _FRAME.size:
        return None
    size, crc = _FRAME.unpack_from(data, at)
    start = at + _FRAME.size
    record = data[start : start + size]
    return record if size <= _MAX_RECORD and len(record) == size and zlib.crc32(record) == crc else None


def _framed(record: bytes) -> bytes:
    return _FRAME.pack(len(record), zlib.crc32(record)) + record


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


def _flush(descriptor: int) -> None:
    try:
        os.fdatasync(descriptor)
    except OSError as error:
        log.error("the journal cannot be written to its disk: %s", error.strerror)
    finally:
        os.close(descriptor)
