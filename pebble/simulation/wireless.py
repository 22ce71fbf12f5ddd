"""One simulated MiniLAMP or BenJr: its board, its body, and a real connection to a broker."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pebble.errors import ConfigError
from pebble.identity import Identity
from pebble.simulation.bodies import body_of
from pebble.simulation.micropython.board import Board
from pebble.simulation.micropython.clock import RealClock
from pebble.simulation.micropython.ports import OF_ROBOT
from pebble.simulation.micropython.runner import Runner
from pebble.simulation.micropython.servers import LoopbackServers
from pebble.simulation.micropython.sockets import HostNetwork
from pebble.simulation.state import BoardState

KINDS: Final = ("minilamp", "benjr")

_MOVING_S, _RESTING_S = 0.01, 0.05  # between turns without news
_CA_FILE = "/ca.der"

Motors = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokerAddress:
    """Where a robot's broker is; with ``ca`` (DER) or ``tls`` it is spoken to through TLS."""

    host: str
    port: int
    username: str | None = None
    password: str | None = None
    tls: bool = False
    ca: Path | None = None

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"

    def settings(self) -> dict[str, Any]:
        """The section ``mqtt`` of a private_config.json."""
        login = {"username": self.username, "password": self.password}
        tls: Any = {"ca": _CA_FILE} if self.ca is not None else self.tls
        return {"host": self.host, "port": self.port, "tls": tls, **{k: v for k, v in login.items() if v is not None}}


class WirelessRobot:
    """``step`` it as often as its loop would turn. ``on_motors(seconds, (left, right))`` hears what the motors do.

    ``pause_s`` is how long it may wait for its next turn if no socket has news.
    """

    def __init__(
        self,
        kind: str,
        identity: Identity,
        broker: BrokerAddress,
        servers: LoopbackServers,
        *,
        on_motors: Callable[[float, Motors], None] | None = None,
        moving_s: float = _MOVING_S,
    ) -> None:
        if kind not in KINDS:
            raise ConfigError(f"there is no simulated {kind!r} with Wi-Fi, only {' and '.join(KINDS)}")
        self.kind, self.identity, self.broker = kind, identity, broker
        clock = RealClock()
        uid = hashlib.sha256(identity.base.encode()).digest()[:6]
        self.network = HostNetwork(clock, platform=OF_ROBOT[kind].platform, routes=servers.routes, uid=uid)
        self.board = Board(clock, self.network, uid)
        self.body = body_of(kind, self.board)
        self.body.on_motors = self._moved
        self._on_motors, self._moving_s = on_motors, moving_s
        self._motors: Motors = (0.0, 0.0)
        if broker.ca is not None:
            self.board.files[_CA_FILE] = _read(broker.ca)
        try:
            self._runner = Runner(self.board, kind, self._settings())
        except ValueError as error:  # settings that this firmware refuses
            raise ConfigError(f"{kind}: {error}") from None

    @property
    def pause_s(self) -> float:
        return self._moving_s if self.moving else _RESTING_S

    @property
    def firmware(self) -> Any:
        """The Robot that its firmware has built."""
        return self._runner.robot

    @property
    def moving(self) -> bool:
        return any(self._motors)

    @property
    def online(self) -> bool:
        """Whether its firmware takes itself for connected to the broker."""
        return str(self.firmware.link.state) == "online"

    @property
    def trouble(self) -> str:
        """Why it is not, as far as anybody knows."""
        reason = str(self.firmware.link.reason)
        return reason if "refused by the broker" in reason else self.network.trouble or reason

    def step(self) -> None:
        """One turn of the loop."""
        self._runner.step()
        self.body.settle()

    def stop(self) -> None:
        """Motors off and power off."""
        self.firmware.stop()
        self.network.power_off()
        self.body.settle()

    def state(self) -> BoardState:
        return self.body.state()

    def _settings(self) -> dict[str, Any]:
        robot = {"system": self.identity.system, "type": self.identity.type, "id": self.identity.id}
        wifi = {"ssid": "simulated", "password": "simulated"}
        return {"robot": robot, "wifi": wifi, "mqtt": self.broker.settings()}

    def _moved(self, now: float, motors: Motors) -> None:
        self._motors = motors
        if self._on_motors is not None:
            self._on_motors(now, motors)


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from None
