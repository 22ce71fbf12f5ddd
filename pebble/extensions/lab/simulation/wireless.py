"""A simulated MiniLAMP or BenJr: its board, its body, and a real connection to a broker."""

import hashlib
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from pebble.config.security import Security
from pebble.contract.identity import Identity
from pebble.errors import ConfigError
from pebble.extensions.lab.simulation.bodies import Pair, body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import RealClock
from pebble.extensions.lab.simulation.micropython.files import Files
from pebble.extensions.lab.simulation.micropython.modules.sockets import HostNetwork
from pebble.extensions.lab.simulation.micropython.ports import OF_ROBOT
from pebble.extensions.lab.simulation.micropython.runner import Runner
from pebble.transports import MqttSettings

KINDS: Final = ("minilamp", "benjr")

_MOVING_S, _RESTING_S = 0.01, 0.05  # period of turns while sockets are idle
_CA_FILE = "/ca.der"
_OPEN = Security()


class WirelessRobot:
    """A robot; ``step`` is a turn of its loop. ``on_motors(seconds, (left, right))`` is called when motors change.

    ``pause_s`` is the longest time until its next turn while its sockets are idle; ``moving_s`` is that time while its
    motors turn. ``files`` is the folder of its board's files, which survive the program; None: they are in memory.
    ``name``: the robot's name for people; empty: its id. ``security``: the level in its config.
    """

    def __init__(
        self,
        kind: str,
        identity: Identity,
        broker: MqttSettings,
        *,
        name: str = "",
        security: Security = _OPEN,
        on_motors: Callable[[float, Pair], None] | None = None,
        moving_s: float = _MOVING_S,
        files: Path | None = None,
    ) -> None:
        self.kind, self.identity, self.broker, self.name = kind, identity, broker, name
        self._security = security.on_board()
        clock = RealClock()
        uid = hashlib.sha256(identity.base.encode()).digest()[:6]
        self.network = HostNetwork(clock, platform=OF_ROBOT[kind].platform)
        self.board = Board(clock, self.network, uid, seed=secrets.randbits(64))  # other random numbers at each start
        self.board.files = Files(files)
        self.body = body_of(kind, self.board)
        if on_motors is not None:
            self.body.on_motors = on_motors
        self._moving_s = moving_s
        if broker.tls is not None and broker.tls.ca_cert is not None:
            self.board.files[_CA_FILE] = _read(broker.tls.ca_cert)
        try:
            self._runner = Runner(self.board, kind, self._settings())
        except ValueError as error:  # settings that this firmware does not support
            raise ConfigError(f"{kind}: {error}") from None

    @property
    def pause_s(self) -> float:
        return self._moving_s if self.moving else _RESTING_S

    @property
    def firmware(self) -> Any:
        """The robot object that the firmware has built."""
        return self._runner.robot

    @property
    def moving(self) -> bool:
        return any(self.body.motors)

    @property
    def online(self) -> bool:
        """True if the firmware is connected to the broker and subscribed."""
        return str(self.firmware.session.connection.state) == "online"

    @property
    def problem(self) -> str:
        """Reason why the robot is not online; "" if unknown."""
        reason = str(self.firmware.session.connection.reason)
        return reason if "refused by the broker" in reason else self.network.problem or reason

    def step(self) -> None:
        """Run one turn of the loop."""
        self._runner.step()
        self.body.end_turn()

    def stop(self) -> None:
        """Stop the motors and power off."""
        self.firmware.stop()
        self.network.power_off()
        self.body.end_turn()

    def _settings(self) -> dict[str, Any]:
        robot = {"system": self.identity.system, "type": self.identity.type, "id": self.identity.id, "name": self.name}
        wifi = {"ssid": "simulated", "password": "simulated"}
        security = {"security": self._security} if self._security else {}
        return {"robot": robot, "wifi": wifi, "mqtt": self._mqtt(), **security}

    def _mqtt(self) -> dict[str, Any]:
        """Return the section ``mqtt`` of the board's private_config.json."""
        broker = self.broker
        tls: Any = broker.tls is not None
        if broker.tls is not None and broker.tls.ca_cert is not None:
            tls = {"ca": _CA_FILE}
        login = {"username": broker.username, "password": broker.password} if broker.username is not None else {}
        return {"host": broker.host, "port": broker.port, "tls": tls, **login}


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from None
