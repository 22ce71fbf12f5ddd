"""A command's short-lived connection to a robot's local transport or to a broker."""

import getpass
import logging
import os
import queue
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pebble.config import Config, load
from pebble.contract import CAPABILITIES, ONLINE
from pebble.errors import ConfigError, PebbleError, TransportError
from pebble.extensions.operator.client.named_topics import NamedTopics
from pebble.extensions.operator.client.names import ANY_ROBOT, Names, base_of, spellings
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.operator.client.url import settings_of
from pebble.extensions.operator.notices import PATIENCE_S, noticed
from pebble.runtime.addresses import Addresses
from pebble.runtime.connections import REMOTE_RECONNECT_S, local_settings, mqtt_settings, zenoh_settings
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from pebble.transports.hosts import SMALL_SEGMENT

log = logging.getLogger(__name__)

_STEP_S = 0.005  # between two looks at a condition
_LATE_S = 0.25  # some brokers send what is retained so long after they have acknowledged a subscription
OPEN_TIMEOUT_S = 3.0
_WAITING = 10_000  # messages that wait to be printed before new ones are dropped


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """The options of a ``pebble topic`` command that select where to connect."""

    config: Path | None = None
    url: str | None = None
    robot: str | None = None
    remote: bool = False
    password_file: Path | None = None
    ca_cert: Path | None = None
    program: str = "tool"  # the end of its client id, where the config sets one: two with one id end each other


def target_of(robot: str | None, options: Target) -> Target:
    """Return where to connect: with --url or --config ``robot`` is an id, else a config file. Raises PebbleError."""
    if options.config is None and options.url is None:
        if robot is None:
            raise PebbleError("where to connect is missing: use either --config CONFIG or --url URL")
        if not Path(robot).is_file():
            raise PebbleError(f"{robot} is not a config file: name one, or add --url or --config for the robot {robot}")
        return replace(options, config=Path(robot))
    if robot is not None and robot.endswith(".json") and Path(robot).is_file():
        raise PebbleError(f"{robot} is a config file: leave out --url and --config, or give the robot's id instead")
    return replace(options, robot=robot)


@contextmanager
def connected(
    target: Target, *, needed: bool = True, undone: str = "", patience_s: float = PATIENCE_S
) -> Iterator[tuple[Transport, Names]]:
    """Connect, and disconnect at the end. Raises PebbleError with a remedy if the connection fails.

    ``needed`` False: a connection that cannot be made yet is tried again and again in the ``with`` block. If it takes
    longer than ``patience_s``, a line says so. ``undone``: as in :func:`connecting`.
    """
    kind, settings, names, where = resolve(target)
    transport = create(kind, f"pebble-tool-{os.getpid()}", in_small_segments(settings))
    with closing(transport):
        with connecting(where, lambda: transport.problem, undone, patience_s):
            transport.open(OPEN_TIMEOUT_S)
        if needed and transport.state is not State.CONNECTED:
            why = transport.problem or f"no answer within {OPEN_TIMEOUT_S:g} s"
            raise TransportError(f"cannot connect to {where}: {why}")
        not_received = _report_missing(transport)  # in words
        yield transport, _as_spelled(transport, names) if needed else names
        _report_missing(transport, not_received)  # what was subscribed to meanwhile may be refused


def connecting(
    where: str, problem: Callable[[], str], undone: str = "", patience_s: float = PATIENCE_S
) -> AbstractContextManager[None]:
    """Return a context in which a line says after ``patience_s`` that there is no connection yet.

    ``undone``: what has to wait for it, as the line then begins; it ends with the ``problem``.
    """
    return noticed(
        lambda: ": ".join(filter(None, (undone, f"connecting to {where}", undone and problem()))), patience_s
    )


def _as_spelled(transport: Transport, names: Names) -> Names:
    """Return the names of the robot's topics with its accents as it spells them; of one that is silent, as they are."""
    heard, bases = set[str](), spellings(names.base)

    def hear(base: str, _message: Message) -> None:
        heard.add(base)

    if len(bases) > 1:  # it has accents
        handlers = {channel.topic(base): partial(hear, base) for channel in (CAPABILITIES, ONLINE) for base in bases}
        subscriptions = transport.subscribe_all(handlers, direct=True)
        wait_for(lambda: heard, _LATE_S)
        for subscription in subscriptions:
            subscription.close()
    return names if names.base in heard or not heard else Names(heard.pop(), account=names.account)


@contextmanager
def listening(sender: Transport) -> Iterator[Transport]:
    """Yield a connection to the same broker as ``sender``, for receiving, so that what arrives delays no command.

    The new connection may not be open yet. On Zenoh, or if the config sets the client id, it is ``sender`` itself.
    """
    settings = sender.settings
    if not isinstance(settings, MqttSettings) or settings.client_id is not None:
        yield sender
        return
    transport = create("mqtt", f"pebble-tool-{os.getpid()}-listening", settings)
    with closing(transport.open(0.0)):
        yield transport
        _report_missing(transport)


def in_small_segments(settings: Any) -> Any:
    """Return the settings changed to small TCP segments, for a network that may lose large packets."""
    return replace(settings, max_segment=SMALL_SEGMENT) if isinstance(settings, MqttSettings) else settings


