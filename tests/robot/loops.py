"""Whole robots whose messages come back by another way: ``python -m tests.robot.loops``.

The robot's broker has a ``connection`` of mosquitto to the operators' broker, or there is a second robot of the same
id: with crossed brokers, or at the same ones. In each case an operator drives, and ends with a stop: one second later
no drive line may reach the motors any more, and the log may have one error. Then the other way is cut: commands must
arrive again, and end.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from tests.robot.operator import Driver
from tests.robot.rig import STOP, Rig
from tests.support import Broker, until
from tests.tcp_proxy import TcpProxy

_CONNECTIONS = tuple(itertools.product(("in", "out", "both"), ("incoming/drive-values", "incoming/#", "#")))
_ROBOTS = ("a second robot with crossed brokers", "a second robot at the same broker")
_UP_S = 15.0
_DRIVES_S = 2.0
_STOPPED_S = 1.0
_LOOKS_S = 2.0
_AGAIN_S = 40.0  # what circulated is probed less and less often


@dataclass(frozen=True)
class Case:
    transport: str  # zenoh: with a mirror
    mirroring: bool
    way: str
    carried: str = ""

    def __str__(self) -> str:
        way = f"connection {self.way} for {self.carried}" if self.carried else self.way
        return f"{self.transport}, remote-mirror {'on' if self.mirroring else 'off'}, {way}"


@dataclass
class Outcome:
    most: int = 0  # drive lines in a second while it was driven
    late: int = 0  # drive lines later than a second after the stop
    errors: int = 0
    again_s: float = float("inf")  # until a command arrived once after the way was cut

    @property
    def good(self) -> bool:
        return not self.late and self.errors <= 1 and self.again_s < _AGAIN_S


def cases() -> Iterator[Case]:
    for transport, mirroring in itertools.product(("mqtt", "zenoh"), (False, True)):
        for way, carried in _CONNECTIONS:
            yield Case(transport, mirroring, way, carried)
        for way in _ROBOTS:
            if transport == "mqtt" or way != _ROBOTS[0]:
                yield Case(transport, mirroring, way)


def started(kind: str, **options: Any) -> Rig:
    """A robot that can be driven; where all comes back, its bridge mirrors nothing, and operators do not see it."""
    rig = Rig(kind, mcu="fred", start=False, **options)
    rig.start(ready=False)
    if not until(lambda: all(text in rig.log.read_text() for text in ("tty: ready", "[mqtt_bridge]")), _UP_S):
        rig.close()
        raise RuntimeError(f"the robot is not up: {rig.log.read_text()}")
    return rig


@contextmanager
def wired(case: Case) -> Iterator[tuple[Rig, list[Rig], TcpProxy]]:
    """The robot, all robots, and the other way."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pbl")))
        remote = Broker(folder)
        way = stack.enter_context(TcpProxy(remote.port))
        options: tuple[str, ...] = ()
        if case.carried:
            topic = f"topic pebble/robots/+/{case.carried} {case.way} 1"
            options = ("connection other", f"address 127.0.0.1:{way.port}", topic, "notifications false")
        local = Broker(folder, *options)
        mirror = case.transport == "zenoh"
        rig = stack.enter_context(started(case.transport, mirror=mirror, remote=remote, local=local))
        robots = [rig]
        if case.way == _ROBOTS[0]:
            robots.append(stack.enter_context(started("mqtt", remote=local, local=remote)))
        elif case.way == _ROBOTS[1]:
            robots.append(stack.enter_context(started(case.transport, mirror=mirror, remote=remote)))
        yield rig, robots, way


def perform(case: Case) -> Outcome:
    with wired(case) as (rig, robots, way):
        rig.operator.send("incoming/flags/remote-mirror", {"value": case.mirroring}, retain=True)
        time.sleep(1.0)
        outcome, began = Outcome(), time.monotonic()
        stopped = _drive(rig)
        time.sleep(_STOPPED_S + _LOOKS_S)
        for robot in robots:
            lines = robot.mcu.drives(began)
            outcome.most = max(outcome.most, round(len([at for at, _ in lines if at < stopped]) / _DRIVES_S))
            outcome.late += sum(at > stopped + _STOPPED_S for at, _ in lines)
            outcome.errors = max(outcome.errors, robot.log.read_text().count("[ERROR]"))
        way.cut()
        for robot in robots[1:]:
            robot.ensure_stopped()
        outcome.again_s = _again(rig)
        return outcome


def _drive(rig: Rig) -> float:
    """Drives for two seconds; returns when the operator stopped."""
    driver = Driver(rig.operator)
    time.sleep(_DRIVES_S)
    driver.stop()
    rig.operator.send("incoming/drive-values", {"x": 0, "z": 0})
    return time.monotonic()


def _again(rig: Rig) -> float:
    """Seconds until the robot can be driven, and stops."""
    began = time.monotonic()
    while time.monotonic() - began < _AGAIN_S:
        stopped = _drive(rig)
        took = stopped - _DRIVES_S - began
        time.sleep(_STOPPED_S)
        moved = any(wheels != STOP for at, wheels in rig.mcu.drives(stopped - _DRIVES_S))
        if moved and until(lambda: not rig.mcu.turning(), 0.1):
            return took
    return float("inf")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robot.loops", description=__doc__)
    parser.add_argument("--only", default="", metavar="WORDS", help="cases whose name has these words")
    options = parser.parse_args()
    chosen = [case for case in cases() if options.only in str(case)]
    terminal, wrong = Console(), 0
    table = Table("case", "lines/s", "after the stop", "errors", "again, s", "")
    for number, case in enumerate(chosen, 1):
        outcome = perform(case)
        wrong += not outcome.good
        figures = (str(outcome.most), str(outcome.late), str(outcome.errors), f"{outcome.again_s:.1f}")
        table.add_row(str(case), *figures, "" if outcome.good else "WRONG")
        terminal.print(f"{number}/{len(chosen)} {case}: {outcome}", highlight=False)
    terminal.print(table)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
