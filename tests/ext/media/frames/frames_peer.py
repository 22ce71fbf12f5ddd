"""Processes that write or read frames.

Each says `up` when it is ready, answers a line on stdin with what it knows as a line of JSON, and ends with stdin.
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

import msgspec
import numpy as np

from pebble.extensions.media.frames import Frame, FrameInfo, FrameReader, FrameWriter, views
from pebble.runtime.parent import end_with_parent as die_with_parent

_PR_SET_DUMPABLE = 4


class Options(msgspec.Struct, kw_only=True):
    size: int = 3 * 64 * 48  # of a frame, bytes
    rate: float = 100.0  # Hz
    views: bool = False
    memlock: int | None = None  # RLIMIT_MEMLOCK, bytes, as the user below
    user: int | None = None  # become this user, which takes root


def main(role: str, folder: Path, chosen: Options) -> None:
    if chosen.memlock is not None:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (chosen.memlock, chosen.memlock))
    if chosen.user not in (None, os.geteuid()):
        become(chosen.user)
    peer = {"writer": Writer, "reader": Reader}[role](folder, chosen)
    worker = threading.Thread(target=peer.run, daemon=True)
    worker.start()
    report("up")
    for _ in sys.stdin:
        report(json.dumps(peer.report()))
    peer.stop()
    worker.join(5)


def become(user: int) -> None:
    """Only now that everything is imported: that user may have no access to the folder where we lie."""
    version = views.zenoh_version()
    views.zenoh_version = lambda: version
    os.setgid(user)
    os.setuid(user)
    ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 1)  # else /proc/self is root's
    die_with_parent()  # forgotten with the change of user


def report(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def stamp(array: np.ndarray[Any, Any], number: int) -> None:
    """Fill a frame with its number, so that a torn one shows."""
    array[:] = number % 251
    array[:8].view("<u8")[0] = array[-8:].view("<u8")[0] = number


def intact(array: np.ndarray[Any, Any]) -> bool:
    number = int(array[:8].copy().view("<u8")[0])
    return number == int(array[-8:].copy().view("<u8")[0]) and bool((array[8:-8] == number % 251).all())


class Writer:
    def __init__(self, folder: Path, options: Options) -> None:
        self._options = options
        self._ended = threading.Event()
        self._frame = np.zeros(options.size, np.uint8)
        self._writer = FrameWriter(folder, "camera", capacity=options.size).open()

    def run(self) -> None:
        number, due = 0, time.monotonic()
        while not self._ended.is_set():
            number += self._write(number + 1)
            due += 1 / self._options.rate
            if (pause := due - time.monotonic()) > 0:
                time.sleep(pause)
            else:
                due = time.monotonic()

    def _write(self, number: int) -> bool:
        slot = self._writer.slot(self._options.size)
        array = self._frame if slot is None else slot.array
        stamp(array, number)
        info = FrameInfo(captured_ns=time.monotonic_ns(), format="bgr24", width=self._options.size // 3, height=1)
        return self._writer.write(array, info) if slot is None else slot.send(info)

    def report(self) -> dict[str, Any]:
        writer = self._writer
        return writer.counters.snapshot() | {
            "wanted": writer.wanted,
            "sharing": writer.shared,
        }

    def stop(self) -> None:
        self._ended.set()
        self._writer.close()


class Reader:
    def __init__(self, folder: Path, options: Options) -> None:
        self._options = options
        self.frames = self.wrong = 0
        self._reader = FrameReader(folder, "camera", views=options.views).open()

    def run(self) -> None:
        for frame in self._reader:
            self._check(frame)

    def _check(self, frame: Frame) -> None:
        good = intact(frame.data)
        if frame.valid():
            self.frames += 1
            self.wrong += not good

    def report(self) -> dict[str, Any]:
        reader = self._reader
        return reader.counters.snapshot() | {
            "frames": self.frames,
            "wrong": self.wrong,
            "problem": reader.problem,
        }

    def stop(self) -> None:
        self._reader.close()
