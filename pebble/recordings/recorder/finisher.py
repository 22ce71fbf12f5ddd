"""Finishes files beside the writer: complete ones, and what a killed recorder or a full disk has left."""

import logging
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from pebble.recordings.files.finish import CANNOT_BE_READ, Finished
from pebble.recordings.library import SUFFIX
from pebble.recordings.recorder.background import Background
from pebble.recordings.recorder.folder import DAMAGED, finished_path, rename
from pebble.recordings.recorder.lane import OpenFile

log = logging.getLogger(__name__)

_LONGEST_S: Final = 600.0


class Finisher:
    """Queues its work for ``background``. ``event`` writes down what became of a file that was left."""

    def __init__(self, background: Background, event: Callable[..., None], on_finished: Callable[[], None]) -> None:
        self._background, self._event, self._on_finished = background, event, on_finished
        self._unfinished: set[Path] = set()

    def finish(self, file: OpenFile) -> None:
        self._background.do(partial(self._finish, file))

    def mend(self, path: Path) -> None:
        """Finish a file as it was left."""
        self._background.do(partial(self._mend, path))

    def retry(self) -> None:
        """Try again what could not be finished."""
        for path in list(self._unfinished):
            self.mend(path)

    # -- the background thread

    def _finish(self, file: OpenFile) -> None:
        try:
            file.finish()
        except OSError as error:
            self._later(file.path, error.strerror or str(error))
            return
        self._on_finished()

    def _mend(self, path: Path) -> None:
        """Works in a process of its own: reading from a damaged disk may kill it (SIGBUS)."""
        self._unfinished.discard(path)
        if not path.exists():
            return
        command = [sys.executable, "-m", "pebble.recordings.files.finish", str(path)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_LONGEST_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            self._later(path, str(error))
            return
        if done.returncode == 0:
            self._mended(path, msgspec.json.decode(done.stdout, type=Finished))
        elif done.returncode == CANNOT_BE_READ or done.returncode < 0:
            why = done.stderr.strip() or f"its reader was ended by signal {-done.returncode}"
            if self._renamed(path, finished_path(path).with_suffix(SUFFIX + DAMAGED)):
                self._event("damaged", file=path.name, why=why)
        else:
            self._later(path, done.stderr.strip())

    def _mended(self, path: Path, made: Finished) -> None:
        if made.messages == 0 and made.whole:
            path.unlink()
            return
        if not self._renamed(path, finished_path(path)):
            return
        self._event("recovered", file=path.name, messages=made.messages, missing=made.missing, torn=made.torn_bytes)
        self._on_finished()

    def _renamed(self, path: Path, target: Path) -> bool:
        try:
            rename(path, target)
        except OSError as error:
            self._later(path, f"{target.name}: {error.strerror or error}")
            return False
        return True

    def _later(self, path: Path, why: str) -> None:
        """It stays as it is, and can be read, until there is room."""
        log.warning("%s is not finished yet: %s", path.name, why)
        self._unfinished.add(path)
