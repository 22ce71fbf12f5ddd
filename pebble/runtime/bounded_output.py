"""Makes lines for a log from a program's output: limited in length and number, with a count of dropped lines."""

import re
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from pebble.runtime.lines import LineSplitter

LINES_PER_S: Final = 100.0
_BURST_S = 2.0  # so many seconds' lines at once, after a silence
KEPT: Final = 10  # last ones of the lines that are left out: a program that fails says why at its end
PAUSE_S: Final = 0.02  # between two reads of a program that floods: it has to wait
_SKIM = 4096  # bytes of a chunk that are read during a flood
_REPEATS_S = 1.0  # within which the same line again is a repetition
_QUIET_S, _REPORT_S = 0.5, 5.0  # the missing lines are said so long after the end of the flood, or so often in it
_match_time = re.compile(rb"\d\d:\d\d:\d\d(?:[.,]\d+)? ").match


class BoundedOutput:
    """A filter that passes at most ``rate`` lines a second of a program's output to ``write``. Times are passed in.

    A line that is repeated at once is written once. A line that counts dropped ones looks like a line of our programs.
    """

    def __init__(self, write: Callable[[bytes], None], longest: int, now: float, *, rate: float = LINES_PER_S) -> None:
        """Make a filter. ``longest``: the most bytes of a line; the rest of the line is cut off."""
        self.flooded = False  # by the newest chunk: the reader may take its time
        self._write, self._rate, self._most = write, rate, rate * _BURST_S
        self._lines = LineSplitter(longest, truncate=True)
        self._tokens, self._filled_at = self._most, now  # lines that may pass now, and when that was computed
        self._newest, self._newest_at, self._repeats = b"", now, 0  # line, without its time, and its repetitions
        self._left_out = 0  # lines that were not written yet, because too many came
        self._kept: deque[bytes] = deque(maxlen=KEPT)  # the newest of those: written later, behind a count of the rest
        self._suppressed_at, self._said_at = float("-inf"), now  # when a line was last not written, and a count was

    @property
    def waits(self) -> bool:
        """True if dropped lines were not yet counted in the log: then call :meth:`tick` from time to time."""
        return self._left_out + self._repeats > 0

    def feed(self, data: bytes, now: float) -> None:
        """Handle a chunk of output."""
        self.tick(now)
        if self.flooded and len(data) > 2 * _SKIM:  # the flood goes on: only its end is read
            data = self._skim(data, now)
        for line in self._lines.feed(data):
            self._line(line.rstrip(), now)
        self.flooded = self._suppressed_at == now  # a line of this chunk was dropped

    def _skim(self, data: bytes, now: float) -> bytes:
        """Return the last lines of a large chunk; count the others without reading them."""
        begin = data.rfind(b"\n", 0, -_SKIM) + 1
        if begin > 0:
            self._left_out, self._suppressed_at = self._left_out + data.count(b"\n", 0, begin), now
            self._lines.reset()
        return data[begin:]

    def tick(self, now: float) -> None:
        """Compute how many lines may pass now, as :meth:`feed` needs it; write the number of dropped ones if due."""
        self._tokens = min(self._most, self._tokens + (now - self._filled_at) * self._rate)
        self._filled_at = now
        quiet = now - self._suppressed_at >= _QUIET_S
        if self.waits and (quiet or now - self._said_at >= _REPORT_S):
            self._said_at = now
            self._say()

    def end(self) -> None:
        """Write the last count of dropped lines, and the unfinished line."""
        self._say()
        unfinished = self._lines.rest().rstrip()
        if unfinished:
            self._write(unfinished)

    def _line(self, line: bytes, now: float) -> None:
        time_at_start = _match_time(line)
        text = line[time_at_start.end() :] if time_at_start else line
        if not text:
            return
        if text == self._newest and now - self._newest_at < _REPEATS_S:
            self._repeats, self._suppressed_at = self._repeats + 1, now
        else:
            self._say_repeats()
            self._newest = text
            self._pass(line, now)
        self._newest_at = now

    def _pass(self, line: bytes, now: float) -> None:
        if self._tokens >= 1 and not self._left_out:
            self._tokens -= 1
            self._write(line)
        else:
            self._left_out, self._suppressed_at = self._left_out + 1, now
            self._kept.append(line)

    def _say(self) -> None:
        """Write how many lines are dropped, and then the newest lines, which have waited."""
        self._say_repeats()
        if missing := self._left_out - len(self._kept):
            self._log("WARNING", f"{missing} lines are left out: {self._rate:g} a second are logged")
        for line in self._kept:
            self._write(line)
        self._left_out = 0
        self._kept.clear()

    def _say_repeats(self) -> None:
        repeats, self._repeats = self._repeats, 0
        if self._left_out:
            self._left_out += repeats
        elif repeats:
            self._log("INFO", f"the line before came {repeats} more times")

    def _log(self, level: str, text: str) -> None:
        self._write(f"{time.strftime('%H:%M:%S')} [{level}] {text}".encode())
