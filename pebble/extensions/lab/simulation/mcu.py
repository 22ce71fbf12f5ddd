"""A simulated serial MCU as a program, ``pebble sim goob --link /tmp/goob``."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from pebble.extensions.lab.simulation.board import BoardState
from pebble.extensions.lab.simulation.pty import PtyMcu

_REPORT_PERIOD_S = 0.1
_SIGNALS = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A line of a report: one JSON object, ten times a second. ``ns`` is time.monotonic_ns()."""

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
    charging: bool = False,
    report: bool = False,
    control: bool = False,
) -> int:
    """Run until a signal, or with ``control`` until standard input ends.

    ``report``: write a :class:`Snapshot` to standard output ten times a second. Raises PebbleError.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # also in later threads; sigtimedwait below receives them
    with PtyMcu(
        kind,
        link,
        trace=trace,
        trace_output=trace_output,
        charging=charging,
    ) as mcu:
        if control:
            threading.Thread(target=_run_commands, args=(mcu,), name="pebble-sim control", daemon=True).start()
        while signal.sigtimedwait(_SIGNALS, _REPORT_PERIOD_S) is None:
            if report and not _report(mcu):
                break
    return 0


def _report(mcu: PtyMcu) -> bool:
    return _write(msgspec.json.encode(Snapshot(time.monotonic_ns(), mcu.plugged, mcu.host, mcu.state())))


def _write(line: bytes) -> bool:
    """False if the reader of standard output has closed it."""
    try:
        os.write(sys.stdout.fileno(), line + b"\n")
    except BrokenPipeError:
        return False
    return True


def actions(mcu: PtyMcu) -> dict[str, Callable[[], None]]:
    """Return the commands that standard input may have."""
    return {
        "unplug": mcu.unplug,
        "replug": mcu.replug,
        "reset": mcu.reset,
        "charge": lambda: mcu.charge(True),
        "discharge": lambda: mcu.charge(False),
        "disturb": lambda: mcu.disturb(True),
        "undisturb": lambda: mcu.disturb(False),
    }


def _run_commands(mcu: PtyMcu) -> None:
    known = actions(mcu)
    for line in sys.stdin:
        action = known.get(line.strip())
        if action is None:
            sys.stderr.write(f"unknown command {line.strip()}; known: {', '.join(known)}\n")
        else:
            action()
    os.kill(os.getpid(), signal.SIGTERM)
