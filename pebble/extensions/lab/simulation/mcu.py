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
            serve_commands(lambda words: command(mcu, words), end)
        print(f"{kind} is at {link}; Ctrl-C ends it", flush=True)  # noqa: T201
        end.wait()
    return 0


def serve_commands(execute: Callable[[list[str]], str], end: EndSignal) -> None:
    """Execute the lines of standard input on a thread; when it closes, request the end of the program.

    ``execute`` gets the words of a line, and returns what is wrong with them, or "".
    """

    def serve() -> None:
        for line in sys.stdin:
            if problem := execute(line.split()):
                sys.stderr.write(f"{line.strip()!r}: {problem}\n")
        end.set()

    threading.Thread(target=serve, name="pebble-sim control", daemon=True).start()


def command(mcu: PtyMcu, words: list[str]) -> str:
    """Execute a command of one word; return what is wrong with it, or ""."""
    commands: dict[str, Callable[[], None]] = {
        "unplug": mcu.unplug,
        "replug": mcu.replug,
        "reset": mcu.reset,
        "charge": lambda: mcu.charge(True),
        "discharge": lambda: mcu.charge(False),
    }
    if len(words) != 1 or words[0] not in commands:
        return f"known commands: {', '.join(commands)}"
    commands[words[0]]()
    return ""
