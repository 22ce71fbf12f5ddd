"""Jobs about recordings that fail, for processes of their own: so this module imports little."""

from __future__ import annotations

import os
import signal
import sys
import threading
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pebble.extensions.recordings.seek import questions
from tests.ext.recordings.playing import GOOB, ms


def without(package: str, kind: str, answer: Connection, archive: Path, scratch: Path) -> None:
    """A real job where this package is not installed."""
    sys.modules[package] = None  # type: ignore[assignment]
    paths = [str(path) for path in archive.rglob("*.mcap")]
    stretch = ms(5) * 10**6, ms(6) * 10**6
    if kind == "timeline":
        questions.make_timeline_job(answer, paths, scratch / package, GOOB, stretch)
    else:
        questions.export_job(answer, paths, scratch / f"{package}.mkv", GOOB, stretch, "mkv")


def killed(answer: Connection, *_: Any) -> None:
    answer.send(("done", 0.5))
    os.kill(os.getpid(), signal.SIGKILL)


def ended(_answer: Connection, *_: Any) -> None:
    sys.exit(3)


def silent(_answer: Connection, *_: Any) -> None:
    threading.Event().wait()


def stopped(answer: Connection, *_: Any) -> None:
    answer.send(("done", 0.5))
    os.kill(os.getpid(), signal.SIGSTOP)
