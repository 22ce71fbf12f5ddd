"""A board without hardware: the real MicroPython in Node.js, behind a pseudo terminal in place of a serial port."""

from __future__ import annotations

import os
import subprocess
import threading
import tty
from types import TracebackType
from typing import Self

from tests.firmware.micropython import SCRIPTS, VM
from tests.support import Child


class NodeBoard:
    """``port`` is the path of its terminal; files and prompt are MicroPython's own, also after a reset."""

    def __init__(self, *, rom: bool = False) -> None:
        """``rom``: with a ROM file system, from which code runs in place."""
        self._options = ["rom"] if rom else []

    def __enter__(self) -> Self:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._process = Child(
            ["node", str(SCRIPTS / "repl.mjs"), str(VM), *self._options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        stdin, stdout = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.write(self._master, os.read(stdout, 4096))  # the banner: it has booted
        for source, target in ((self._master, stdin), (stdout, self._master)):
            threading.Thread(target=_pump, args=(source, target), daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._process.kill()
        self._process.wait(10)
        os.close(self._slave)


def _pump(source: int, target: int) -> None:
    try:
        while data := os.read(source, 4096):
            os.write(target, data)
    except OSError:  # one end is closed
        pass
