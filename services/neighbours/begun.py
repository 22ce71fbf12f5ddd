"""The newest run of each other robot that has begun here: each begins once, also over a restart of this program."""

import logging
import os
from collections.abc import Collection
from pathlib import Path

import msgspec

from pebble.contract.payloads import LAST_RUN
from pebble.motion.arbiter import newer

log = logging.getLogger(__name__)

_MOST_BYTES = 4096
_decode = msgspec.json.Decoder(dict[str, int]).decode


class Begun:
    """``names`` are the robots that may begin any. A run that is not newer than the last one of its robot never does.

    A file that cannot be read, or written, lets none begin until it is there again: else one that a person has stopped
    would go on after a restart.
    """

    def __init__(self, path: Path, names: Collection[str]) -> None:
        self._path, self._names = path, names
        self._newest: dict[str, int] | None = self._read()
        if self._newest is None:
            log.error("%s", self._unreadable)

    def begin(self, name: str, run: int) -> str:
        """Why this run cannot begin; empty: it has, and does not again."""
        if self._newest is None:
            self._newest = self._read()
        if self._newest is None:
            return self._unreadable
        if not newer(run, self._newest.get(name, 0)):
            return "it was ended here: start it again"
        after = {known: last for known, last in self._newest.items() if known in self._names} | {name: run}
        if why := self._write(after):
            return why
        self._newest = after
        return ""

    @property
    def _unreadable(self) -> str:
        return f"{self._path} cannot be read: delete it while the scripts of other robots are stopped"

    def _read(self) -> dict[str, int] | None:
        try:
            with self._path.open("rb") as file:
                found = _decode(file.read(_MOST_BYTES))
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.MsgspecError):
            return None
        return found if all(0 < run <= LAST_RUN for run in found.values()) else None

    def _write(self, newest: dict[str, int]) -> str:
        new = self._path.with_suffix(".new")
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            new.unlink(missing_ok=True)
            with new.open("xb") as file:
                file.write(msgspec.json.encode(newest))
                file.flush()
                os.fsync(file.fileno())
            new.replace(self._path)
        except OSError as error:
            return f"{self._path} cannot be written: {error.strerror}"
        return ""
