"""A simulated serial MCU as a program, ``pebble sim goob --link /tmp/goob``."""

import sys
import threading
from collections.abc import Callable
from pathlib import Path

from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.runtime.signals import EndSignal


def run(kind: str, link: Path, *, trace: Path | None = None, trace_output: bool = False, control: bool = False) -> int:
    """Run until a signal, or with ``control`` until standard input ends. Raises PebbleError."""
    end = EndSignal()
    with PtyMcu(kind, link, trace=trace, trace_output=trace_output) as mcu:
        if control:
            threading.Thread(target=_run_commands, args=(mcu, end), name="pebble-sim control", daemon=True).start()
        print(f"{kind} is at {link}; Ctrl-C ends it", flush=True)  # noqa: T201
        end.wait()
    return 0


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
    """Execute the lines of standard input; when it closes, request the end of the program."""
    commands = actions(mcu)
    for line in sys.stdin:
        action = commands.get(line.strip())
        if action is None:
            sys.stderr.write(f"unknown command {line.strip()}; known: {', '.join(commands)}\n")
        else:
            action()
    end.set()
