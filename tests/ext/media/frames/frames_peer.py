"""Processes that write or read frames.

Each says `up` when it is ready, and answers a line on stdin with what it knows as a line of JSON, until it is killed.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from pebble.extensions.media.frames import FrameInfo, FrameReader, FrameWriter, views
from pebble.runtime.parent import end_with_parent as die_with_parent

_PR_SET_DUMPABLE = 4


def main(role: str, folder: Path, options: dict[str, Any]) -> None:
    """``memlock``: RLIMIT_MEMLOCK in bytes; ``user``: become this user, which takes root."""
    memlock, user = options.pop("memlock", None), options.pop("user", None)
    if memlock is not None:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (memlock, memlock))
    if user not in (None, os.geteuid()):
        become(user)
    peer = {"writer": Writer, "reader": Reader}[role](folder, **options)
    threading.Thread(target=peer.run, daemon=True).start()
    print("up", flush=True)  # noqa: T201
    for _ in sys.stdin:
        print(json.dumps(peer.report()), flush=True)  # noqa: T201


def become(user: int) -> None:
    """Only now that everything is imported: that user may have no access to the folder where we lie."""
    version = views.zenoh_version()
    views.zenoh_version = lambda: version
    os.setgid(user)
    os.setuid(user)
    ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 1)  # else /proc/self is root's
    die_with_parent()  # forgotten with the change of user


class Writer:
    """Writes frames of ``size`` bytes, ``rate`` a second, each filled with its number, so that a torn one shows."""

    def __init__(self, folder: Path, *, size: int = 3 * 64 * 48, rate: float = 100.0) -> None:
        self._size, self._period = size, 1 / rate
        self._frame = np.zeros(size, np.uint8)
        self._writer = FrameWriter(folder, "camera", capacity=size).open()

    def run(self) -> None:
        number = 1
        while True:
            slot = self._writer.slot(self._size)
            array = self._frame if slot is None else slot.array
            array[:] = number % 251
            array[:8].view("<u8")[0] = array[-8:].view("<u8")[0] = number
            info = FrameInfo(captured_ns=time.monotonic_ns(), format="bgr24", width=self._size // 3, height=1)
            number += self._writer.write(array, info) if slot is None else slot.send(info)
            time.sleep(self._period)

    def report(self) -> dict[str, Any]:
        return self._writer.counters.snapshot() | {"wanted": self._writer.wanted, "sharing": self._writer.shared}


class Reader:
    """Counts frames, and those of them that are torn although they are valid."""

    def __init__(self, folder: Path, *, views: bool = False) -> None:
        self._frames = self._wrong = 0
        self._reader = FrameReader(folder, "camera", views=views).open()

    def run(self) -> None:
        for frame in self._reader:
            data = frame.data
            number, last = (int(part.copy().view("<u8")[0]) for part in (data[:8], data[-8:]))
            intact = number == last and bool((data[8:-8] == number % 251).all())
            if frame.valid():
                self._frames += 1
                self._wrong += not intact

    def report(self) -> dict[str, Any]:
        numbers = {"frames": self._frames, "wrong": self._wrong, "problem": self._reader.problem}
        return self._reader.counters.snapshot() | numbers
