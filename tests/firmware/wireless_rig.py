"""Simulated robots with Wi-Fi on a thread of their own, and an operator on the same real broker."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from paho.mqtt.client import Client, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion

from pebble.config import Security
from pebble.contract.identity import Identity
from pebble.extensions.lab.simulation.fleet import Fleet
from pebble.extensions.lab.simulation.wireless import KINDS, WirelessRobot
from pebble.transports import MqttSettings, TlsSettings
from tests.support import until

START_S = 10.0


class Robots:
    """One of each of these kinds, running. ``moves[kind]`` has each change of its motors, with its time.monotonic()."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        kinds: Iterable[str] = KINDS,
        security: Security | None = None,
        ca: Path | None = None,
        **login: Any,
    ) -> None:
        self.fleet = Fleet(MqttSettings(host=host, port=port, tls=ca and TlsSettings(ca_cert=ca), **login))
        self.moves: dict[str, list[tuple[float, tuple[float, float]]]] = {kind: [] for kind in kinds}
        self.robots: dict[str, WirelessRobot] = {}
        for kind, moves in self.moves.items():
            identity, moved = Identity("pebble", "robots", kind), partial(_note, moves)
            self.robots[kind] = self.fleet.add(
                kind, identity, moving_s=0.01, on_motors=moved, security=security or Security()
            )
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._ending.set()
        self._thread.join(10)
        self.fleet.close()

    def wait_online(self, timeout: float = START_S) -> None:
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


class Operator:
    """An operator that drives robots and receives their heartbeats; it reconnects by itself."""

    def __init__(self, port: int) -> None:
        self.heartbeats: dict[str, list[tuple[float, dict[str, Any]]]] = {kind: [] for kind in KINDS}
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.reconnect_delay_set(1, 1)
        self._client.on_connect = lambda client, *_: client.subscribe("pebble/robots/+/outgoing/online", 0)
        self._client.on_message = self._receive
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def __enter__(self) -> Self:
        assert until(self._client.is_connected)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def send(
        self, kind: str, payload: bytes | str, *, qos: int = 1, retain: bool = False, metric: str = "drive-values"
    ) -> MQTTMessageInfo | None:
        """Nothing while there is no connection: no command waits in here."""
        if not self._client.is_connected():
            return None
        return self._client.publish(f"pebble/robots/{kind}/incoming/{metric}", payload, qos, retain)

    def drive(self, kind: str, x: float, z: float, *, qos: int = 1) -> MQTTMessageInfo | None:
        return self.send(kind, json.dumps({"x": x, "z": z}), qos=qos)

    def beating(self, kind: str, since: float) -> int:
        """Live heartbeats after that time."""
        return sum(at > since and body["online"] for at, body in list(self.heartbeats[kind]))

    def _receive(self, _client: Client, _data: Any, message: Any) -> None:
        if not message.retain:
            self.heartbeats[message.topic.split("/")[2]].append((time.monotonic(), json.loads(message.payload)))


def _note(moves: list[tuple[float, tuple[float, float]]], at: float, motors: tuple[float, float]) -> None:
    moves.append((at, motors))
