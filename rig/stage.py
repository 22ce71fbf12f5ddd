"""Whole robots with the operator page and no scripted operator, for tests and measurements of the page."""

from __future__ import annotations

import os
import signal
import threading
import time
from types import TracebackType
from typing import Any, Self

from pebble.errors import PebbleError
from pebble.rig.broker import BrokerKind
from pebble.rig.operator import Operator
from pebble.rig.page import PageServer
from pebble.rig.programs import Program, end_all
from pebble.rig.testbed import ROBOTS, SimulatedRobot, Testbed
from pebble.simulation.trace import Entry

_END_S = 2.5
_DRIVABLE_S = 30.0
_POLL_S = 0.02

Changes = list[tuple[int, tuple[float, float]]]


class Stage:
    """Brokers and the named robots (none: all four), and the page's server as a process of its own.

    ``robots``, by name, are traced: ``entries()`` is what each MCU received and did, with time.monotonic_ns().
    ``room``: Goob sees its room, in pictures as old as the room's state; else a scene that is drawn when due.
    ``settings`` are fields of WebSettings. A context manager, for the main thread. Raises PebbleError.
    """

    def __init__(self, *names: str, room: bool = True, **settings: Any) -> None:
        self.robots: dict[str, SimulatedRobot] = {}
        self._names, self._settings = names or ROBOTS, settings
        self._ending = threading.Event()
        self._testbed = Testbed(self._ending, self._names, room=room)

    def __enter__(self) -> Self:
        try:
            self._testbed.start_brokers(BrokerKind.MOSQUITTO)
            self._testbed.start_page(**self._settings)
            self._testbed.start_robots()
            self.robots = {robot.name: robot for robot in self._testbed.robots}
            self.server.wait(self._ending)
            self._wait_until_drivable()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._testbed.page is not None:
            self.thaw_server()
        self._testbed.keep = False
        self._testbed.__exit__(kind, error, tb)

    def _wait_until_drivable(self) -> None:
        """Every robot is online, and its capabilities say that it drives."""
        operator = Operator(self.broker_port, "stage")
        operator.connect()
        end = time.monotonic() + _DRIVABLE_S
        try:
            while not operator.ready(len(self._names)):
                problems = self._testbed.unexpected_exits()
                if problems or time.monotonic() > end:
                    raise PebbleError("; ".join(problems) or "the robots did not become ready to drive")
                time.sleep(_POLL_S)
        finally:
            operator.end()

    @property
    def server(self) -> PageServer:
        if self._testbed.page is None:
            raise PebbleError("the stage has not been entered")
        return self._testbed.page

    @property
    def url(self) -> str:
        """The address of the page, with a slash at the end."""
        return self.server.url

    @property
    def broker_port(self) -> int:
        """Of the operators' broker, on loopback."""
        return self._testbed.remote_port

    @property
    def folder_of_logs(self) -> str:
        return str(self._testbed.folder)

    def ref(self, name: str) -> str:
        return f"pebble/robots/{name}"

    def robot_url(self, name: str) -> str:
        return f"{self.url}r/{self.ref(name)}"

    # -- the server's process

    def kill_server(self) -> None:
        _kill(self.server.program)

    def freeze_server(self) -> None:
        """SIGSTOP: its connections stay, and nothing answers."""
        os.kill(self.server.program.pid, signal.SIGSTOP)

    def thaw_server(self) -> None:
        if not self.server.program.ended:
            os.kill(self.server.program.pid, signal.SIGCONT)

    def restart_server(self) -> None:
        """Start it again at the same address; ends the old one if it runs."""
        port = int(self.url.rpartition(":")[2].rstrip("/"))
        end_all([self.server.program], _END_S)
        self._testbed.start_page(**{**self._settings, "port": port}).wait(self._ending)

    # -- the broker's process

    def kill_broker(self) -> None:
        _kill(self._testbed.remote_broker)

    def freeze_broker(self) -> None:
        """SIGSTOP: its connections stay, and what is sent to it arrives after it was thawed."""
        os.kill(self._testbed.remote_broker.pid, signal.SIGSTOP)

    def thaw_broker(self) -> None:
        if not self._testbed.remote_broker.ended:
            os.kill(self._testbed.remote_broker.pid, signal.SIGCONT)

    def restart_broker(self) -> None:
        """Start it again at the same address, without retained messages; ends the old one if it runs."""
        self._testbed.restart_remote_broker()

    # -- the motors

    def motors(self, name: str) -> Changes:
        """Every change of its motors, oldest first: monotonic ns, left and right."""
        return [(entry.ns, entry.motors) for entry in self.robots[name].entries() if entry.motors is not None]

    def wheels_turning(self, name: str, since_ns: int | None = None) -> bool:
        """Whether its motors run now; with ``since_ns`` whether they have run at any time since then."""
        changes = self.motors(name)
        if since_ns is None:
            return bool(changes) and _runs(changes, -1)
        return any(_runs(changes, index) and _until(changes, index) > since_ns for index in range(len(changes)))

    def turned_s(self, name: str, since_ns: int) -> float:
        """How long its motors have run since then, in seconds."""
        changes = self.motors(name)
        runs = [(max(since_ns, changes[index][0]), _until(changes, index)) for index in _running(changes)]
        return sum(max(0, end - begin) for begin, end in runs) / 1e9

    def last_motion_ns(self, name: str) -> int:
        """When its motors were last switched off; now if they run, 0 if they have never run."""
        changes = self.motors(name)
        last = next((index for index in reversed(range(len(changes))) if _runs(changes, index)), None)
        return 0 if last is None else _until(changes, last)

    def relays(self, name: str) -> list[str]:
        """Every change of its outlets' relays, oldest first: "o1 on"."""
        return [entry.line for entry in self.robots[name].relays()]

    def lines(self, name: str) -> list[Entry]:
        """What its MCU received, oldest first."""
        return [entry for entry in self.robots[name].entries() if entry.event == "line"]


def _kill(program: Program) -> None:
    os.kill(program.pid, signal.SIGKILL)
    while not program.ended:
        time.sleep(_POLL_S)


def _running(changes: Changes) -> list[int]:
    return [index for index in range(len(changes)) if _runs(changes, index)]


def _runs(changes: Changes, index: int) -> bool:
    return changes[index][1] != (0.0, 0.0)


def _until(changes: Changes, index: int) -> int:
    return changes[index + 1][0] if index + 1 < len(changes) else time.monotonic_ns()
