"""A serial device that is open: the system calls, none of which blocks, and the facts about them."""

from __future__ import annotations

import errno
import fcntl
import os
import struct
import termios
from contextlib import suppress
from pathlib import Path

import serial

from pebble.errors import LinkError

_CHUNK = 4096


class Port:
    """An open tty in raw mode, 8N1, its old input forgotten. Raises LinkError when it cannot be opened or has gone.

    Exclusive by flock: TIOCEXCL would outlive a killed process on a pty, a flock never does. HUPCL stays as it is:
    the DTR line that falls with our process stops a board that resets on it.
    """

    def __init__(self, path: str, baud: int) -> None:
        self.path = path
        try:
            self._serial = serial.Serial(path, baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
            raise LinkError(f"cannot open {path}: {_reason(error)}") from error

    def fileno(self) -> int:
        return int(self._serial.fileno())

    def read(self) -> bytes:
        """What has arrived, at most 4096 bytes; empty if nothing has."""
        try:
            data = os.read(self.fileno(), _CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkError(f"{self.path} has gone: {error}") from error
        if not data:
            raise LinkError(f"{self.path} has gone: hung up")
        return data

    def write(self, data: bytes) -> int:
        """Hand over as much as the kernel takes at once; returns how much that was."""
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LinkError(f"{self.path} has gone: {error}") from error

    def queued(self) -> int:
        """Bytes the kernel holds that the wire has not taken. A pty always says 0."""
        try:
            answer = fcntl.ioctl(self.fileno(), termios.TIOCOUTQ, b"\0\0\0\0")
        except OSError as error:
            raise LinkError(f"{self.path} has gone: {error}") from error
        return int(struct.unpack("i", answer)[0])

    def forget_output(self) -> None:
        """Throw away what the kernel holds and the wire has not taken."""
        with suppress(termios.error):  # a port that has gone says so at the next read
            termios.tcflush(self.fileno(), termios.TCOFLUSH)

    def is_replaced(self) -> bool:
        """Whether the path names another device by now: a replug often makes a new node behind the same link."""
        try:
            return Path(self.path).stat().st_rdev != os.fstat(self.fileno()).st_rdev
        except OSError:
            return False  # no such path, perhaps just being made: the device itself will say when it has gone

    def close(self) -> None:
        """Let go without waiting: what the wire has not taken is thrown away, it could hold close() for 30 s."""
        with suppress(LinkError):
            if self.queued():
                self.forget_output()
        with suppress(OSError):
            self._serial.close()


def _reason(error: Exception) -> str:
    """One plain reason; pyserial nests the path and the error number in its text."""
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.EAGAIN:  # from flock
        return "another program has it open"
    return os.strerror(number) if number else str(error)