def _report_missing(transport: Transport, before: str = "") -> str:
    """Log what cannot be received, unless it is the same as ``before``; return it."""
    not_received = transport.not_received if transport.state is State.CONNECTED else ""
    if not_received not in ("", before):
        log.error("%s", not_received)
    return not_received


def resolve(target: Target) -> tuple[str, Any, Names, str]:
    """Return the kind of transport, its settings, the names of its topics, and the place in words.

    Raises PebbleError.
    """
    if (target.config is None) == (target.url is None):
        raise PebbleError("where to connect is missing: use either --config CONFIG or --url URL")
    if target.config is not None:
        return _of_config(load(target.config, lenient=True), target)
    url = str(target.url)
    if target.remote:
        raise PebbleError("--remote needs --config; with --url name the remote broker itself")
    kind, settings = settings_of(url, password_file=target.password_file, ca_cert=target.ca_cert)
    base = ANY_ROBOT if target.robot is None else base_of(target.robot)
    return kind, settings, Names(base, account=_account(settings)), url


def _account(settings: Any) -> str | None:
    """Return the account at the broker: "" for none; None without a broker."""
    return settings.username or "" if isinstance(settings, MqttSettings) else None


def me(account: str | None = None) -> str:
    """Return the sender of this command, such as ``ann@desk``: the account (without one, the user) at this machine."""
    try:
        user = account or getpass.getuser()
    except (ImportError, KeyError, OSError):  # no name for this user id, or no such ids
        user = "unknown"
    return f"{user}@{socket.gethostname()}"


def put_account_into_topics(transport: Transport, names: Names, is_named: Callable[[str], bool]) -> None:
    """Let the transport put this client's account into the topics of commands, for robots that read only such topics.

    ``is_named(base)`` returns True if the robot with this base is one of them.
    """
    if names.account is not None:
        transport.policy.forms = NamedTopics(names.account, is_named).forms


def _of_config(config: Config, target: Target) -> tuple[str, Any, Names, str]:
    """Return the result of :func:`resolve` for a robot's local transport, or the broker that its bridge connects to."""
    base = config.base if target.robot is None else base_of(target.robot)
    addresses = Addresses(config) if base == config.base else None  # of another robot no renamed topics are known
    if target.remote:
        kind, settings = _remote(config, target.program)
        return kind, settings, Names(base, addresses, _account(settings)), f"the remote side of {config.base}"
    names = Names(base, addresses)
    if config.transport.kind == "zenoh":
        return "zenoh", zenoh_settings(config, client=True), names, f"the hub of {config.base}"
    where = f"{config.base} by {config.transport.kind}"
    if config.transport.kind == "mqtt":
        where = f"the broker of {config.base} at {config.local_mqtt.host}:{config.local_mqtt.port}"
    return config.transport.kind, local_settings(config), names, where


def _remote(config: Config, program: str) -> tuple[str, Any]:
    bridge = config.services.mqtt_bridge
    if bridge.remote is not None and bridge.remote.kind != "mqtt":
        raise ConfigError("services.mqtt_bridge.remote: --remote uses MQTT only, and this robot's uplink does not")
    if not bridge.remote_mqtt.host:
        raise ConfigError("services.mqtt_bridge.remote_mqtt.host: is not set, so there is no remote side")
    return "mqtt", mqtt_settings(bridge.remote_mqtt, reconnect_max_s=REMOTE_RECONNECT_S, program=program)


class Listener:
    """A queue from the transport's threads to the thread that prints."""

    def __init__(self, transport: Transport, filters: Iterable[str]) -> None:
        self._waiting: queue.Queue[Message] = queue.Queue(_WAITING)
        self.dropped = 0  # messages that arrived faster than they were printed
        self.subscribe(transport, filters)

    def subscribe(self, transport: Transport, filters: Iterable[str]) -> None:
        """Subscribe to more topics; on a slow network this takes seconds."""
        for filter_ in filters:
            transport.subscribe(filter_, self._take, qos=QoS.DELIVERED)

    def next(self, timeout: float) -> Message | None:
        """Return the next message, waiting up to ``timeout`` seconds; None if none comes."""
        try:
            return self._waiting.get(timeout=max(timeout, 0.0))
        except queue.Empty:
            return None

    def _take(self, message: Message) -> None:
        try:
            self._waiting.put_nowait(message)
        except queue.Full:
            self.dropped += 1


def subscribed_stop(transport: Transport, base: str) -> RobotEstop:
    """Return a robot's emergency stop after reading its retained states.

    Some brokers send retained messages a moment after the subscription.
    """
    robot = RobotEstop(base)
    robot.subscribe(transport)
    wait_for(lambda: robot.has_capabilities, _LATE_S)
    transport.ask(robot.missing)  # again, for the owners that late capabilities have listed
    wait_for(lambda: not robot.missing, _LATE_S)
    return robot


def wait_for(condition: Callable[[], object], seconds: float, read: Callable[[], None] = lambda: None) -> bool:
    """Wait until ``condition`` is true, with ``read`` before each look; return False after ``seconds``."""
    end = time.monotonic() + seconds
    while True:
        read()
        if condition():
            return True
        if time.monotonic() >= end:
            return False
        time.sleep(_STEP_S)
