"""Simulated robots with Wi-Fi as a program: ``pebble sim benjr --broker mqtt://HOST``, ``pebble sim fleet …``."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from pebble.config.security import Security
from pebble.contract.identity import Identity
from pebble.extensions.lab.simulation.bodies import Pair
from pebble.extensions.lab.simulation.fleet import ConnectionReporter, Fleet, members
from pebble.extensions.lab.simulation.trace import Trace, motors_entry
from pebble.runtime.signals import EndSignal
from pebble.transports import MqttSettings

_MOVING_S = 0.01  # period of turns while motors run and sockets are idle
_STATUS_S = 10.0  # between lines of a fleet's status


def run(
    kind: str,
    identity: Identity,
    broker: MqttSettings,
    *,
    name: str = "",
    security: Security | None = None,
    trace: Path | None = None,
    files: Path | None = None,
) -> int:
    """Run a robot until a signal. Raises PebbleError.

    ``name``: the robot's name for people. ``security``: the level in its config; None: open.
    """
    end, record = EndSignal(), Trace(trace)

    def on_motors(now: float, motors: Pair) -> None:
        record.add(motors_entry(int(now * 1e9), motors))

    with Fleet(broker) as fleet:
        options = {"name": name, "security": security or Security(), "files": files}
        robot = fleet.add(kind, identity, moving_s=_MOVING_S, on_motors=on_motors, **options)
        reporter = ConnectionReporter([robot], lambda line: print(line, file=sys.stderr, flush=True))  # noqa: T201
        fleet.run(lambda: not end.wait(0.0), reporter.poll)
    record.close()
    return 0


def run_fleet(broker: MqttSettings, robots: int) -> int:
    """Run a fleet until a signal, and print its status; return 0 if all robots are online at the end.

    Raises PebbleError.
    """
    end, due = EndSignal(), time.monotonic() + _STATUS_S

    def show(line: str) -> None:
        print(line, flush=True)  # noqa: T201

    def show_status() -> None:
        online = sum(robot.online for robot in fleet.robots)
        show(f"{online} of {robots} online, {sum(robot.moving for robot in fleet.robots)} moving")

    def report() -> None:
        nonlocal due
        reporter.poll()
        if time.monotonic() >= due:
            due = time.monotonic() + _STATUS_S
            show_status()

    with Fleet(broker) as fleet:
        for kind, identity in members(robots):
            fleet.add(kind, identity)
        reporter = ConnectionReporter(fleet.robots, show)
        show(f"{robots} robots, {fleet.robots[0].identity.id} and so on; Ctrl-C ends it")
        fleet.run(lambda: not end.wait(0.0), report)
        show_status()
        return int(not all(robot.online for robot in fleet.robots))
