"""Finishes files beside the writer: complete ones, and those that a kill or a full disk left unfinished."""

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

from pebble.extensions.recordings.files.recorded import SUFFIX, RecordingError, finished_path
from pebble.extensions.recordings.files.rewrite import Rewritten, rewrite
from pebble.extensions.recordings.recorder.background import Background
from pebble.extensions.recordings.recorder.folder import DAMAGED, rename
from pebble.extensions.recordings.recorder.lane import OpenFile
from pebble.runtime.whole_file import sync_folder

log = logging.getLogger(__name__)


def mend(path: Path) -> Rewritten:
    """Finish a file that a killed recorder has left.

    The original is deleted if only an incomplete record is lost, else kept as ``….mcap.damaged``. Raises
    RecordingError, OSError.
    """
    target = finished_path(path)
    copy = rewrite(path, target)
    if not copy.messages:
        target.unlink()
    sync_folder(path.parent)
    if copy.is_whole:
        path.unlink()
    else:
        rename(path, _damaged_path(path))
    return copy


def _damaged_path(path: Path) -> Path:
    return finished_path(path).with_suffix(SUFFIX + DAMAGED)


class Finisher:
    """A queue of files to finish, for ``background``. ``event`` records what became of an unfinished file."""

    def __init__(self, background: Background, event: Callable[..., None], on_finished: Callable[[], None]) -> None:
        self._background, self._event, self._on_finished = background, event, on_finished
        self._unfinished: set[Path] = set()

    def finish(self, file: OpenFile) -> None:
        self._background.do(partial(self._finish, file))

    def mend(self, path: Path) -> None:
        """Queue a file that was left unfinished."""
        self._background.do(partial(self._mend, path))

    def postpone(self, path: Path) -> None:
        """Queue a file until there is room again."""
        self._unfinished.add(path)

    def retry(self) -> None:
        """Try the postponed files again."""
        for path in list(self._unfinished):
            self.mend(path)

    # -- the background thread

    def _finish(self, file: OpenFile) -> None:
        try:
            file.finish()
        except OSError as error:
            self._later(file.path, error)
            return
        self._on_finished()

    def _mend(self, path: Path) -> None:
        if not path.exists():
            self._unfinished.discard(path)
            return
        try:
            copy = mend(path)
        except RecordingError as error:
            self._set_aside(path, str(error))
            return
        except OSError as error:
            self._later(path, error)
            return
        self._unfinished.discard(path)
        if not copy.is_whole:
            self._event("damaged", file=path.name, why=copy.unread)
        if copy.messages:
            self._event("recovered", file=path.name, messages=copy.messages, missing=copy.missing)
            self._on_finished()

    def _set_aside(self, path: Path, why: str) -> None:
        try:
            rename(path, _damaged_path(path))
        except OSError as error:
            self._later(path, error)
            return
        self._unfinished.discard(path)
        self._event("damaged", file=path.name, why=why)

    def _later(self, path: Path, error: OSError) -> None:
        """Leave a file unfinished until there is room, and log that once. It can be read meanwhile."""
        if path not in self._unfinished:
            log.warning("%s is not finished yet: %s", path.name, error.strerror or error)
        self._unfinished.add(path)
