"""Samples of the hall sensors of the wheels, in a POSIX shared memory that the original's `wheel-odometry` reads."""

from __future__ import annotations

import errno
import fcntl
import logging
import mmap
import os
import struct

from pebble.transports.segments import SHM

log = logging.getLogger(__name__)

#: Magic, version, slots, 0, and the number of the newest sample; they are counted from 1.
_HEADER = struct.Struct("<8sHHIQ")
#: Number, CLOCK_MONOTONIC in ns, three values as the ADC read them, and whether it charges: 0, 1, or -1 for unknown.
_SLOT = struct.Struct("<QQiiii")
_NEWEST = 2  # the header's third word of eight bytes
_MAGIC, _VERSION = b"PBODRAW1", 1
_MODE = 0o600  # as the original's: its readers open it for writing, too
_CHECK_NS = 1_000_000_000  # how soon it is made again, and how often that is tried


class HallMemory:
    """A ring of ``slots`` samples called ``name``. It is made for the first sample, and stays when its writer ends.

    A reader maps it once, and goes by the number of the newest sample: so a writer continues the ring that it finds.
    """

    def __init__(self, name: str, slots: int = 2048) -> None:
        self._path, self._slots = SHM / name.removeprefix("/"), slots
        self._size = _HEADER.size + slots * _SLOT.size
        self._number = 0  # of the newest sample
        self._opened: tuple[int, mmap.mmap, memoryview] | None = None  # descriptor, memory, and its words of 8 bytes
        self._check_at_ns = 0  # when to look next whether the memory's file is still there
        self._problem = ""

    def write(self, at_ns: int, values: tuple[int, int, int], charging: bool | None) -> None:
        """Add a sample at ``at_ns`` on CLOCK_MONOTONIC. Without the memory it is lost, which is logged once."""
        if at_ns >= self._check_at_ns:
            self._check_at_ns = at_ns + _CHECK_NS
            self._keep()
        if self._opened is None:
            return
        _, memory, words = self._opened
        self._number += 1
        place = _HEADER.size + (self._number - 1) % self._slots * _SLOT.size
        _SLOT.pack_into(memory, place, self._number, at_ns, *values, -1 if charging is None else int(charging))
        words[_NEWEST] = self._number  # last, as readers go by it, and as a whole word: struct would clear it first

    def close(self) -> None:
        if self._opened is not None:
            descriptor, memory, words = self._opened
            self._opened = None
            words.release()
            memory.close()
            os.close(descriptor)

    def _keep(self) -> None:
        """Open the memory if it is not open, or its file is gone: readers by SharedMemory remove it when they end."""
        if self._opened is not None and self._in_place(self._opened[0]):
            return
        self.close()
        try:
            self._opened = self._open()
            self._problem = ""
        except OSError as error:
            text = os.strerror(error.errno or 0) if error.errno else str(error)
            if text != self._problem:
                self._problem = text
                log.error("no hall samples for wheel-odometry: %s %s", self._path, text)

    def _in_place(self, descriptor: int) -> bool:
        """True if the memory behind ``descriptor`` is still the one that readers find."""
        try:
            status = self._path.lstat()
        except OSError:
            return False
        return os.path.samestat(status, os.fstat(descriptor))

    def _open(self) -> tuple[int, mmap.mmap, memoryview]:
        """Create the memory, or open an existing one; it appears only when complete, for readers map it once."""
        flags, is_new = os.O_RDWR | os.O_CLOEXEC, False
        try:
            descriptor = os.open(self._path, flags | os.O_NOFOLLOW)
        except FileNotFoundError:
            descriptor, is_new = os.open(self._path.parent, flags | os.O_TMPFILE, _MODE), True
        try:
            memory = self._mapped(descriptor)
            form = (_MAGIC, _VERSION, self._slots, 0)
            *header, newest = _HEADER.unpack_from(memory)
            if tuple(header) == form:  # a ring like ours: its readers go on
                self._number = max(self._number, newest)
            else:
                _HEADER.pack_into(memory, 0, *form, self._number)
            if is_new:  # src_dir_fd lets Python follow the link in /proc, to the file itself
                os.link(f"/proc/self/fd/{descriptor}", self._path, src_dir_fd=descriptor)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor, memory, memoryview(memory).cast("Q")

    def _mapped(self, descriptor: int) -> mmap.mmap:
        """Return the mapped memory behind ``descriptor``, if only this user can use it. Raises OSError."""
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError("is written by another process") from None
        status = os.fstat(descriptor)
        if status.st_uid != os.geteuid():
            raise PermissionError(errno.EPERM, "belongs to another user")
        if status.st_size not in (0, self._size):
            raise OSError(f"has {status.st_size} bytes, and {self._slots} slots need {self._size}: remove it")
        if not status.st_size:
            os.posix_fallocate(descriptor, 0, self._size)  # so that no write into it can be fatal
        return mmap.mmap(descriptor, self._size)
