"""The program that plays sound. It is started when there is sound to play, and restarted when it ends."""

import fcntl
import logging
import os
import select
import shutil
import signal
import subprocess
import threading
import time
from contextlib import suppress

from pebble.extensions.media.child import Child, how_ended
from pebble.extensions.media.config import AudioReceiver
from pebble.extensions.media.jitter import Chunk
from pebble.runtime.environment import child_environment

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
    """A program that plays sound. A write waits for the program, at most 2 s.

    One thread uses it, except ``problem`` and ``stopping``.
    """

    def __init__(self, options: AudioReceiver, stopping: threading.Event) -> None:
        self.problem = ""  # why nothing is played; empty while sound is played
        self.restarts = 0  # of a program that ended by itself
        self.dropped = 0  # chunks without a program to play them
        self.doing = ""  # what is being played, for display
        self._options, self._name, self._stopping = options, options.command[0], stopping
        self._child: Child | None = None
        self._pipe = -1  # its standard input, while there is one
        self._format = (0, 0)  # rate, channels
        self._started_at = float("-inf")  # when the program was last started
        self._played_at = float("-inf")  # when a chunk last came
        self._retry_at = float("-inf")  # when the program may be started again
        self._back_off_s = _BACK_OFF_S  # how long it waits after the next failure
        if shutil.which(self._name) is None:
            self._failed(f"{self._name} is not installed", time.monotonic())

    def play(self, chunk: Chunk) -> None:
        """Write samples to the program; drop them if it cannot be started, or was just started for another format."""
        now = self._played_at = time.monotonic()
        if self._child is not None and (chunk.rate, chunk.channels) != self._format:
            if now - self._started_at < _CHANGE_S:
                self.dropped += 1
                return
            self._end(_DRAIN_S)
        if self._child is None and now >= self._retry_at:
            self._child = self._start(chunk, now)
        if self._child is None:
            self.dropped += 1
        else:
            self._write(self._child, chunk.pcm)

    def idle(self) -> None:
        """End the program after SILENCE_S. Call this while there is nothing to play."""
        if self._child is not None and time.monotonic() - self._played_at > SILENCE_S:
            self._end(_DRAIN_S)

    def close(self) -> None:
        self._end(0.0)

    def _start(self, chunk: Chunk, now: float) -> Child | None:
        command = self._options.words(chunk.rate, chunk.channels)
        self._format, self._started_at = (chunk.rate, chunk.channels), now
        try:
            child = Child(command, child_environment(), stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
        except (OSError, ValueError) as error:
            missing = isinstance(error, FileNotFoundError)
            self._failed(f"{self._name} is not installed" if missing else f"cannot run {self._name}: {error}", now)
            return None
        self._pipe = child.pipe("stdin").fileno()
        os.set_blocking(self._pipe, False)
        with suppress(OSError):  # little sound waits in the pipe, where the system allows that
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self.doing = f"plays {chunk.rate / 1000:g} kHz, {chunk.channels} channel{'s' if chunk.channels > 1 else ''}"
        return child

    def _write(self, child: Child, data: bytes) -> None:
        """Write samples to the program. One that has ended, or takes nothing for _STUCK_S, is started again later."""
        unwritten = memoryview(data)
        deadline = time.monotonic() + _STUCK_S
        poll = select.poll()
        poll.register(self._pipe, select.POLLOUT)
        while unwritten and not self._stopping.is_set():
            try:
                unwritten = unwritten[os.write(self._pipe, unwritten) :]
            except BlockingIOError:
                poll.poll(_POLL_MS)
            except OSError:
                code = child.wait(_TERMINATE_S)
                why = "it has closed its input" if code is None else how_ended(code)
                self._died(f"{self._name} has ended: {why}")
                return
            if time.monotonic() > deadline:
                self._died(f"{self._name} takes no more sound")
                return
        # A program that fails soon after its start may have taken some sound before that.
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
        """Close the program's input, so that it ends after playing everything; terminate it after ``drain_s``."""
        child, self._child, self.doing = self._child, None, ""
        if child is None:
            return
        child.pipe("stdin").close()
        if child.wait(drain_s) is None:
            child.signal(signal.SIGTERM)
        child.finish(_TERMINATE_S)
