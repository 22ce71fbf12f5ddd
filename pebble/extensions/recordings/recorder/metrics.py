"""The recorder's numbers in a file, for ``pebble doctor`` and for programs that watch machines."""

import json
import os
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from pebble.extensions.recordings.recorder.recorder import Recorder
from pebble.extensions.recordings.recorder.source import Source

STATUS: Final = "recorder.json"
_TOTALS: Final = ("messages", "bytes", "written", "dropped", "errors", "refused", "pruned_bytes")


def snapshot(recorder: Recorder, sources: Iterable[Source]) -> dict[str, Any]:
    """Return all numbers; times in seconds since 1970."""
    counters, listed = recorder.counters, list(sources)
    totals = {name: counters[name] for name in _TOTALS}
    return {
        **totals,
        "gaps": counters["event_gap"],
        "connected": sum(source.connected for source in listed),
        "connections": len(listed),
        "blocked": recorder.blocked,
        "waiting": recorder.waiting,
        "free_bytes": _free(recorder.folder.root),
        "robots": recorder.robots,
        "at": time.time(),
        "pid": os.getpid(),
    }


def write(recorder: Recorder, sources: Iterable[Source]) -> None:
    """Replace the file. Raises OSError."""
    path = recorder.folder.root / STATUS
    part = path.with_name(f".{path.name}.part")
    part.write_text(json.dumps(snapshot(recorder, sources)), encoding="utf-8")
    part.replace(path)


def _free(root: Path) -> int:
    try:
        return shutil.disk_usage(root).free
    except OSError:
        return 0
