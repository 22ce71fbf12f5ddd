"""Many simulated robots with Wi-Fi in one process and thread, each with its own board, firmware and connection."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Self

from pebble.contract.identity import Identity
from pebble.errors import ConfigError
from pebble.extensions.lab.simulation.micropython.servers import LoopbackServers
from pebble.extensions.lab.simulation.scheduler import Scheduler
from pebble.extensions.lab.simulation.wireless import KINDS, BrokerAddress, WirelessRobot

MOST = 1000
_JOB_S = 0.1
_OFFLINE_S = 2.0  # a robot that is offline for longer is reported
_MOVING_S = 0.05  # period of a robot's turns while its motors run and its sockets are idle


class Fleet:
    """``add`` robots, then ``run`` them; leaving the context stops all motors and closes all connections."""

    def __init__(self, broker: BrokerAddress) -> None:
        self.broker = broker
        self.robots: list[WirelessRobot] = []
        self.servers = LoopbackServers()
        self.scheduler = Scheduler(self.servers)

    def add(self, kind: str, identity: Identity, *, moving_s: float = _MOVING_S, **options: Any) -> WirelessRobot:
        """Add a robot; its first turn is when the fleet runs."""
        robot = WirelessRobot(kind, identity, self.broker, self.servers, moving_s=moving_s, **options)
        self.robots.append(robot)
        self.scheduler.add(robot)
        return robot

    def run(self, keep_running: Callable[[], bool], job: Callable[[], None] = lambda: None) -> None:
        """Run while ``keep_running`` returns True; ``job`` is called ten times a second."""
        due = time.monotonic()
        while keep_running():
            self.scheduler.run_once()
            if time.monotonic() >= due:
                due = time.monotonic() + _JOB_S
                job()

    def close(self) -> None:
        for robot in self.robots:
            robot.stop()
        self.scheduler.close()
        self.servers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


class ConnectionReporter:
    """Reports in one line when robots cannot connect, and again when that changes. Call ``poll`` often."""

    def __init__(self, robots: Sequence[WirelessRobot], report: Callable[[str], None]) -> None:
        self._robots, self._report = robots, report
        self._fine_at = time.monotonic()
        self._reported = ""

    def poll(self) -> None:
        offline = [robot for robot in self._robots if not robot.online]
        if not offline:
            self._fine_at = time.monotonic()
            if self._reported != "online":
                self._report_change("online", self._robots)
        elif time.monotonic() - self._fine_at > _OFFLINE_S:
            reasons = Counter(robot.problem for robot in offline)
            self._report_change(reasons.most_common(1)[0][0] or "no answer", offline)

    def _report_change(self, what: str, whose: Sequence[WirelessRobot]) -> None:
        if what == self._reported:
            return
        self._reported = what
        who = whose[0].identity.id if len(whose) == 1 else f"{len(whose)} robots"
        where = f"the broker at {whose[0].broker}"
        goes_on = "it keeps trying" if len(whose) == 1 else "they keep trying"
        self._report(
            f"{who}: connected to {where}" if what == "online" else f"{who}: cannot reach {where}: {what}; {goes_on}"
        )


def members(count: int, kinds: Sequence[str] = KINDS) -> Iterator[tuple[str, Identity]]:
    """Kind and identity of each robot of a fleet, alternating the kinds: minilamp-001, benjr-001, minilamp-002, …"""
    if not 1 <= count <= MOST:
        raise ConfigError(f"a fleet has 1 to {MOST} robots, not {count}")
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise ConfigError(f"unknown simulated robot with Wi-Fi {unknown[0]!r}; known: {', '.join(KINDS)}")
    for number in range(count):
        kind = kinds[number % len(kinds)]
        yield kind, Identity("pebble", "robots", f"{kind}-{number // len(kinds) + 1:03d}")
