"""A simulated MiniLAMP or BenJr as a program, ``pebble sim benjr --broker mqtt://HOST``."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from pebble.config.security import Security
from pebble.contract.identity import Identity
from pebble.extensions.lab.simulation.fleet import ConnectionReporter, Fleet
from pebble.extensions.lab.simulation.mcu import Snapshot
from pebble.extensions.lab.simulation.trace import Trace, motors_entry
from pebble.extensions.lab.simulation.wireless import BrokerAddress, Motors, WirelessRobot

_MOVING_S = 0.01  # period of turns while motors run and sockets are idle


class StopSignal:
    """Records SIGTERM, SIGINT or SIGHUP, which interrupt nothing."""

    def __init__(self) -> None:
        self.received = False
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._receive)

    def _receive(self, *_: object) -> None:
        self.received = True


def run(
    kind: str,
    identity: Identity,
    broker: BrokerAddress,
    *,
    name: str = "",
    security: Security | None = None,
    trace: Path | None = None,
    report: bool = False,
    files: Path | None = None,
) -> int:
    """Run one robot until a signal, or until the reader of the report closes the pipe. Raises PebbleError.

    ``name``: what people call it. ``security``: of its config; None: open.
    """
    stop_signal = StopSignal()
    record = Trace(trace)
    with Fleet(broker) as fleet:
        options = {"name": name, "security": security or Security(), "files": files}
        robot = fleet.add(kind, identity, moving_s=_MOVING_S, on_motors=_recorder(record), **options)
        reporter = ConnectionReporter([robot], lambda line: print(line, file=sys.stderr, flush=True))  # noqa: T201

        def job() -> None:
            reporter.poll()
            if report and not _report(robot):
                stop_signal.received = True

        fleet.run(lambda: not stop_signal.received, job)
    record.close()
    return 0


def _recorder(trace: Trace) -> Callable[[float, Motors], None]:
    return lambda now, motors: trace.add(motors_entry(int(now * 1e9), motors))


def _report(robot: WirelessRobot) -> bool:
    snapshot = Snapshot(time.monotonic_ns(), robot.network.radio.connected, robot.online, robot.state())
    try:
        os.write(sys.stdout.fileno(), msgspec.json.encode(snapshot) + b"\n")
    except BrokenPipeError:  # the reader has closed the pipe
        return False
    return True
