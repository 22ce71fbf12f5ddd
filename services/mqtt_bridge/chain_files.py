"""One chain of the audit on disk: two files, of which the older one is replaced when the newer one is full."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from itertools import islice
from pathlib import Path

from pebble.contract import chain
from pebble.contract.chain import Mark
from pebble.services.mqtt_bridge.audit_rows import ROBOT, Row
from pebble.transports.own_file import identity

_BLOCK = 65536  # bytes that are read at a time, from the end


class ChainFiles:
    """Appends to a chain, and reads it. Every method may raise OSError, and then the chain is as before.

    After a power cut the last line may be half of one: it is removed, and the next line tells so.
    """

    def __init__(self, path: Path, most_bytes: int, *, synced: bool = True) -> None:
        self.path, self.older = path, path.with_suffix(".old.jsonl")
        self._most_bytes, self._synced = most_bytes, synced
        self._mark: Mark | None = None  # None: not read yet
        self._torn = 0  # bytes that were removed, which no line tells yet

    @property
    def mark(self) -> Mark:
        return self._mark or Mark()

    def append(self, rows: list[Row]) -> None:
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        mark, torn = (self._mark, 0) if self._mark is not None else self._last()
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK, 0o600)
        try:
            size = os.fstat(file).st_size - torn
            if torn:
                os.ftruncate(file, size)
                self._torn += torn
            if size >= self._most_bytes:
                self.path.replace(self.older)
                full, size = file, 0
                file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o600)
                os.close(full)
            parts: list[bytes] = []
            note = {"t": rows[0]["t"], "what": "torn", "who": ROBOT, "bytes": self._torn}
            for row in [note, *rows] if self._torn else rows:
                first = {"after": mark.h} if size == 0 and not parts else {}
                raw, mark = chain.line(mark, {**row, **first})
                parts.append(raw + b"\n")
            self._write(file, b"".join(parts), size)
            self._mark, self._torn = mark, 0
        finally:
            os.close(file)

    def newest(self, before: int, count: int) -> list[bytes]:
        """Up to ``count`` lines before the one with the number ``before`` (0: the newest), the oldest first."""
        found = (raw for raw in self._backwards() if not before or ((one := chain.parse(raw)) and one.n < before))
        return list(islice(found, count))[::-1]

    def lines(self) -> Iterator[bytes]:
        """All that are whole, the oldest first. Only this may run in another process."""
        with ExitStack() as stack:
            files = {}
            for path in (self.path, self.older):  # the newer one first: it may become the older one meanwhile
                with suppress(FileNotFoundError):
                    file = stack.enter_context(path.open("rb"))
                    files[identity(file.fileno())] = file
            for file in reversed(files.values()):
                yield from (raw[:-1] for raw in file if raw.endswith(b"\n"))

    def _write(self, file: int, content: bytes, size: int) -> None:
        try:
            if os.write(file, content) != len(content):
                raise OSError(28, "No space left on device")
            if self._synced:
                os.fdatasync(file)
        except OSError:
            with suppress(OSError):
                os.ftruncate(file, size)
            raise

    def _last(self) -> tuple[Mark, int]:
        """The mark of the last whole line, and how many bytes behind it are none."""
        torn = 0
        for path in (self.path, self.older):
            for raw in _lines_backwards(path):
                found = chain.parse(raw[:-1]) if raw.endswith(b"\n") else None
                if found is not None:
                    return found.mark, torn
                torn += len(raw)
            if torn:  # nothing there is a line: the file is kept for those who want to look at it
                path.replace(path.with_suffix(".bad"))
                torn = 0
        return Mark(), 0

    def _backwards(self) -> Iterator[bytes]:
        for path in (self.path, self.older):
            yield from (raw[:-1] for raw in _lines_backwards(path) if raw.endswith(b"\n"))


def _lines_backwards(path: Path) -> Iterator[bytes]:
    """The lines of a file with their line feeds, the last one first; none without the file."""
    with suppress(FileNotFoundError), path.open("rb") as file:
        position, rest = file.seek(0, os.SEEK_END), b""
        while position:
            length = min(_BLOCK, position)
            position = file.seek(position - length)
            parts = (file.read(length) + rest).splitlines(keepends=True)
            rest = parts.pop(0)
            yield from reversed(parts)
        if rest:
            yield rest
