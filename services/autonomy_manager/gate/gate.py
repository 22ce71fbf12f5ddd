"""A broker for the scripts of one run: opened before they start, closed after they have ended."""

import secrets
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from pebble.config import Config
from pebble.errors import PebbleError
from pebble.runtime.connections import LOCAL_RECONNECT_S, mqtt_settings
from pebble.services.autonomy_manager.gate.activity import Activity
from pebble.services.autonomy_manager.gate.client_filter import ClientFilter, Login
from pebble.services.autonomy_manager.gate.config_copy import ConfigCopy, broker_of
from pebble.services.autonomy_manager.gate.drive_outlet import DriveOutlet
from pebble.services.autonomy_manager.gate.server import MAX_CONNECTIONS, GateServer
from pebble.services.autonomy_manager.gate.topics import TopicRules
from pebble.transports.counters import Counters
from pebble.transports.credentials import Credentials

_USER = "script"
_JOIN_S = 2.0


class Gate:
    """Gives scripts a config (:attr:`config_path`) whose broker signs what they drive with ``run``.

    ``publish(topic, payload)`` sends a signed command on the robot's own transport; the gate calls it on any thread.
    Everything else that scripts send goes to the robot's broker.
    """

    def __init__(self, config: Config, publish: Callable[[str, bytes], object], run: int) -> None:
        """Raises PebbleError if the robot has no broker, or its config no file."""
        self.counters = Counters()  # signed, refused, stale, halted, overridden
        self.activity = Activity()
        self._rules = TopicRules.of(config)
        self._broker = broker_of(config)
        self._copy = ConfigCopy(config)
        self._outlet = DriveOutlet(run, self._send, self.counters)
        self._publish = publish
        self._halted = False
        self._overridden: dict[str, float] = {}  # by drive topic, until when
        self._sending = threading.Lock()  # orders the commands of scripts and the caller's stop
        self._server: GateServer | None = None
        self._opened = ExitStack()

    @property
    def config_path(self) -> Path:
        """The config for the scripts; exists while the gate is open. Raises PebbleError if it cannot."""
        self._copy.keep()
        return self._copy.path

    def open(self) -> None:
        """Listen, and write the config. Raises PebbleError."""
        password = secrets.token_urlsafe(24)
        with ExitStack() as opened:
            credentials = Credentials(mqtt_settings(self._broker, reconnect_max_s=LOCAL_RECONNECT_S))
            try:
                listener = opened.enter_context(socket.create_server(("127.0.0.1", 0), backlog=MAX_CONNECTIONS))
            except OSError as error:
                raise PebbleError(f"no port for scripts that speak MQTT: {error.strerror}") from None
            opened.callback(self._copy.remove)
            self._copy.write(listener.getsockname()[1], _USER, password)
            own = Login(_USER.encode(), password.encode())
            self._serve(listener, credentials, own, opened)
            self._opened = opened.pop_all()

    def halt(self) -> None:
        """When this returns, no command that moves is published any more: the run is being stopped. Zeros still are."""
        with self._sending:
            self._halted = True
        if self._server is not None:
            self._server.post(self._outlet.halt)

    def override(self, topic: str, seconds: float) -> None:
        """Publish nothing on this drive topic for ``seconds``: a person drives there. On any thread.

        The motor owner would refuse it, but others hear it: wheel odometry takes the sign of each wheel from there.
        """
        self._overridden[topic] = time.monotonic() + seconds

    def close(self) -> None:
        """Close all connections, and remove the config. May be called again."""
        self._opened.close()

    def _send(self, topic: str, payload: bytes, moves: bool) -> None:
        with self._sending:
            if time.monotonic() < self._overridden.get(topic, float("-inf")):
                self.counters.add("overridden")
            elif not (moves and self._halted):
                self._publish(topic, payload)

    def _serve(self, listener: socket.socket, credentials: Credentials, own: Login, opened: ExitStack) -> None:
        user = _encoded(self._broker.username)
        self._server = server = GateServer(
            listener,
            lambda: (self._broker.host, self._broker.port, credentials.context()),
            self._outlet,
            lambda: ClientFilter(self._rules, own, Login(user, _encoded(credentials.password()))),
            self.activity,
        )
        thread = threading.Thread(target=server.serve, name="gate", daemon=True)
        thread.start()
        opened.callback(thread.join, _JOIN_S)
        opened.callback(server.stop)


def _encoded(text: str | None) -> bytes | None:
    return None if text is None else text.encode()
