"""Messages by their nanoseconds, and the demo's robots as a folder of recordings."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from tests.ext.recordings.demo_robots import DRIVE, MEDIA
from tests.ext.recordings.playing import write

START_NS = 1_763_600_400 * 10**9  # 2025-11-20 01:00 UTC


class Sent(NamedTuple):
    """One message as a recorder received it."""

    log_ns: int
    topic: str
    payload: bytes
    metadata: dict[str, str] = {"qos": "1", "retain": "0"}  # noqa: RUF012


def write_recording(path: Path, messages: Iterable[Sent], *, finished: bool = True) -> Path:
    """A recording as the recorder writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write(path, messages, finished=finished)


def demo_folder(folder: Path) -> Path:
    """What was recorded of the demo's robots; the file of media is being written."""
    folder.mkdir(parents=True)
    shutil.copy2(DRIVE, folder / "a.state.mcap")
    (folder / "b.media.mcap.active").write_bytes(MEDIA.read_bytes()[:-200])
    return folder


def event(ns: int, name: str, **about: Any) -> Sent:
    """What the recorder notes about itself."""
    return Sent(ns, "$recorder/events", json.dumps({"t": ns // 10**6, "event": name, **about}).encode())
