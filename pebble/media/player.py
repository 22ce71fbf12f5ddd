"""The program that plays sound: started when there is something to play, restarted when it ends."""

from __future__ import annotations

import logging
import os
import select
import shutil
import subprocess
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # it needs NumPy, which not every program that plays does
    from pebble.media.jitter import Chunk

log = logging.getLogger(__name__)

SILENCE_S = 5.0  # without sound before the device is released
_PIPE_BYTES = 4096  # a page, the least there is: what waits here is late, and cannot be taken back
_CHANGE_S = 0.3  # a program is not replaced by one for another format more often than that
_STUCK_S = 2.0  # a program that reads nothing for so long is replaced
_BACK_OFF_S, _LONGEST_BACK_OFF_S = 0.5, 30.0
_STEADY_S = 10.0  # a program that ran this long has not failed to start
_POLL_MS = 100  # how soon ``stopping`` takes effect
_TERMINATE_S = 0.2  # for a program to end after SIGTERM
_DRAIN_S = 1.0  # for a program to play what is left in its buffer


class Player:
    """One thread uses it, apart from ``problem`` and ``stopping``. Writes wait for the program, but for 2 s at most."""

    def __init__(self, command: Sequence[str], device: str, stopping: threading.Event) -> None:
        self.problem = ""  # why nothing is played; empty while sound is played
        self.restarts = 0  # of a program that ended by itself
        self.dropped = 0  # chunks without a program to play them
        self.doing = ""  # what is being played, for display
        self._command, self._device, self._stopping = command, device, stopping
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe = -1  # its standard input, while there is one
        self._format = (0, 0)  # rate, channels
        self._started_at = self._retry_at = self._played_at = float("-inf")
        self._back_off_s = _BACK_OFF_S
        if shutil.which(command[0]) is None:
            self._failed(f"{command[0]} is not installed", time.monotonic())

    def play(self, chunk: Chunk) -> None:
        """Write it to the program; drop it if there is none."""
        now = self._played_at = time.monotonic()
        if self._process is not None and (chunk.rate, chunk.channels) != self._format:
            if now - self._started_at < _CHANGE_S:
                self.dropped += 1
                return
            self._end(_DRAIN_S)
        if self._process is None and now >= self._retry_at:
            self._process = self._start(chunk, now)
        if self._process is None:
            self.dropped += 1
        else:
            self._write(self._process, chunk.pcm)

    def idle(self) -> None:
        """Call this while nothing is to be played: ends the program after SILENCE_S."""
        if self._process is not None and time.monotonic() - self._played_at > SILENCE_S:
            self._end(_DRAIN_S)

    def close(self) -> None:
        self._end(0.0)

    def _start(self, chunk: Chunk, now: float) -> subprocess.Popen[bytes] | None:
        words = filled(self._command, rate=chunk.rate, channels=chunk.channels, device=self._device)
        self._format, self._started_at = (chunk.rate, chunk.channels), now
        source, sink = os.pipe()
        _shorten(sink)
        os.set_blocking(sink, False)
        try:
            process = subprocess.Popen(words, stdin=source, stdout=subprocess.DEVNULL)
        except OSError as error:
            os.close(sink)
            missing = isinstance(error, FileNotFoundError)
            self._failed(f"{words[0]} is not installed" if missing else f"cannot run {words[0]}: {error}", now)
            return None
        finally:
            os.close(source)
        self._pipe = sink
        self.doing = f"plays {chunk.rate / 1000:g} kHz, {chunk.channels} channel{'s' if chunk.channels > 1 else ''}"
        return process

    def _write(self, process: subprocess.Popen[bytes], data: bytes) -> None:
        left = memoryview(data)
        deadline = time.monotonic() + _STUCK_S
        poll = select.poll()
        poll.register(self._pipe, select.POLLOUT)
        while left and not self._stopping.is_set():
            try:
                left = left[os.write(self._pipe, left) :]
            except BlockingIOError:
                poll.poll(_POLL_MS)
            except OSError:
                self._died(f"{self._command[0]} has ended: {_exit(process)}")
                return
            if time.monotonic() > deadline:
                self._died(f"{self._command[0]} takes no more sound")
                return
        if self.problem and time.monotonic() - self._started_at > _BACK_OFF_S:
            log.info("sound is played again")
            self.problem = ""

    def _died(self, problem: str) -> None:
        self.restarts += 1
        self._end(0.0)
        self._failed(problem, time.monotonic())

    def _failed(self, problem: str, now: float) -> None:
        if now - self._started_at > _STEADY_S:
            self._back_off_s = _BACK_OFF_S
        if problem != self.problem:
            log.warning("no sound: %s", problem)
        self.problem = problem
        self._retry_at = now + self._back_off_s
        self._back_off_s = min(2 * self._back_off_s, _LONGEST_BACK_OFF_S)

    def _end(self, drain_s: float) -> None:
        """Close its input, which ends it once it has played everything; terminate it after ``drain_s``."""
        process, self._process, self.doing = self._process, None, ""
        if process is None:
            return
        os.close(self._pipe)
        for wait_s, then in ((drain_s, process.terminate), (_TERMINATE_S, process.kill)):
            try:
                process.wait(wait_s)
                return
            except subprocess.TimeoutExpired:
                then()
        process.wait()


def _shorten(pipe: int) -> None:
    """Let little sound wait in a pipe, where the system can; otherwise it is heard later."""
    with suppress(ImportError, OSError):  # Windows has no fcntl
        import fcntl

        if hasattr(fcntl, "F_SETPIPE_SZ"):  # Linux only
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def _exit(process: subprocess.Popen[bytes]) -> str:
    try:
        code = process.wait(_TERMINATE_S)
    except subprocess.TimeoutExpired:
        return "it has closed its input"
    return f"exit code {code}" if code >= 0 else f"signal {-code}"


def filled(command: Sequence[str], *, rate: int, channels: int, device: str) -> list[str]:
    """The words of a player's command with their places filled in."""
    values = {"{rate}": str(rate), "{channels}": str(channels), "{device}": device}
    words = list(command)
    for name, value in values.items():
        words = [word.replace(name, value) for word in words]
    return words
