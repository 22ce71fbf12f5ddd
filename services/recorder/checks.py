"""Checks of a robot's own recorder: whether it runs, and whether any file is damaged."""

import json
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from pebble.check_result import CheckResult, failed, ok, warn
from pebble.config import Config
from pebble.errors import PebbleError
from pebble.extensions.recordings.config import Recorder
from pebble.extensions.recordings.recorder.folder import Entry, Folder
from pebble.extensions.recordings.recorder.metrics import STATUS
from pebble.ownership import read_plain

_SILENT_S: Final = 30.0  # it writes its numbers every ten seconds


def checks(config: Config) -> Iterator[CheckResult]:
    """Check the recorder of a robot that has one."""
    section = config.section(Recorder)
    if not section.enabled:
        return
    folder = section.place
    if find_spec("mcap") is None:
        yield failed("the package mcap is not installed: it records nothing", 'pip install "pebble-robot[record]"')
        return
    if not folder.is_dir():
        yield ok(f"{folder} is not there yet: it has not recorded anything")
        return
    try:
        entries = Folder(folder).entries()
        yield _running(folder, entries)
        if damaged := [entry for entry in entries if not (entry.is_finished or entry.is_active)]:
            text = f"{len(damaged)} damaged files are kept, beside what could be read of them: {damaged[0].path}"
            yield warn(text, "pebble recordings rm FILE deletes one")
    except (PebbleError, OSError) as error:
        yield failed(f"{folder} cannot be read: {error}")


def _running(folder: Path, entries: list[Entry]) -> CheckResult:
    """Check whether the recorder runs, and writes all that it receives."""
    if not Folder.is_in_use(folder):
        unfinished = sum(entry.is_active for entry in entries)  # of a recorder that was killed
        if unfinished:
            text = f"does not run, and {unfinished} files in {folder} are not finished"
            return warn(text, f"pebble recordings mend {folder}")
        return ok("does not run now")
    status = _status(folder)
    silent_s = time.time() - float(status.get("at", 0.0))
    if silent_s > _SILENT_S:
        return warn(f"has stood still for {silent_s:.0f} s", "pebble up")
    if status.get("blocked"):
        return failed(f"writes nothing: {status['blocked']}", f"make room on the disk of {folder}")
    if status.get("dropped"):
        return warn(f"runs, and has dropped {status['dropped']} messages: the disk is too slow")
    return ok(f"runs, {status.get('messages', 0)} messages into {folder}")


def _status(folder: Path) -> dict[str, Any]:
    try:
        status = json.loads(read_plain(folder / STATUS))
    except (OSError, ValueError):
        return {}
    return status if isinstance(status, dict) else {}
