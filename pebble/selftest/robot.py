"""The robot under test, as its own side and its operators' side show it."""

from __future__ import annotations

import os
import pwd
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pebble import contract as c
from pebble.client.connection import Target, connected, put_names
from pebble.client.names import Names
from pebble.client.robot_view import RobotView
from pebble.config import Config
from pebble.config.rules.exposure import is_near
from pebble.config.web import is_loopback
from pebble.contract import codec
from pebble.contract.identity import parse_topic
from pebble.contract.payloads import TouchValues
from pebble.errors import PayloadError, PebbleError
from pebble.runtime.addresses import Addresses
from pebble.setup.places import Places
from pebble.transports import Message, QoS, Transport

PATIENCE_S, RESTS_S = 3.0, 0.75
_STEP_S = 0.005
_WAITING = 20_000  # messages that have arrived and are not read yet: 50 samples of the wheels a second, and states
_STAMPS = 400  # newest heartbeats, and samples of the wheels
_MAX_IDS = 1000  # other robots at a broker of this machine
_STATES = (c.ONLINE, c.CAPABILITIES, c.STATUS, c.ESTOP_STATE)
_WATCHED = (*_STATES, c.CONTROL_STATE, c.LINK, c.CHARGING_LEVEL, c.CHARGING_STATUS, c.AUTONOMY_STATUS)
_ANY = "+/+/+"


class Touch(NamedTuple):
    """A sample of the wheels' sensors, and when it arrived (monotonic)."""

    at: float
    values: TouchValues


#: Gets the side on which a message arrived, the message, and when (monotonic).
Each = Callable[["Side", Message, float], None]


class Side:
    """One connection, and what the robot has published there. :meth:`pump` reads what has arrived."""

    def __init__(self, config: Config, target: Target, transport: Transport, names: Names, *, own: bool) -> None:
        """``own``: the robot's own side, where its processes meet."""
        self.target, self.transport, self.own = target, transport, own
        self.account = names.account  # None on its own side
        self.view = RobotView(config.base)
        self.status: dict[str, object] | None = None  # the newest status' value
        self.heartbeats: deque[float] = deque(maxlen=_STAMPS)  # when live ones arrived (monotonic)
        self.touches: deque[Touch] = deque(maxlen=_STAMPS)
        self.dropped = 0  # messages that came faster than they were read
        self.others: dict[str, set[str]] = {}  # retained topics by the base of another robot
        self.live: set[str] = set()  # other robots that send heartbeats
        self._addresses = Addresses(config)
        self._arrived: deque[tuple[Message, float, float]] = deque(maxlen=_WAITING)
        put_names(transport, names, lambda base: base == config.base and self.view.named)
        filters = {self._addresses[channel].topic for channel in (*_WATCHED, *((c.TOUCH_SENSORS,) if own else ()))}
        if self.is_here(config):  # each message comes once: of filters that overlap, only the wider ones
            filters -= {channel.filter(config.base) for channel in _STATES}
            filters |= {channel.filter(_ANY) for channel in _STATES}
        for filter_ in sorted(filters):
            transport.subscribe(filter_, self._take, direct=True)

    def is_here(self, config: Config) -> bool:
        """Whether it ends on this machine: what other robots have left there can only be left over."""
        if self.own:
            return config.transport.kind != "mqtt" or is_loopback(config.local_mqtt.host)
        return is_near(config.services.mqtt_bridge.remote_mqtt)

    def ask(self) -> None:
        """Some brokers send what is retained only to those who ask by name."""
        topics = [self._addresses[channel].topic for channel in _WATCHED if not channel.is_pattern]
        self.transport.ask([*topics, *self.view.estop.missing, *self.view.estop.missing_control])

    def publish(self, messages: Iterable[Message]) -> bool:
        """Publish all at once; False if one was not accepted."""
        accepted = [self.transport.publish(one.topic, one.payload, qos=one.qos, urgent=True) for one in messages]
        return all(accepted)

    def pump(self, each: Each) -> None:
        """Take note of what has arrived, and pass it to ``each``."""
        while self._arrived:
            message, at, wall = self._arrived.popleft()
            self._note(message, at, wall)
            each(self, message, at)

    def _take(self, message: Message) -> None:
        self.dropped += len(self._arrived) == _WAITING
        self._arrived.append((message, time.monotonic(), time.time()))

    def _note(self, message: Message, at: float, wall: float) -> None:
        base = self.view.base
        if not message.topic.startswith(f"{base}/") and self._addresses.channel(message.topic) is None:
            self._note_other(message)
            return
        channel = self._addresses.channel(message.topic)
        if channel is c.ONLINE:
            if self.view.heartbeat(message, at, wall) is not None:
                self.heartbeats.append(at)
            return
        try:
            if channel is c.TOUCH_SENSORS:
                self.touches.append(Touch(at, codec.decode(channel, message.payload).value))
            elif channel is c.STATUS:
                self.status = codec.decode(channel, message.payload).value
        except PayloadError:
            return
        self.view.receive(channel, message, at, wall)

    def _note_other(self, message: Message) -> None:
        address = parse_topic(message.topic)
        if address is None or address.identity.is_server:
            return
        base = address.identity.base
        if address.metric == c.ONLINE.metric and not message.retain:
            self.live.add(base)
        elif message.retain and message.payload and (base in self.others or len(self.others) < _MAX_IDS):
            self.others.setdefault(base, set()).add(message.topic)


