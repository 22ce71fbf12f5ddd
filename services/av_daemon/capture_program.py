"""A program that captures pictures or sound and writes them to its standard output. It ends with this process."""

import fcntl
import os
import select
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pebble.errors import DeviceError
from pebble.extensions.media.child import Child, how_ended
from pebble.runtime.environment import child_environment

SILENCE_S = 3.0  # without output: the device hangs
_FIRST_SILENCE_S = 10.0  # it may take its time to start
_STOP_S = 5.0  # before it is killed
_ERROR_LIMIT = 500  # bytes of its standard error that are remembered
_LAST_READS = 64  # of 4096 bytes: more than a pipe holds
_CHUNK = 256 * 1024


class CaptureProgram:
    """A running program. ``read`` fails when it has ended, or has written nothing for 3 s."""

    def __init__(self, command: Sequence[str], *, pipe_bytes: int = 0) -> None:
        self.name = Path(command[0]).name
        self._errors = b""
        self._silence_s = _FIRST_SILENCE_S
        try:
            self._child = Child(command, child_environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        except (OSError, ValueError) as error:
            raise DeviceError(f"cannot start {self.name}: {error}") from error
        self._pipes = (self._child.pipe("stdout"), self._child.pipe("stderr"))
        self._out, self._err = (pipe.fileno() for pipe in self._pipes)
        os.set_blocking(self._out, False)
        os.set_blocking(self._err, False)
        if pipe_bytes:
            with suppress(OSError):  # more than the system allows; a smaller pipe is only slower
                fcntl.fcntl(self._out, fcntl.F_SETPIPE_SZ, pipe_bytes)
        self._poll = select.poll()
        self._poll.register(self._out, select.POLLIN)
        self._poll.register(self._err, select.POLLIN)

    def read(self, limit: int = _CHUNK) -> bytes:
        """Return the program's new output, at least one byte. Raises DeviceError if the program has ended or hangs."""
        deadline = time.monotonic() + self._silence_s
        while True:
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                if self._child.wait(0.0) is not None:  # it ended; one that it started holds its output open
                    raise DeviceError(self._end())
                raise DeviceError(f"{self.name} hangs: nothing came for {self._silence_s:.0f} s{self._last_error()}")
            ready = dict(self._poll.poll(remaining_s * 1000))
            if self._err in ready:
                self._read_errors()
            if self._out in ready:
                chunk = os.read(self._out, limit)
                if not chunk:
                    raise DeviceError(self._end())
                self._silence_s = SILENCE_S
                return chunk

    def interrupt(self) -> None:
        """Kill the program, from any thread. A waiting ``read`` then fails."""
        self._child.signal(signal.SIGKILL)

    def close(self) -> None:
        """Terminate the program, and kill it if it does not end in time."""
        self._child.signal(signal.SIGTERM)
        for pipe in self._pipes:  # frees a program that is blocked in a write
            pipe.close()
        self._child.finish(_STOP_S)

    def _read_errors(self) -> None:
        chunk = os.read(self._err, 4096)
        if chunk:
            self._errors = (self._errors + chunk)[-_ERROR_LIMIT:]
        else:
            self._poll.unregister(self._err)

    def _end(self) -> str:
        code = self._child.wait(0.5)
        with suppress(BlockingIOError, KeyError):  # nothing more now, or end of file
            for _ in range(_LAST_READS):
                self._read_errors()
        how = "closed its output" if code is None else how_ended(code)
        return f"{self.name} ended: {how}{self._last_error()}"

    def _last_error(self) -> str:
        lines = self._errors.decode("utf-8", "replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f" ({''.join(c if c.isprintable() else '?' for c in last)})" if last else ""
