"""A pipe that wakes a thread which polls file descriptors."""

import os
from contextlib import suppress


class WakeupPipe:
    """One thread polls it beside its devices, any other sets it; a set before a poll counts."""

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._reader, False)
        os.set_blocking(self._writer, False)

    def fileno(self) -> int:
        return self._reader

    def set(self) -> None:
        with suppress(BlockingIOError):  # full: it wakes up anyway
            os.write(self._writer, b"!")

    def clear(self) -> None:
        with suppress(BlockingIOError):
            os.read(self._reader, 65_536)

    def close(self) -> None:
        os.close(self._reader)
        os.close(self._writer)
