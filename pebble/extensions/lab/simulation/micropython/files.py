"""The file system of a simulated board, which survives resets and power cuts."""

import errno
import io
from collections.abc import Callable
from pathlib import Path
from typing import IO

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.micropython.faults import failure


class Files(dict[str, bytes]):
    """The contents of files by absolute path. With ``folder`` they are read from there, and changes are written there.

    As with LittleFS, a written file changes when it is closed, and a rename replaces its target at once. ``before(what,
    path, data)`` is called before each change by the firmware; ``what`` is "write" or "rename". It may raise an
    OSError, or an exception of a test, in place of a power cut. Raises DeviceError for a folder that cannot be used.
    """

    def __init__(self, folder: Path | None = None) -> None:
        super().__init__()
        self.before: Callable[[str, str, bytes], None] = lambda _what, _path, _data: None
        self._folder = folder
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                self.update({f"/{file.name}": file.read_bytes() for file in folder.iterdir() if file.is_file()})
            except OSError as error:
                raise DeviceError(f"{error.filename}: {error.strerror}") from None

    def open(self, path: str, mode: str = "r") -> IO[bytes] | IO[str]:
        """Open a file as the firmware's ``open`` does: to read it, or to write it as a whole."""
        raw: io.BytesIO
        if mode in ("w", "wb"):
            raw = _Written(self, path)
        elif mode in ("r", "rb"):
            raw = io.BytesIO(self._existing(path))
        else:
            raise failure(errno.EINVAL)
        return raw if "b" in mode else io.TextIOWrapper(raw, "utf-8")

    def write(self, path: str, data: bytes) -> None:
        self.before("write", path, data)
        self[path] = data
        if self._folder is not None:
            self._at(self._folder, path).write_bytes(data)

    def rename(self, old: str, new: str) -> None:
        self.before("rename", new, self._existing(old))
        self[new] = self.pop(old)
        if self._folder is not None:
            self._at(self._folder, old).replace(self._at(self._folder, new))

    def listdir(self, folder: str = "/") -> list[str]:
        return [path.removeprefix(folder) for path in self if path.startswith(folder)]

    @staticmethod
    def _at(folder: Path, path: str) -> Path:
        return folder / path.lstrip("/")

    def _existing(self, path: str) -> bytes:
        if path not in self:
            raise failure(errno.ENOENT)
        return self[path]


class _Written(io.BytesIO):
    """A file that is open for writing."""

    def __init__(self, files: Files, path: str) -> None:
        super().__init__()
        self._files, self._path = files, path

    def close(self) -> None:
        if not self.closed:
            data = self.getvalue()
            super().close()
            self._files.write(self._path, data)
