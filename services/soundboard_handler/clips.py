"""The folder of clips: lists them, and finds the clip that a command names."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import accumulate, islice
from pathlib import Path

from msgspec import Struct

from pebble.config.visible import is_text
from pebble.contract.identity import meant
from pebble.extensions.media import pyav

_WAV = ".wav"
_NEED_PYAV = (".mp3", ".ogg", ".flac")
_MOST = 100_000  # files that a scan looks at: the folder may be / by mistake
_LONGEST_LIST = 256 * 1024  # bytes of all names: the list is published again and again, to every operator


class Clip(Struct, frozen=True):
    """A sound file; ``name`` is its path in the folder, with slashes."""

    name: str
    path: Path

    @property
    def encoded(self) -> bool:
        """True if only PyAV can read it."""
        return self.path.suffix.lower() != _WAV


class Clips:
    """The clips below ``folder``. ``problem``: what the last scan could not read; empty if it has read everything."""

    def __init__(self, folder: Path) -> None:
        self.problem = ""
        self._folder = folder
        self._endings = (_WAV, *_NEED_PYAV) if pyav.installed() else (_WAV,)

    def scan(self) -> list[str]:
        """Return the names of clips, sorted without regard to case.

        At most 256 KiB of names; ``find`` also knows those beyond. A link to a file outside of the folder is left out,
        also by ``find``.
        """
        self.problem = ""
        root = self._root
        names = (path[len(str(root)) :].lstrip("/") for path in self._paths())
        clips = sorted(filter(self._can_be_named, names), key=lambda name: (name.lower(), name))
        sizes = accumulate(len(name.encode()) for name in clips)  # of the list up to each clip
        listed = len([size for size in sizes if size <= _LONGEST_LIST])
        if listed < len(clips):
            # A problem that `_files` has met meanwhile counts first.
            self.problem = self.problem or f"only the first {listed} of {len(clips)} are listed"
        return clips[:listed]

    def find(self, name: str) -> Clip | None:
        """Return the clip that a command names; None if there is none. Raises PebbleError if the name fits several.

        The name is relative to the folder, or absolute inside it. An é in it may be one character or two.
        """
        path = self._path(name)
        clip = self._clip(path, name)
        if clip is None and path is not None and path.suffix.lower() in self._endings and not name.isascii():
            clip = self._clip(self._path(meant(self._paths(), str(path))), name)
        return clip

    @property
    def _root(self) -> Path:
        """The folder, with links resolved; as it is written if its links lead in a circle."""
        return Path(os.path.realpath(self._folder))

    def _path(self, name: str) -> Path | None:
        """Return the path that a name means, with links resolved; None if it means none."""
        try:
            return (self._root / _expanded(name.replace("\\", "/"))).resolve()
        except (OSError, RuntimeError, ValueError):  # links in a circle, no text of a path
            return None

    def _clip(self, path: Path | None, name: str) -> Clip | None:
        """Return the clip at this path, or None. It is called ``name`` if its path cannot be written as UTF-8."""
        root = self._root
        if path is None or not path.is_relative_to(root) or path.suffix.lower() not in self._endings:
            return None
        try:
            if not path.is_file():
                return None
        except OSError:  # too long
            return None
        inside = path.relative_to(root).as_posix()
        return Clip(inside if is_text(inside) else name, path)  # ``name`` is that of a link to it

    def _paths(self) -> Iterator[str]:
        """Yield the paths of the clips among the first _MOST files, in the folder's order and spelling."""
        return filter(self._is_clip, islice(self._files(self._root), _MOST))

    def _files(self, root: Path) -> Iterator[str]:
        def failed(error: OSError) -> None:
            self.problem = self.problem or f"{error.filename} cannot be read: {error.strerror}"

        for folder, _, files in os.walk(root, onerror=failed):
            for file in files:
                yield f"{folder}/{file}"

    def _is_clip(self, path: str) -> bool:
        if not path.lower().endswith(self._endings):
            return False
        if os.path.islink(path):  # noqa: PTH114 - there may be thousands
            return self._clip(self._path(path), path) is not None
        return os.path.isfile(path)  # noqa: PTH113

    def _can_be_named(self, name: str) -> bool:
        """True if a command can name the clip: commands are UTF-8, and a backslash in them is a slash."""
        if "\\" not in name and is_text(name):
            return True
        self.problem = self.problem or f"{name!r} cannot be named in commands: rename it"
        return False


def _expanded(name: str) -> Path:
    try:
        return Path(name).expanduser()
    except RuntimeError:  # no user of that name: a file whose name begins with ~
        return Path(name)
