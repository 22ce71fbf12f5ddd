"""A simulated serial MCU as a program, ``pebble sim goob --link /tmp/goob``."""

import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from pebble.extensions.lab.simulation.board import BoardState
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.runtime.signals import EndSignal

_REPORT_PERIOD_S = 0.1


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A line of a report: a JSON object, ten times a second. ``ns`` is time.monotonic_ns()."""

    ns: int
    plugged: bool
    host: bool
    board: BoardState


def run(
    kind: str,
    link: Path,
    *,
    trace: Path | None = None,
    trace_output: bool = False,
    report: bool = False,
    control: bool = False,
) -> int:
    """Run until a signal, or with ``control`` until standard input ends.

    ``report``: write a :class:`Snapshot` to standard output ten times a second. Raises PebbleError.
    """
    end = EndSignal()
    with PtyMcu(kind, link, trace=trace, trace_output=trace_output) as mcu:
        if control:
            threading.Thread(target=_run_commands, args=(mcu, end), name="pebble-sim control", daemon=True).start()
        while not end.wait(_REPORT_PERIOD_S):
            if report and not write_line(Snapshot(time.monotonic_ns(), mcu.plugged, mcu.host, mcu.state())):
                break
    return 0


def write_line(what: object) -> bool:
    """Write a line of JSON to standard output; False if nothing reads it any more."""
    try:
        os.write(sys.stdout.fileno(), msgspec.json.encode(what) + b"\n")
    except BrokenPipeError:
        return False
    return True


def actions(mcu: PtyMcu) -> dict[str, Callable[[], None]]:
    """Return the commands that standard input accepts."""
    return {
        "unplug": mcu.unplug,
        "replug": mcu.replug,
        "reset": mcu.reset,
        "charge": lambda: mcu.charge(True),
        "discharge": lambda: mcu.charge(False),
    }


def _run_commands(mcu: PtyMcu, end: EndSignal) -> None:
    commands = actions(mcu)
    for line in sys.stdin:
        action = commands.get(line.strip())
        if action is None:
            sys.stderr.write(f"unknown command {line.strip()}; known: {', '.join(commands)}\n")
        else:
            action()
    end.set()
