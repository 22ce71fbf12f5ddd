"""Reads the output and the notes of a child process, line by line."""

from collections.abc import Callable
from contextlib import suppress

from pebble.launcher.child import Child, read_available
from pebble.launcher.log_forwarding import LINE_LIMIT
from pebble.launcher.reactor import Reactor
from pebble.runtime.bounded_output import PAUSE_S, BoundedOutput
from pebble.runtime.lines import LineSplitter
from pebble.runtime.timers import Timer

_LAST_READS = 16  # 64 KiB each, of what a child left in its pipe when it died
_TICK_S = 1.0

Taker = Callable[[bytes], None]


class Pipes:
    """A reader of a child's pipes, until :meth:`close`.

    ``on_line`` gets each line of the output that is not empty, ``on_note`` each note. ``rate``: the most lines of
    output a second; of further ones ``on_line`` gets only their number.
    """

    def __init__(self, child: Child, reactor: Reactor, on_line: Taker, on_note: Taker, *, rate: float) -> None:
        self._child, self._reactor, self._on_note = child, reactor, on_note
        self._output = BoundedOutput(on_line, LINE_LIMIT, reactor.now(), rate=rate)
        self._notes = LineSplitter(LINE_LIMIT, truncate=True)
        self._pause: Timer | None = None  # until the output of a child that floods is read again
        self._tick: Timer | None = None  # while the number of dropped lines has still to be passed on
        self._watch_output()
        reactor.watch(child.notes, self._read_notes)

    def close(self) -> None:
        """Read the rest of the output of an ended child, with its unfinished line."""
        for timer in (self._pause, self._tick):
            if timer is not None:
                timer.cancel()
        self._pass_on(self._notes.feed(read_available(self._child.notes) or b""))
        for _ in range(_LAST_READS):
            data = read_available(self._child.output)
            if not data:
                break
            self._output.feed(data, self._reactor.now())
        self._output.end()
        for descriptor in (self._child.output, self._child.notes):
            with suppress(KeyError):  # already forgotten at end of file, or in a pause
                self._reactor.forget(descriptor)

    def _watch_output(self) -> None:
        self._reactor.watch(self._child.output, self._read_output)

    def _read_output(self) -> None:
        data, now = read_available(self._child.output), self._reactor.now()
        if data == b"":
            self._reactor.forget(self._child.output)  # it closed its end, or has ended
        elif data is not None:
            self._output.feed(data, now)
            if self._output.flooded:
                self._reactor.forget(self._child.output)
                self._pause = self._reactor.after(PAUSE_S, self._watch_output)
            if self._output.waits and self._tick is None:
                self._tick = self._reactor.after(_TICK_S, self._say_dropped)

    def _say_dropped(self) -> None:
        self._output.tick(self._reactor.now())
        self._tick = self._reactor.after(_TICK_S, self._say_dropped) if self._output.waits else None

    def _read_notes(self) -> None:
        data = read_available(self._child.notes)
        if data == b"":
            self._reactor.forget(self._child.notes)
        elif data is not None:
            self._pass_on(self._notes.feed(data))

    def _pass_on(self, notes: list[bytes]) -> None:
        for note in notes:
            if note.strip():
                self._on_note(note)
