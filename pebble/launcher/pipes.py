"""Reads what one child writes: its output and its notes, line by line."""

from collections.abc import Callable
from contextlib import suppress

from pebble.launcher.child import Child, read_available
from pebble.launcher.log_forwarding import LINE_LIMIT
from pebble.launcher.reactor import Reactor
from pebble.runtime.lines import LineSplitter

_LAST_READS = 16  # 64 KiB each, of what a child left in its pipe when it died

Taker = Callable[[bytes], None]


class Pipes:
    """``on_line`` and ``on_note`` get each line that is not empty, on the reactor's thread, until :meth:`close`."""

    def __init__(self, child: Child, reactor: Reactor, on_line: Taker, on_note: Taker) -> None:
        self._child, self._reactor, self._on_line, self._on_note = child, reactor, on_line, on_note
        self._lines, self._notes = (LineSplitter(LINE_LIMIT, truncate=True) for _ in range(2))
        reactor.watch(child.output, lambda: self._read(child.output, self._lines, on_line))
        reactor.watch(child.notes, lambda: self._read(child.notes, self._notes, on_note))

    def close(self) -> None:
        """The child has ended: read what it left, and the line that it did not finish."""
        _pass_on(self._notes.feed(read_available(self._child.notes) or b""), self._on_note)
        for _ in range(_LAST_READS):
            data = read_available(self._child.output)
            if not data:
                break
            _pass_on(self._lines.feed(data), self._on_line)
        _pass_on([self._lines.rest()], self._on_line)
        for descriptor in (self._child.output, self._child.notes):
            with suppress(KeyError):  # already forgotten at end of file
                self._reactor.forget(descriptor)

    def _read(self, descriptor: int, splitter: LineSplitter, pass_on: Taker) -> None:
        data = read_available(descriptor)
        if data == b"":
            self._reactor.forget(descriptor)  # it closed its end, or has ended
        elif data is not None:
            _pass_on(splitter.feed(data), pass_on)


def _pass_on(lines: list[bytes], pass_on: Taker) -> None:
    for line in lines:
        if line.strip():
            pass_on(line)
