"""A splitter of a stream of bytes into lines, or frames, of limited length."""

LINE_LIMIT = 256  # bytes; the longest line of any text protocol of an MCU is under 150


class LineSplitter:
    """A splitter: takes chunks of any size, and returns complete lines of up to ``limit`` bytes.

    A longer line is discarded up to the next ``end``. With ``truncate``, its first ``limit`` bytes are returned as soon
    as they are complete, and only the rest is discarded.
    """

    def __init__(self, limit: int = LINE_LIMIT, end: bytes = b"\n", *, truncate: bool = False) -> None:
        self.discarded_lines = 0  # lines that were longer than the limit
        self._limit, self._separator, self._truncate = limit, end, truncate
        self._tail = b""  # the unfinished line
        self._skipping = False  # inside the rest of a line that was too long

    def feed(self, chunk: bytes) -> list[bytes]:
        """Return the lines that ``chunk`` completes, without their ends. A CR stays: the protocol ignores it."""
        lines: list[bytes] = []
        *complete, tail = chunk.split(self._separator)
        for part in complete:
            if not self._skipping and len(self._tail) + len(part) <= self._limit:
                lines.append(self._tail + part)
                self._tail = b""
            else:  # the end of a line that is too long
                self._grow(part, lines)
                self.reset()
        self._grow(tail, lines)
        return lines

    def rest(self) -> bytes:
        """Return the unfinished line at the end of the stream."""
        unfinished = self._tail
        self.reset()
        return unfinished

    def reset(self) -> None:
        """Forget an unfinished line, because the stream starts again."""
        self._tail = b""
        self._skipping = False

    def _grow(self, part: bytes, lines: list[bytes]) -> None:
        """Add to the unfinished line; if that is too long, skip its rest, and add its beginning to ``lines``."""
        if self._skipping:
            return
        self._tail += part
        if len(self._tail) > self._limit:
            if self._truncate:
                lines.append(self._tail[: self._limit])
            self.discarded_lines += 1
            self._tail = b""
            self._skipping = True
