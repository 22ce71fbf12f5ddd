"""The output of a script as lines for the robot's log: bounded in length and in number."""

from collections.abc import Callable

from pebble.runtime.lines import LineSplitter

LINES_PER_S = 200
LONGEST_LINE = 3500  # bytes; with its tag it fits into one write that no other can interrupt (PIPE_BUF)

Write = Callable[[bytes], None]


class Output:
    """Takes chunks of a script's output, and passes at most 200 lines a second to ``write``.

    ``warn`` gets a line with the number of the rest.
    """

    def __init__(self, write: Write, warn: Callable[[str], None], now: float) -> None:
        self._write, self._warn = write, warn
        self._lines = LineSplitter(LONGEST_LINE, truncate=True)
        self._window, self._left, self._dropped = now, LINES_PER_S, 0

    @property
    def flooded(self) -> bool:
        """Whether lines are being dropped: the reader may take its time."""
        return self._left == 0

    def feed(self, data: bytes, now: float) -> None:
        self.tick(now)
        for line in self._lines.feed(data):
            self._line(line)

    def tick(self, now: float) -> None:
        """Begin a new second if the last one is over, and report what was dropped in it."""
        if now - self._window >= 1.0:
            self._report()
            self._window, self._left = now, LINES_PER_S

    def end(self) -> None:
        """The stream has ended: what is left is a line."""
        rest = self._lines.rest()
        if rest:
            self._line(rest)
        self._report()

    def _line(self, line: bytes) -> None:
        line = line.rstrip()
        if not line:
            return
        if self._left == 0:
            self._dropped += 1
            return
        self._left -= 1
        self._write(line)

    def _report(self) -> None:
        if self._dropped:
            self._warn(f"{self._dropped} lines dropped: only {LINES_PER_S} lines per second are logged")
            self._dropped = 0