@dataclass(kw_only=True)
class RobotUnderTest:
    """One robot, and its sides as far as they are reached; ``why_own`` and ``why_operators`` are why they are not."""

    config: Config
    places: Places
    by: str  # who tests it, for stops and control: ann@goob
    patience_s: float  # for a picture, a sound, and other answers
    rests_s: float  # so long after the last command wheels may turn
    own: Side | None = None
    operators: Side | None = None
    why_own: str = ""
    why_operators: str = ""

    @property
    def sides(self) -> list[Side]:
        return [side for side in (self.own, self.operators) if side is not None]

    @property
    def way(self) -> Side:
        """The side from which it is commanded: that of its operators, if it is reached."""
        return self.operators or self.inside

    @property
    def inside(self) -> Side:
        """Its own side, which the check needs."""
        assert self.own is not None  # noqa: S101
        return self.own

    @property
    def view(self) -> RobotView:
        return self.inside.view

    def wait(self, condition: Callable[[], object], seconds: float, each: Each | None = None) -> bool:
        """Read what arrives, and pass it to ``each``, until ``condition``; False: not within ``seconds``."""
        end = time.monotonic() + seconds
        while True:
            for side in self.sides:
                side.pump(each or _ignore)
            if condition():
                return True
            if time.monotonic() >= end:
                return False
            time.sleep(_STEP_S)


def _ignore(_side: Side, _message: Message, _at: float) -> None:
    """Nothing else follows from what arrives."""


def user_of(folder: Path) -> pwd.struct_passwd | None:
    """Root reaches the robot of this folder as this user, for its own files must not be there; None: as itself."""
    owner = folder.stat().st_uid if folder.is_dir() else 0
    return pwd.getpwuid(owner) if owner and os.geteuid() == 0 else None


def become_user_of(folder: Path) -> None:
    """Go on as :func:`user_of`."""
    user = user_of(folder)
    if user is not None:
        os.initgroups(user.pw_name, user.pw_gid)
        os.setgid(user.pw_gid)
        os.setuid(user.pw_uid)


@contextmanager
def reached(
    config: Config, places: Places, by: str, *, patience_s: float = PATIENCE_S, rests_s: float = RESTS_S
) -> Iterator[RobotUnderTest]:
    """Connect to both sides of a robot, as far as that is possible, until the block ends."""
    robot = RobotUnderTest(config=config, places=places, by=by, patience_s=patience_s, rests_s=rests_s)
    with ExitStack() as stack:

        def connect(target: Target, *, own: bool) -> tuple[Side | None, str]:
            try:
                transport, names = stack.enter_context(connected(target))
                return Side(config, target, transport, names, own=own), ""
            except PebbleError as error:
                return None, str(error)

        here = Target(config=config.path, program="selftest")
        robot.own, robot.why_own = connect(here, own=True)
        robot.operators, robot.why_operators = None, "its config has no mqtt_bridge"
        if config.services.mqtt_bridge.enabled:
            there = Target(config=config.path, remote=True, program="selftest")
            robot.operators, robot.why_operators = connect(there, own=False)
        for side in robot.sides:
            side.ask()
        robot.wait(lambda: all(side.view.estop.has_capabilities for side in robot.sides), robot.patience_s)
        for side in robot.sides:
            side.ask()
        yield robot


def message(channel: c.Channel, topic: str, payload: object) -> Message:
    return Message(topic, codec.encode(channel, payload), QoS(channel.default_qos))
