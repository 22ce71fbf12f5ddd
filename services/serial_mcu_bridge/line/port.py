"""An open serial device and its non-blocking system calls."""

import errno
import fcntl
import os
import sys
import termios
from contextlib import suppress
from pathlib import Path

import serial

from pebble.errors import DeviceError
from pebble.services.serial_mcu_bridge.line.holders import holders

_CHUNK = 4096


class Port:
    """An open tty in raw mode, 8N1, with old input discarded. Raises DeviceError if it cannot be opened or is gone.

    Exclusive by flock: TIOCEXCL would outlive a killed process on a pty, a flock never does. HUPCL stays set: when our
    process ends, DTR drops, which resets (so stops) some boards.
    """

    def __init__(self, path: str, baud: int) -> None:
        self.path = path
        try:
            self._serial = serial.Serial(path, baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
            raise DeviceError(f"cannot open {path}: {_reason(error, path)}") from error
        self._fd = int(self._serial.fileno())  # -1 once it is closed: the number may then be another file's

    def fileno(self) -> int:
        return self._fd

    def read(self) -> bytes:
        """Return received bytes, at most 4096; empty if there are none."""
        try:
            data = os.read(self._fd, _CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise DeviceError(f"{self.path} has gone: {error}") from error
        if not data:
            raise DeviceError(f"{self.path} has gone: hung up")
        return data

    def write(self, data: bytes) -> int:
        """Write as many bytes as the kernel accepts at once; return how many."""
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise DeviceError(f"{self.path} has gone: {error}") from error

    def queued(self) -> int:
        """Return how many unsent bytes the kernel holds; always 0 on a pty."""
        try:
            answer = fcntl.ioctl(self._fd, termios.TIOCOUTQ, b"\0\0\0\0")
        except (OSError, ValueError) as error:
            raise DeviceError(f"{self.path} has gone: {error}") from error
        return int.from_bytes(answer, sys.byteorder)

    def discard_output(self) -> None:
        """Discard the unsent bytes that the kernel holds."""
        with suppress(termios.error, ValueError):  # a port that has gone raises at the next read
            termios.tcflush(self.fileno(), termios.TCOFLUSH)

    def is_replaced(self) -> bool:
        """True if the path now leads to another device: a replug often makes a new node for the symlink."""
        try:
            return Path(self.path).stat().st_rdev != os.fstat(self.fileno()).st_rdev
        except OSError:
            return False  # no such path, perhaps just being created: a read fails when the device has gone

    def close(self) -> None:
        """Close without waiting: unsent output is discarded, because it can block close() for 30 s."""
        with suppress(DeviceError):
            if self.queued():
                self.discard_output()
        self._fd = -1
        with suppress(OSError):
            self._serial.close()


def _reason(error: Exception, path: str) -> str:
    """Return the plain reason of an error: pyserial wraps it in a text with path and number."""
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.EAGAIN:  # from flock
        return ", ".join(["another program has it open", *holders(path)])
    return os.strerror(number) if number else str(error)
