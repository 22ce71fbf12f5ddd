"""A simulated serial MCU as a program: ``python -m pebble.simulation.mcu --kind goob --link /tmp/goob``."""

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec

from pebble.errors import PebbleError
from pebble.simulation.board import KINDS, BoardState
from pebble.simulation.micropython.board import UID
from pebble.simulation.pty import PtyMcu

_REPORT_PERIOD_S = 0.1
_RELAYS = (("connect", True), ("disconnect", False))
_SIGNALS = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A line of ``--report``: one JSON object, ten times a second. ``ns`` is time.monotonic_ns()."""

    ns: int
    plugged: bool
    host: bool
    board: BoardState


def main(arguments: list[str] | None = None) -> int:
    """Run until a signal, or with ``--control`` until standard input ends."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.outlets is not None and options.kind != "outlets":
        parser.error(f"--outlets: {options.kind} has none, only --kind outlets")
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # also in later threads; sigtimedwait below receives them
    try:
        return _run(options)
    except PebbleError as error:
        sys.stderr.write(f"{error}\n")
        return 1


def _run(options: argparse.Namespace) -> int:
    with PtyMcu(
        options.kind,
        options.symlink,
        trace=options.trace,
        trace_output=options.trace_output,
        failsafe_s=options.failsafe,
        charging=options.charging,
        uid=options.uid,
        settings=None if options.outlets is None else {"outlets": options.outlets},
        on_relay=_print if not options.report else lambda _change: None,
    ) as mcu:
        for outlet in options.unreachable:
            mcu.connect(outlet, False)
        if options.control:
            threading.Thread(target=_run_commands, args=(mcu,), name="pebble-sim control", daemon=True).start()
        while signal.sigtimedwait(_SIGNALS, _REPORT_PERIOD_S) is None:
            if options.report and not _report(mcu):
                break
    return 0


def _report(mcu: PtyMcu) -> bool:
    return _write(msgspec.json.encode(Snapshot(time.monotonic_ns(), mcu.plugged, mcu.host, mcu.state())))


def _print(line: str) -> None:
    _write(line.encode())


def _write(line: bytes) -> bool:
    """False if the reader of standard output has closed it."""
    try:
        os.write(sys.stdout.fileno(), line + b"\n")
    except BrokenPipeError:
        return False
    return True


def actions(mcu: PtyMcu) -> dict[str, Callable[[], None]]:
    """The commands of ``--control``."""
    return {
        "unplug": mcu.unplug,
        "replug": mcu.replug,
        "reset": mcu.reset,
        "charge": lambda: mcu.charge(True),
        "discharge": lambda: mcu.charge(False),
        "disturb": lambda: mcu.disturb(True),
        "undisturb": lambda: mcu.disturb(False),
        **{f"{word} {outlet}": partial(mcu.connect, outlet, on) for word, on in _RELAYS for outlet in mcu.outlets},
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m pebble.simulation.mcu", description=__doc__)
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument(
        "--link", dest="symlink", type=Path, required=True, help="path of the serial port: a symlink that is created"
    )
    parser.add_argument("--trace", type=Path, help="file to append every received line to, with its time")
    parser.add_argument(
        "--trace-said",
        dest="trace_output",
        action="store_true",
        help="also record every line of the MCU that the host received",
    )
    parser.add_argument(
        "--failsafe", type=float, metavar="S", help="stop after this silence, instead of the firmware's own"
    )
    parser.add_argument("--charging", action="store_true", help="start on the charger")
    parser.add_argument("--uid", type=bytes.fromhex, default=UID, metavar="HEX", help="the MCU's unique id")
    parser.add_argument("--outlets", type=int, choices=range(1, 5), metavar="N", help="of a station: 1 to 4")
    parser.add_argument(
        "--unreachable", action="append", default=[], metavar="oN", help="an outlet without its relay; several times"
    )
    parser.add_argument("--report", action="store_true", help="write the state to standard output at 10 Hz")
    parser.add_argument(
        "--control",
        action="store_true",
        help="read unplug, replug, reset, charge, discharge, disturb, undisturb (the I2C bus), and of a station "
        "connect oN, disconnect oN (a relay) from standard input",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
