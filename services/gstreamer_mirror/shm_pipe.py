"""The writer's side of a GStreamer socket: one shared memory and several readers, none of which can hold it up."""

from __future__ import annotations

import errno
import logging
import mmap
import os
import selectors
import socket
import stat
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pebble.errors import DeviceError, PayloadError
from pebble.services.gstreamer_mirror.shm_protocol import Acknowledgements, new_area, new_buffer
from pebble.transports.counters import Counters
from pebble.transports.segments import SHM
from pebble.transports.socket_paths import check_socket_path

log = logging.getLogger(__name__)

Bytes = NDArray[np.uint8]

MOST_READERS = 16
STARVED_S = 1.0  # after so long without a free slot, the reader that has held one for longest is disconnected
_SHARE = 4  # a reader holds at most one of so many slots: so as many may stop before the others notice
_UMASK = 0o117  # a socket that its user and group may use, as shmsink's
_SEGMENT_MODE = 0o640  # the group's programs only read it


class ShmPipe:
    """Offers ``slots`` buffers of up to ``slot_bytes`` each at the socket ``path``. One thread uses it; any wakes it.

    A slot is written again when every reader that was given it has acknowledged it or is gone. A reader that does not
    acknowledge gets no more until it does. Memory is taken from the system as slots are first used, the lowest free one
    first: readers that keep up need three or four of them.

    Counters: sent (to one reader each), behind (not sent to one reader, which held its share), full (no slot was free),
    refused (readers beyond MOST_READERS), expelled (readers that were disconnected, because all slots were held).
    """

    def __init__(self, path: Path, slot_bytes: int, slots: int) -> None:
        self.path, self.counters = path, Counters()
        self._slot_bytes, self._slots = slot_bytes, slots
        self._share = max(1, slots // _SHARE)
        self._readers: list[_Reader] = []
        self._opened: _Opened | None = None
        self._starved_since: float | None = None

    # -- opening and closing

    def open(self) -> Self:
        """Raises DeviceError, which says why no program will find the socket."""
        self._opened = _Opened(self.path, self._slot_bytes * self._slots)
        return self

    def close(self) -> None:
        for reader in self._readers:
            reader.connection.close()
        self._readers.clear()
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def in_place(self) -> bool:
        """False once another program has removed what new readers need."""
        return self._opened is not None and self._opened.in_place

    # -- readers

    @property
    def readers(self) -> int:
        return len(self._readers)

    @property
    def wanted(self) -> bool:
        """Whether a reader would get a buffer now: all may hold their share."""
        return any(len(reader.held) < self._share for reader in self._readers)

    def wake(self) -> None:
        """End a `wait` that has begun, or the next one. For any thread."""
        if (opened := self._opened) is not None:
            opened.wake()

    def wait(self, timeout: float | None = 0.0) -> None:
        """Handle what readers did: until the first of it, for ``timeout`` seconds at most."""
        opened = self._required
        for key, _ in opened.selector.select(timeout):
            if isinstance(key.data, _Reader):
                self._receive(key.data)
            elif key.fileobj is opened.server:
                self._accept()
            else:
                opened.clear_wake()

    def _accept(self) -> None:
        opened = self._required
        try:
            connection, _ = opened.server.accept()
        except OSError:  # it is gone again, or no descriptor is left
            return
        connection.setblocking(False)
        if len(self._readers) >= MOST_READERS:
            self.counters.add("refused")
            connection.close()
            return
        reader = _Reader(connection)
        if not reader.send(new_area(self._slot_bytes * self._slots, opened.segment)):
            connection.close()
            return
        self._readers.append(reader)
        opened.selector.register(connection, selectors.EVENT_READ, reader)

    def _receive(self, reader: _Reader) -> None:
        if reader in self._readers and not reader.receive():
            self._drop(reader)

    def skip(self) -> None:
        """Count a buffer that is not `wanted`."""
        self.counters.add("behind", len(self._readers))

    def _drop(self, reader: _Reader) -> None:
        self._required.selector.unregister(reader.connection)
        self._readers.remove(reader)
        reader.connection.close()

    # -- buffers

    def put(self, size: int, draw: Callable[[Bytes], bool]) -> bool:
        """Send a buffer of ``size`` bytes to every reader that keeps up; ``draw`` writes it, False: send it to none.

        Returns whether it went to a reader. Never waits.
        """
        if (offset := self._free()) is None:
            return False
        if not draw(self._required.room(offset, size)):
            return False
        return sum([self._send(reader, offset, size) for reader in list(self._readers)]) > 0

    def _send(self, reader: _Reader, offset: int, size: int) -> bool:
        if len(reader.held) >= self._share:
            self.counters.add("behind")
            return False
        try:
            taken = reader.send(new_buffer(offset, size))
        except OSError:
            self._drop(reader)
            return False
        if taken:
            reader.held[offset] = time.monotonic()
        self.counters.add("sent" if taken else "behind")
        return taken

    def _free(self) -> int | None:
        """The lowest slot that no reader holds."""
        held = {offset for reader in self._readers for offset in reader.held}
        free = next((number for number in range(self._slots) if number * self._slot_bytes not in held), None)
        if free is not None:
            self._starved_since = None
            return free * self._slot_bytes
        self.counters.add("full")
        self._expel(time.monotonic())
        return None

    def _expel(self, now: float) -> None:
        """Disconnect the reader that has held a slot for longest, once none was free for a while."""
        if self._starved_since is None:
            self._starved_since = now
        elif now - self._starved_since >= STARVED_S:
            self._starved_since = None
            slowest = min(self._readers, key=lambda reader: min(reader.held.values(), default=now))
            self.counters.add("expelled")
            log.warning("%s: programs hold all buffers; the one that stopped first is disconnected", self.path)
            self._drop(slowest)

    @property
    def _required(self) -> _Opened:
        if self._opened is None:
            raise DeviceError(f"{self.path} is not open")
        return self._opened


class _Reader:
    """A connected program, and since when it holds which offsets."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.held: dict[int, float] = {}
        self._acknowledgements = Acknowledgements()

    def send(self, command: bytes) -> bool:
        """False: it has read so little that there is no room. Raises OSError if it is gone."""
        try:
            sent = self.connection.send(command)
        except BlockingIOError:
            return False
        if sent != len(command):
            raise OSError(errno.EPIPE, "part of a command")
        return True

    def receive(self) -> bool:
        """False: it is gone, or sends what no reader sends."""
        try:
            data = self.connection.recv(4096)
            for offset in self._acknowledgements.feed(data):
                self.held.pop(offset, None)
        except BlockingIOError:
            return True
        except (OSError, PayloadError):
            return False
        return bool(data)


class _Opened:
    """The socket and the shared memory, and what waits for readers."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        self.server = _listen(path)
        self._socket_id = _identity(path)
        name = f"pebble-gst-{zlib.crc32(os.fsencode(path)):08x}"
        for left in SHM.glob(f"{name}.*"):  # of a killed process: nothing listens at its socket any more
            with suppress(OSError):
                left.unlink()
        self._file = SHM / f"{name}.{os.getpid()}.{time.monotonic_ns()}"
        self.segment = f"/{self._file.name}"
        self._ready = 0  # bytes that the system has provided
        self._segment = self._wake = -1
        try:
            self._create(size)
        except OSError as error:
            self.close()
            raise DeviceError(f"{self._file}: {os.strerror(error.errno or 0)}") from None

    def _create(self, size: int) -> None:
        self._segment = os.open(self._file, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, _SEGMENT_MODE)
        os.fchmod(self._segment, _SEGMENT_MODE)
        self._segment_id = _identity(self._file)
        os.ftruncate(self._segment, size)
        self._memory = np.frombuffer(mmap.mmap(self._segment, size), np.uint8)
        self.selector = selectors.DefaultSelector()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.selector.register(self.server, selectors.EVENT_READ)
        self.selector.register(self._wake, selectors.EVENT_READ)

    @property
    def in_place(self) -> bool:
        return _identity(self._path) == self._socket_id and _identity(self._file) == self._segment_id

    def room(self, offset: int, size: int) -> Bytes:
        """That part of the memory. Raises DeviceError where the system has none left: to write there would be fatal."""
        end = offset + size
        if end > self._ready:
            try:
                os.posix_fallocate(self._segment, self._ready, end - self._ready)
            except OSError as error:
                raise DeviceError(f"{SHM} has no room for {end} bytes: {os.strerror(error.errno or 0)}") from None
            self._ready = end
        return self._memory[offset:end]

    def wake(self) -> None:
        with suppress(OSError):
            os.eventfd_write(self._wake, 1)

    def clear_wake(self) -> None:
        with suppress(OSError):
            os.eventfd_read(self._wake)

    def close(self) -> None:
        """Readers keep what they have mapped. What another program has put in their place stays."""
        if self._wake >= 0:
            self.selector.close()
            os.close(self._wake)
        if _identity(self._path) == self._socket_id:
            self._path.unlink(missing_ok=True)
        self.server.close()
        if self._segment >= 0:
            self._file.unlink(missing_ok=True)
            os.close(self._segment)


def _listen(path: Path) -> socket.socket:
    """A socket at ``path``, in place of one at which no process listens any more."""
    check_socket_path(path)
    _make_way(path)
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    before = os.umask(_UMASK)  # else others could connect before a chmod
    try:
        server.bind(os.fspath(path))
        server.listen(MOST_READERS)
    except OSError as error:
        server.close()
        folder = f": make the folder {path.parent}" if error.errno == errno.ENOENT else ""
        raise DeviceError(f"{path} cannot be made: {os.strerror(error.errno or 0)}{folder}") from None
    finally:
        os.umask(before)
    return server


def _make_way(path: Path) -> None:
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise DeviceError(f"{path} is a file and no socket: remove it, or name another socket_path")
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
            probe.connect(os.fspath(path))
    except FileNotFoundError:
        return
    except ConnectionRefusedError:
        pass  # left by a process that was killed
    except OSError as error:  # busy, or of another user
        raise DeviceError(f"{path} cannot be used: {os.strerror(error.errno or 0)}") from None
    else:
        raise DeviceError(f"another program serves {path}: is the original's av_daemon running?")
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise DeviceError(f"{path} cannot be replaced: {os.strerror(error.errno or 0)}") from None


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
