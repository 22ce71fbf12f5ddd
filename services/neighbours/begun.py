"""The newest run of each other robot that has begun here: each begins once, also over a restart of this program."""

import os
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import msgspec

from pebble.contract.payloads import LAST_RUN
from pebble.motion.arbiter import newer

_decode = msgspec.json.Decoder(dict[str, Annotated[int, msgspec.Meta(gt=0, le=LAST_RUN)]]).decode


class Begun:
    """``names`` are the robots that may begin any. A run that is not newer than the last one of its robot never does.

    A file that cannot be read, or written, lets none begin until it is there again: else one that a person has stopped
    would go on after a restart.
    """

    def __init__(self, path: Path, names: Collection[str]) -> None:
        self._path, self._names = path, names

    def begin(self, name: str, run: int) -> str:
        """Return why this run cannot begin; empty: it has, and does not again."""
        try:
            newest = _decode(self._path.read_bytes())
        except FileNotFoundError:
            newest = {}
        except (OSError, msgspec.MsgspecError):
            return f"{self._path} cannot be read: delete it while the scripts of other robots are stopped"
        if not newer(run, newest.get(name, 0)):
            return "it was ended here: start it again"
        try:
            self._write({other: last for other, last in newest.items() if other in self._names} | {name: run})
        except OSError as error:
            return f"{self._path} cannot be written: {error.strerror}"
        return ""

    def _write(self, newest: dict[str, int]) -> None:
        new = self._path.with_suffix(".new")
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        new.unlink(missing_ok=True)
        with new.open("xb") as file:
            file.write(msgspec.json.encode(newest))
            file.flush()
            os.fsync(file.fileno())
        new.replace(self._path)
