"""Cut a stream of bytes into lines, or frames, of limited length."""

from __future__ import annotations

LINE_LIMIT = 256  # bytes; the longest line of any text protocol here is under 150


class LineSplitter:
    """Chunks in, complete lines out; what is longer than ``limit`` bytes is thrown away up to the next ``end``.

    ``discarded_lines`` and ``discarded_bytes`` count what was thrown away.
    """

    def __init__(self, limit: int = LINE_LIMIT, end: bytes = b"\n") -> None:
        self.discarded_lines = 0
        self.discarded_bytes = 0
        self._limit, self._separator = limit, end
        self._tail = b""
        self._skipping = False

    def feed(self, chunk: bytes) -> list[bytes]:
        """The lines that ``chunk`` completes, without their end; a CR is left for the protocol to ignore."""
        *complete, tail = chunk.split(self._separator)
        lines = [line for part in complete if (line := self._end(part)) is not None]
        self._grow(tail)
        return lines

    def reset(self) -> None:
        """Forget an unfinished line: the stream begins anew."""
        self._tail = b""
        self._skipping = False

    def _end(self, part: bytes) -> bytes | None:
        self._grow(part)
        line = None if self._skipping else self._tail
        self.reset()
        return line

    def _grow(self, part: bytes) -> None:
        if self._skipping:
            self.discarded_bytes += len(part)
            return
        self._tail += part
        if len(self._tail) > self._limit:
            self.discarded_lines += 1
            self.discarded_bytes += len(self._tail)
            self._tail = b""
            self._skipping = True
