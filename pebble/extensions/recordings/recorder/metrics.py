"""The recorder's numbers in a file, for ``pebble doctor`` and for programs that watch machines."""

import json
import time
from collections.abc import Iterable
from typing import Final

from pebble.extensions.recordings.recorder.recorder import Recorder
from pebble.extensions.recordings.recorder.source import Source

STATUS: Final = "recorder.json"
_TOTALS: Final = ("messages", "bytes", "written", "dropped", "errors", "refused", "pruned_bytes")


def write(recorder: Recorder, sources: Iterable[Source]) -> None:
    """Replace the file; times in seconds since 1970. Raises OSError."""
    status = {
        **{name: recorder.counters[name] for name in _TOTALS},
        "gaps": recorder.counters["event_gap"],
        "connected": sum(source.connected for source in sources),
        "blocked": recorder.blocked,
        "at": time.time(),
    }
    path = recorder.folder.root / STATUS
    part = path.with_name(f".{path.name}.part")
    part.write_text(json.dumps(status), encoding="utf-8")
    part.replace(path)
