"""Many simulated robots with Wi-Fi in one process and thread, each with its own board, firmware and connection.

A robot runs a turn at once when one of its sockets is ready, otherwise periodically.
"""

from __future__ import annotations

import select
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

from pebble.contract.identity import Identity
from pebble.errors import ConfigError
from pebble.extensions.lab.simulation.wireless import KINDS, WirelessRobot
from pebble.transports import MqttSettings

MOST = 1000
_JOB_S = 0.1
_OFFLINE_S = 2.0  # a robot that is offline for longer is reported
_MOVING_S = 0.05  # period of a robot's turns while its motors run and its sockets are idle
_EVENTS = select.EPOLLIN | select.EPOLLOUT | select.EPOLLET
_GRAIN_S = 0.0005  # robots that are due within this time run now
_LONGEST_S = 0.05


class Fleet:
    """A fleet: ``add`` robots, then ``run`` them. Leaving the context stops all motors and closes all connections."""

    def __init__(self, broker: MqttSettings) -> None:
        self.broker = broker
        self.robots: list[WirelessRobot] = []
        self._epoll = select.epoll()
        self._due: list[float] = []  # by the number of a robot: when its next turn is due
        self._number_of: dict[int, int] = {}  # by the file descriptor of a socket: the number of its robot

    def add(self, kind: str, identity: Identity, *, moving_s: float = _MOVING_S, **options: Any) -> WirelessRobot:
        """Add a robot. Its first turn comes when the fleet runs."""
        robot = WirelessRobot(kind, identity, self.broker, moving_s=moving_s, **options)
        self.robots.append(robot)
        self._due.append(0.0)
        return robot

    def run(self, keep_running: Callable[[], bool], job: Callable[[], None] = lambda: None) -> None:
        """Run while ``keep_running`` returns True; ``job`` is called ten times a second."""
        due = time.monotonic()
        while keep_running():
            self._turn()
            if time.monotonic() >= due:
                due = time.monotonic() + _JOB_S
                job()

    def close(self) -> None:
        for robot in self.robots:
            robot.stop()
        self._epoll.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _turn(self) -> None:
        """Wait for a ready socket or for the next robot that is due; run a turn of those robots."""
        wait = min(self._due, default=0.0) - time.monotonic()
        for descriptor, _ in self._epoll.poll(min(_LONGEST_S, max(0.0, wait))):
            self._due[self._number_of[descriptor]] = 0.0
        now = time.monotonic() + _GRAIN_S
        for number, due in enumerate(self._due):
            if due <= now:
                self._step(number)

    def _step(self, number: int) -> None:
        """Run a turn of a robot, watch the sockets that it has opened, and set when its next turn is due."""
        robot, network = self.robots[number], self.robots[number].network
        network.unread = False
        robot.step()
        for sock in network.new_sockets:  # closing a descriptor removes it from epoll; its number may be used again
            if sock.fileno() >= 0:
                self._number_of[sock.fileno()] = number
                self._epoll.register(sock, _EVENTS)
        network.new_sockets.clear()
        self._due[number] = time.monotonic() + (0.0 if network.unread else robot.pause_s)


class ConnectionReporter:
    """A reporter of robots that cannot connect: a line when they cannot, and when the reason changes or they can.

    Call ``poll`` often.
    """

    def __init__(self, robots: Sequence[WirelessRobot], report: Callable[[str], None]) -> None:
        self._robots, self._report = robots, report
        self._online_at = time.monotonic()  # when all robots were last online
        self._reported = ""  # what the last line was about: "online", or a reason

    def poll(self) -> None:
        offline = [robot for robot in self._robots if not robot.online]
        if not offline:
            self._online_at = time.monotonic()
            self._report_change("online", self._robots)
        elif time.monotonic() - self._online_at > _OFFLINE_S:
            ((most_common_reason, _),) = Counter(robot.problem for robot in offline).most_common(1)
            self._report_change(most_common_reason or "no answer", offline)

    def _report_change(self, state: str, robots: Sequence[WirelessRobot]) -> None:
        """Report that robots are ``online``, or why they are not, unless this was reported last."""
        if state == self._reported:
            return
        self._reported = state
        who, goes_on = f"{len(robots)} robots", "they keep trying"
        if len(robots) == 1:
            who, goes_on = robots[0].identity.id, "it keeps trying"
        broker = f"the broker at {robots[0].broker.host}:{robots[0].broker.port}"
        if state == "online":
            self._report(f"{who}: connected to {broker}")
        else:
            self._report(f"{who}: cannot reach {broker}: {state}; {goes_on}")


def members(count: int) -> Iterator[tuple[str, Identity]]:
    """Yield kind and identity of each robot of a fleet, alternating the kinds: minilamp-001, benjr-001, …"""
    if not 1 <= count <= MOST:
        raise ConfigError(f"a fleet has 1 to {MOST} robots, not {count}")
    for number in range(count):
        kind = KINDS[number % len(KINDS)]
        yield kind, Identity("pebble", "robots", f"{kind}-{number // len(KINDS) + 1:03d}")
