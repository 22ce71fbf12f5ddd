"""A small file that survives a power cut. A thread of its own writes it, because a disk may take seconds."""

import json
import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pebble.errors import PebbleError
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.runtime.whole_file import make_folder, write
from pebble.transports.own_file import OwnFile

log = logging.getLogger(__name__)

_LONGEST = 16_384  # bytes; more is no file of ours
CONTAINER = "PEBBLE_CONTAINER"  # set in the environment of a container
LOST = ("/", "/tmp", "/run", "/dev/shm")  # noqa: S108 - its layer and what is in memory end with the container
_END_S = 1.0  # longest wait for a write that is under way when closing


class Unreadable:
    """The content of a file that exists and cannot be read."""


class StateFile:
    """A file with the newest value passed to :meth:`save`, as JSON; older values that wait are not written.

    ``on_saved(number, ok)`` is called on the writing thread after each attempt, with the number that ``save`` returned.
    """

    def __init__(self, path: Path, on_saved: Callable[[int, bool], None] = lambda _number, _succeeded: None) -> None:
        self.path = path
        self._on_saved = on_saved
        self._changed = threading.Condition()
        self._newest: tuple[int, Any] | None = None  # the number of the write and its value, until it begins
        self._number = 0
        self._writing = False
        self._closing = False
        self._thread: threading.Thread | None = None
        self._log = RateLimitedLog(log)
        self._own: OwnFile | None = None  # as this process wrote it last

    @property
    def in_place(self) -> bool:
        """True unless the file that this process wrote was removed or replaced since."""
        try:
            return self._own is None or self._own.in_place
        except OSError:  # what is there cannot be seen
            return True

    def can_save(self) -> bool:
        """True if a write may be tried: its folder can be written or made, or is :attr:`lost`: a write reports that."""
        existing = next(folder for folder in self.path.parents if os.access(folder, os.F_OK))
        return self.lost or (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK))

    @property
    def lost(self) -> bool:
        """True if this is a container and no volume holds the folder: the next container will not have the file."""
        if CONTAINER not in os.environ:
            return False
        return str(next(folder for folder in Path(os.path.realpath(self.path)).parents if folder.is_mount())) in LOST

    def load(self) -> Any:
        """Return the value that was saved last; None without a file, Unreadable() if it is damaged."""
        try:
            file = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)  # else a FIFO in its place waits for ever
            try:
                raw = os.read(file, _LONGEST + 1)
            finally:
                os.close(file)
            value = json.loads(raw) if len(raw) <= _LONGEST else None
            return Unreadable() if value is None else value  # null is never saved
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            why = getattr(error, "strerror", None) or "it is damaged"
            self._log.log("unreadable", logging.ERROR, "%s cannot be read: %s", self.path, why)
            return Unreadable()

    def appeared(self) -> Any:
        """Return what :meth:`load` reads if the file there is not this process's own (a disk came late); else None."""
        try:
            return None if self._own is not None and not self._own.replaced else self.load()
        except OSError:
            return None

    def save(self, value: Any) -> int:
        """Let the thread write ``value`` soon; return the number of this write."""
        with self._changed:
            self._number += 1
            self._newest = self._number, value
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=f"pebble-save {self.path.name}", daemon=True)
                self._thread.start()
            self._changed.notify()
            return self._number

    @property
    def busy(self) -> bool:
        """True if a value waits to be written, or is being written; ``on_saved`` will follow."""
        with self._changed:
            return self._newest is not None or self._writing

    def close(self) -> None:
        """Wait, bounded, until the newest value is written."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(_END_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._newest is None and not self._closing:
                    self._changed.wait()
                if self._newest is None:
                    return
                number, value = self._newest
                self._newest, self._writing = None, True
            succeeded = self._write(value)
            with self._changed:
                self._writing = False
            self._on_saved(number, succeeded)

    def _write(self, value: Any) -> bool:
        """Replace the file in one step. After a power cut it holds the old value or the new one."""
        try:
            make_folder(self.path.parent)
            write(self.path, json.dumps(value).encode(), 0o600, PebbleError)
            self._own = OwnFile(self.path)
            if self.lost:  # written all the same: this container can read it
                raise PebbleError(f"NOT SAVED: no volume holds {self.path.parent}, so a stop ends with this container")
        except (PebbleError, OSError) as error:
            self._log.log("failed", logging.ERROR, "the state cannot be written: %s", error)
            return False
        return True
