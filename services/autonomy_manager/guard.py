"""Ends all processes of all scripts when this process has ended, however it ended."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Mapping
from contextlib import suppress

# Each line of its input is the whole list, "TERM:123 KILL:456"; at the end of the input, this process has ended.
# A process that is killed cannot do this itself, and the kernel's parent death signal reaches only a script's first
# process. A shell is the smallest program there is for it.
_PROGRAM = """
while read -r line; do groups=$line; done
for group in $groups; do kill -s "${group%%:*}" -- "-${group##*:}"; done
[ -z "$groups" ] || sleep 0.4
for group in $groups; do kill -s KILL -- "-${group##*:}"; done
"""


class Guard:
    """A small process that outlives this one by half a second. It runs from the first script on. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._groups: dict[int, signal.Signals] = {}
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe = -1  # its input, while there is one

    def add(self, group: int, number: signal.Signals) -> None:
        """End this process group with ``number``, and with SIGKILL if it has not ended then. Raises OSError."""
        with self._lock:
            self._groups[group] = number
            self._update(self._groups)

    def remove(self, group: int) -> None:
        with self._lock, suppress(OSError):
            self._groups.pop(group, None)
            self._update(self._groups)

    def close(self) -> None:
        """End it without ending anything else."""
        with self._lock:
            if self._process is not None:
                with suppress(OSError):
                    self._write({})
                self._end()

    def _update(self, groups: Mapping[int, signal.Signals]) -> None:
        if self._process is not None:
            try:
                self._write(groups)
                return
            except BrokenPipeError:  # it was killed
                self._end()
        read_end, self._pipe = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self._pipe, False)
        try:
            self._process = self._start(read_end)
        finally:
            os.close(read_end)
        self._write(groups)

    def _start(self, read_end: int) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            ["sh", "-c", _PROGRAM],
            stdin=read_end,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a kill of this process's group must not reach it
        )

    def _end(self) -> None:
        """It ends with its input."""
        process, self._process = self._process, None
        os.close(self._pipe)
        if process is not None:
            process.wait()

    def _write(self, groups: Mapping[int, signal.Signals]) -> None:
        words = (f"{number.name.removeprefix('SIG')}:{group}" for group, number in groups.items())
        os.write(self._pipe, (" ".join(words) + "\n").encode())
