"""A file system of a few megabytes, which a test fills, removes and brings back."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class SmallDisk:
    """The file system, mounted at ``root`` from :meth:`mount` on, which only root may do."""

    def __init__(self, root: Path, *, mebibytes: int = 2) -> None:
        self.root, self._size = root, mebibytes
        self._mounts = 0
        root.mkdir(exist_ok=True)

    def mount(self, *options: str) -> None:
        """Mount an empty one, over an earlier one, which is hidden."""
        words = [
            "mount",
            "-t",
            "tmpfs",
            "-o",
            ",".join((f"size={self._size}m", "mode=755", *options)),
            "none",
            str(self.root),
        ]
        subprocess.run(words, check=True)
        self._mounts += 1

    def unmount(self) -> None:
        """Unmount it. Open files stay usable, as on a stick that is pulled out."""
        subprocess.run(["umount", "-l", str(self.root)], check=True)
        self._mounts -= 1

    @contextmanager
    def full(self) -> Iterator[None]:
        filler = self.root / "filler"
        with suppress(OSError), filler.open("wb", buffering=0) as file:
            while file.write(bytes(4096)):
                pass
        try:
            yield
        finally:
            filler.unlink()

    @contextmanager
    def read_only(self) -> Iterator[None]:
        """Refuse each write during the block, as after an error of the medium."""
        for how in ("ro", "rw"):
            subprocess.run(["mount", "-o", f"remount,{how}", str(self.root)], check=True)
            if how == "ro":
                yield

    def close(self) -> None:
        while self._mounts:
            self.unmount()
