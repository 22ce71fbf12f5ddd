"""Simulated robots with Wi-Fi on a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from types import TracebackType
from typing import Self

from pebble.config import Security
from pebble.contract.identity import Identity
from pebble.extensions.lab.simulation.fleet import Fleet
from pebble.extensions.lab.simulation.wireless import KINDS, WirelessRobot
from pebble.transports import MqttSettings
from tests.support import WAIT_S, until


class Robots:
    """One of each of these kinds, running. ``moves[kind]`` has each change of its motors, with its time.monotonic()."""

    def __init__(self, port: int, *, kinds: Iterable[str] = KINDS) -> None:
        self.fleet = Fleet(MqttSettings(host="127.0.0.1", port=port))
        self.moves: dict[str, list[tuple[float, tuple[float, float]]]] = {kind: [] for kind in kinds}
        self.robots: dict[str, WirelessRobot] = {}
        for kind, moves in self.moves.items():
            identity = Identity("pebble", "robots", kind)
            moved = lambda at, motors, moves=moves: moves.append((at, motors))  # noqa: E731
            self.robots[kind] = self.fleet.add(kind, identity, moving_s=0.01, on_motors=moved, security=Security())
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._ending.set()
        self._thread.join(WAIT_S)
        self.fleet.close()

    def wait_online(self, timeout: float = WAIT_S) -> None:
        online = until(lambda: all(robot.online for robot in self.robots.values()), timeout)
        assert online, {kind: robot.problem for kind, robot in self.robots.items()}

    def moving(self, kind: str) -> bool:
        return bool(self.moves[kind]) and any(self.moves[kind][-1][1])

    def stopped_at(self, kind: str) -> float:
        """When the motors last went off; they have to be off."""
        at, motors = self.moves[kind][-1]
        assert not any(motors), f"{kind} runs on"
        return at

    @property
    def alive(self) -> bool:
        return self._thread.is_alive() and all(robot.board.resets == 0 for robot in self.robots.values())

    def _run(self) -> None:
        self.fleet.run(lambda: not self._ending.is_set())
