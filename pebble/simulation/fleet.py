"""Many simulated robots with Wi-Fi in one process and one thread, each with its own board, firmware and connection."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import msgspec

from pebble.errors import ConfigError
from pebble.identity import Identity
from pebble.simulation.micropython.servers import LoopbackServers
from pebble.simulation.turns import Turns
from pebble.simulation.wireless import KINDS, BrokerAddress, Motors, WirelessRobot

MOST = 1000
_JOB_S = 0.1
_TROUBLE_S = 2.0  # how long a robot may need to connect before somebody is told
_MOVING_S = 0.05  # turns of a robot in a fleet, while its motors run and its sockets have no news


@dataclass(frozen=True, slots=True)
class Moved:
    """A line of a fleet's trace: at ``ns`` (CLOCK_MONOTONIC) a robot's motors began to do this."""

    ns: int
    robot: str
    motors: Motors


class Fleet:
    """``add`` robots, then ``run`` them; leaving the context stops all motors and closes all connections."""

    def __init__(self, broker: BrokerAddress, *, trace: Path | None = None) -> None:
        self.broker = broker
        self.robots: list[WirelessRobot] = []
        self.servers = LoopbackServers()
        self.turns = Turns(self.servers)
        self._trace: BinaryIO | None = trace.open("ab") if trace is not None else None

    def add(self, kind: str, identity: Identity, *, moving_s: float = _MOVING_S, **options: Any) -> WirelessRobot:
        """One more robot; its first turn comes when the fleet runs."""
        if self._trace is not None:
            options["on_motors"] = self._recorder(identity.id)
        robot = WirelessRobot(kind, identity, self.broker, self.servers, moving_s=moving_s, **options)
        self.robots.append(robot)
        self.turns.add(robot)
        return robot

    def run(self, going_on: Callable[[], bool], job: Callable[[], None] = lambda: None) -> None:
        """Until ``going_on`` says no; ``job`` is done ten times a second."""
        due = time.monotonic()
        while going_on():
            self.turns.turn()
            if time.monotonic() >= due:
                due = time.monotonic() + _JOB_S
                job()
                if self._trace is not None:
                    self._trace.flush()

    def close(self) -> None:
        for robot in self.robots:
            robot.stop()
        self.turns.close()
        self.servers.close()
        if self._trace is not None:
            self._trace.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _recorder(self, name: str) -> Callable[[float, Motors], None]:
        def record(now: float, motors: Motors) -> None:
            if self._trace is not None:
                self._trace.write(msgspec.json.encode(Moved(int(now * 1e9), name, motors)) + b"\n")

        return record


class Troubles:
    """Says in one line when robots cannot connect, and again when that changes. ``look`` often."""

    def __init__(self, robots: Sequence[WirelessRobot], say: Callable[[str], None]) -> None:
        self._robots, self._say = robots, say
        self._fine_at = time.monotonic()
        self._said = ""

    def look(self) -> None:
        offline = [robot for robot in self._robots if not robot.online]
        if not offline:
            self._fine_at = time.monotonic()
            if self._said != "online":
                self._tell("online", self._robots)
        elif time.monotonic() - self._fine_at > _TROUBLE_S:
            reasons = Counter(robot.trouble for robot in offline)
            self._tell(reasons.most_common(1)[0][0] or "no answer", offline)

    def _tell(self, what: str, whose: Sequence[WirelessRobot]) -> None:
        if what == self._said:
            return
        self._said = what
        who = whose[0].identity.id if len(whose) == 1 else f"{len(whose)} robots"
        where = f"the broker at {whose[0].broker}"
        goes_on = "it goes on trying" if len(whose) == 1 else "they go on trying"
        self._say(
            f"{who}: connected to {where}" if what == "online" else f"{who}: cannot reach {where}: {what}; {goes_on}"
        )


def members(count: int, kinds: Sequence[str] = KINDS) -> Iterator[tuple[str, Identity]]:
    """Kind and identity of each robot of a fleet, the kinds in turn: minilamp-001, benjr-001, minilamp-002, …"""
    if not 1 <= count <= MOST:
        raise ConfigError(f"a fleet has 1 to {MOST} robots, not {count}")
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise ConfigError(f"there is no simulated {unknown[0]!r} with Wi-Fi, only {' and '.join(KINDS)}")
    for number in range(count):
        kind = kinds[number % len(kinds)]
        yield kind, Identity("pebble", "robots", f"{kind}-{number // len(kinds) + 1:03d}")
