"""A running robot under test, seen from its own transport and from its operators' broker."""

from __future__ import annotations

import os
import pwd
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from pebble import contract as c
from pebble.config import Config
from pebble.config.hosts import is_loopback
from pebble.contract.identity import parse_topic
from pebble.errors import PebbleError
from pebble.extensions.checks.conform.motion import RESTS_S
from pebble.extensions.checks.observer import Observer
from pebble.extensions.operator.client.connection import Target, connected, wait_for
from pebble.extensions.operator.client.names import Names
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.operator.places import Places
from pebble.runtime.addresses import Addresses
from pebble.transports import Transport

PATIENCE_S = 3.0
_HEARTBEATS_S = 2.5  # within which a robot at a broker of this machine sends one
_STATES = (c.ONLINE, c.CAPABILITIES, c.STATUS, c.ESTOP_STATE)
_WATCHED = (*_STATES, c.CONTROL_STATE, c.LINK, c.CHARGING_LEVEL, c.CHARGING_STATUS, c.AUTONOMY_STATUS)
_ANY = "+/+/+"


class RobotSide(Observer):
    """A connection to one side of the robot: its own transport, or the broker of its operators."""

    def __init__(self, config: Config, target: Target, transport: Transport, names: Names, *, own: bool) -> None:
        """Store the connection. ``own``: it is the robot's own transport."""
        self.own = own
        self._addresses = Addresses(config)
        watched = (*_WATCHED, c.TOUCH_SENSORS) if own else _WATCHED
        super().__init__(target, transport, names, [self._addresses[channel].topic for channel in watched])

    def is_here(self, config: Config) -> bool:
        """True if this side is on this machine. Then retained messages of other ids may be from before a rename."""
        if self.own:
            return config.transport.kind != "mqtt" or is_loopback(config.local_mqtt.host)
        return is_loopback(config.services.mqtt_bridge.remote_mqtt.host)

    def ask(self, patience_s: float) -> None:
        """Subscribe to retained topics by name, as some brokers require, also to those of motor owners."""
        estop = self.view.estop
        self.transport.ask([self._addresses[channel].topic for channel in _WATCHED if not channel.is_pattern])
        self.wait(lambda: estop.has_capabilities, patience_s)
        self.transport.ask([*estop.missing, *estop.missing_control])

    def others(self) -> tuple[dict[str, list[str]], set[str]]:
        """Return other robots' retained topics, by base topic, and the bases that send heartbeats."""
        topics: defaultdict[str, list[str]] = defaultdict(list)
        live: set[str] = set()
        with self.beside("selftest-others", *(channel.filter(_ANY) for channel in _STATES)) as (_, messages):
            self.look(_HEARTBEATS_S)
        for message in list(messages):
            address = parse_topic(message.topic)
            if address is None or address.identity.is_server or address.identity.base == self.base:
                continue
            if message.retain and message.payload:
                topics[address.identity.base].append(message.topic)
            elif address.metric == c.ONLINE.metric:
                live.add(address.identity.base)
        return topics, live

    @property
    def status(self) -> dict[str, object]:
        """Return the value of the newest status; empty before the first."""
        values = [record.value.value for record in self.of(c.STATUS, retained=True) if record.value is not None]
        return values[-1] if values else {}

    @property
    def heartbeats(self) -> list[float]:
        """Return the times at which live heartbeats arrived (monotonic)."""
        return [record.at for record in self.of(c.ONLINE) if record.value is not None]


@dataclass(kw_only=True)
class RobotUnderTest:
    """A robot and its two sides. ``why_own`` and ``why_operators``: why a side could not be reached."""

    config: Config
    places: Places
    by: str  # who tests it, for stops and control: ann@goob
    patience_s: float  # for a picture, a sound, and other answers
    rests_s: float  # so long after the last command wheels may turn
    own: RobotSide | None = None
    operators: RobotSide | None = None
    why_own: str = ""
    why_operators: str = ""

    @property
    def sides(self) -> list[RobotSide]:
        return [side for side in (self.own, self.operators) if side is not None]

    @property
    def commanding_side(self) -> RobotSide:
        """Return the side from which to send commands: the operators' if it is reached, else its own."""
        return self.operators or self.own_side

    @property
    def own_side(self) -> RobotSide:
        """Return the robot's own side. A check uses it only if that side is connected."""
        assert self.own is not None  # noqa: S101
        return self.own

    @property
    def view(self) -> RobotView:
        return self.own_side.view

    def read(self) -> None:
        for side in self.sides:
            side.read()

    def wait(self, condition: Callable[[], object], seconds: float) -> bool:
        """Read messages of both sides until ``condition`` holds; return False if it does not within ``seconds``."""
        return wait_for(condition, seconds, self.read)


def user_of(folder: Path) -> pwd.struct_passwd | None:
    """Return the user that root must become to reach the robot with this folder; None: the present user.

    As that user, root leaves no files of its own.
    """
    owner = folder.stat().st_uid if folder.is_dir() else 0
    return pwd.getpwuid(owner) if owner and os.geteuid() == 0 else None


def become_user_of(folder: Path) -> None:
    """Continue as the user that :func:`user_of` returns."""
    user = user_of(folder)
    if user is not None:
        os.initgroups(user.pw_name, user.pw_gid)
        os.setgid(user.pw_gid)
        os.setuid(user.pw_uid)


@contextmanager
def reached(
    config: Config, places: Places, by: str, *, patience_s: float = PATIENCE_S, rests_s: float = RESTS_S
) -> Iterator[RobotUnderTest]:
    """Yield a robot, connected on each side that can be reached; disconnect at the end of the block.

    The arguments are fields of :class:`RobotUnderTest`.
    """
    robot = RobotUnderTest(config=config, places=places, by=by, patience_s=patience_s, rests_s=rests_s)
    with ExitStack() as stack:

        def connect(*, own: bool) -> tuple[RobotSide | None, str]:
            target = Target(config=config.path, remote=not own, program="selftest")
            try:
                transport, names = stack.enter_context(connected(target))
                return RobotSide(config, target, transport, names, own=own), ""
            except PebbleError as error:
                return None, str(error)

        robot.own, robot.why_own = connect(own=True)
        robot.why_operators = "its config has no mqtt_bridge"
        if config.services.mqtt_bridge.enabled:
            robot.operators, robot.why_operators = connect(own=False)
        for side in robot.sides:
            side.ask(robot.patience_s)
        yield robot
