"""What a recorder does, as numbers: for node_exporter's textfile collector, and for ``pebble recordings list``."""

import json
import os
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from pebble.recordings.recorder.recorder import Recorder
from pebble.recordings.recorder.source import Source

PROMETHEUS: Final = "recorder.prom"
STATUS: Final = "recorder.json"
_TOTALS: Final = ("messages", "bytes", "written", "dropped", "errors", "refused", "pruned_bytes")


def snapshot(recorder: Recorder, sources: Iterable[Source]) -> dict[str, Any]:
    """All numbers; times in seconds since 1970."""
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
        "slowest_flush_s": round(recorder.slowest_flush_s, 4),
        "slowest_sync_s": round(recorder.slowest_sync_s, 4),
        "robots": recorder.robots,
        "at": time.time(),
        "pid": os.getpid(),
    }


def write(recorder: Recorder, sources: Iterable[Source]) -> None:
    """Replace both files. Raises OSError."""
    values = snapshot(recorder, sources)
    _replace(recorder.folder.root / STATUS, json.dumps(values))
    _replace(recorder.folder.root / PROMETHEUS, _prometheus(values))


def _prometheus(values: dict[str, Any]) -> str:
    lines = [f"pebble_record_{name}_total {values[name]}" for name in (*_TOTALS, "gaps")]
    gauges = ("connected", "connections", "waiting", "free_bytes", "slowest_flush_s", "slowest_sync_s")
    lines += [
        f"pebble_record_{name.removesuffix('_s')}{'_seconds' * name.endswith('_s')} {values[name]}" for name in gauges
    ]
    lines.append(f"pebble_record_blocked {int(bool(values['blocked']))}")
    for robot, at in values["robots"].items():
        name = robot.replace("\\", "\\\\").replace('"', '\\"')
        lines.append(f'pebble_record_last_message_timestamp_seconds{{robot="{name}"}} {at:.3f}')
    return "\n".join(lines) + "\n"


def _replace(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


def _free(root: Path) -> int:
    try:
        return shutil.disk_usage(root).free
    except OSError:
        return 0
