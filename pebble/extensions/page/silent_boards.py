"""Silent boards (heartbeats, but no capabilities: the original Pebble's), and who lets pages drive them.

The config permits it, or a person with the right; that is stored until it is withdrawn, or the board publishes
capabilities.
"""

import logging
import time
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
from msgspec import Struct

from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.extensions.fleet.people import People
from pebble.extensions.operator.client.assumed import AXES, HEARD_S, PARKED, RISK
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.page import messages as m
from pebble.extensions.page.config import ListedRobot
from pebble.extensions.page.drive.drivers import Drivers
from pebble.extensions.page.robots import Component, Robots
from pebble.extensions.page.setting import WebSettings
from pebble.transports import Message, Subscription

log = logging.getLogger(__name__)

Spawn = Callable[[Coroutine[Any, Any, None]], None]

_SETTING = "assumes "  # begins the key of a setting in the people's database; the component follows
_METRIC = "web/board"
_CONFIG = "web_interface.robots"
_NAMED = f'At level named it is driven only with "plain": true, in fleet.json and in {_CONFIG}'


class Permission(Struct, frozen=True):
    """A permission for pages to drive a board along ``axes``; no axes: a refusal."""

    by: str = ""  # who has given it
    axes: tuple[str, ...] = ()
    at: float = 0.0


class _Board(Struct):
    """A silent board. Its drive topic is read before anything is sent there, as a retained command would move it."""

    heard_at: float  # since when it is known
    permission: Permission | None = None  # None: it has not been known for long enough
    subscription: Subscription | None = None  # to its drive topic


class SilentBoards:
    """The silent boards of one server. Used on the event loop only."""

    def __init__(self, broker: Broker, robots: Robots, drivers: Drivers, people: People, settings: WebSettings) -> None:
        self._broker, self._robots, self._drivers, self._people = broker, robots, drivers, people
        self._listed, self._is_named = settings.listed, settings.level == "named"
        robots.names = {ref: listed.name[:32] for ref, listed in settings.listed.items() if listed.name}
        self._boards: dict[str, _Board] = {}

    def refresh(self, now: float, spawn: Spawn) -> None:
        """Add boards that have become silent, and remove those that no longer are. Call this a few times a second."""
        silent = {ref: component for ref, component in self._robots.components.items() if component.robot.silent}
        for ref in self._boards.keys() - silent:
            if (subscription := self._boards.pop(ref).subscription) is not None:
                spawn(self._broker.unsubscribe(subscription))
            if ref in self._robots.components:
                self._robots.set_server_metric(ref, _METRIC, m.BoardView(silent=False))
        for ref, component in silent.items():
            # once anything was omitted, a robot may look silent whose capabilities found no room
            may_be_board = ref.split("/")[1] == "robots" and not self._robots.omitted
            if ref not in self._boards and may_be_board and component.robot.online(now):
                self._boards[ref] = _Board(now)
            if ref in self._boards:
                self._follow(component, self._boards[ref], now, spawn)

    def ask(self, op: m.BoardOp, user: str) -> str:
        """Apply a page's request; return why it is refused. Raises DatabaseError."""
        board = self._boards.get(op.ref)
        if board is None or board.permission is None:
            return "It is no board that does not say what it can do"
        if op.do == "clear":  # it changes no permission
            sent = self._broker.publish(DRIVE.topic(op.ref), b"", retain=True, remember=False)
            return "" if sent else "The server cannot reach the broker"
        if why := self._refusal(op.ref):
            return why
        axes: tuple[str, ...] = ()  # "withdraw"
        if op.do == "allow":
            axes = (*AXES, "y") if op.extra else AXES  # extra: the board has this axis, too
        permission = Permission(user, axes, time.time())
        self._people.set(_SETTING + op.ref, msgspec.json.encode(permission).decode())
        board.permission = permission
        if not axes:
            self._drivers.stop(op.ref, user)
        return ""

    def _follow(self, component: Component, board: _Board, now: float, spawn: Spawn) -> None:
        """Subscribe to a board's drive topic once it was online for HEARD_S; after that let pages drive it."""
        ref, robot = component.ref, component.robot
        if board.permission is None:  # it is not subscribed to yet
            if not robot.online(now):
                del self._boards[ref]
            elif now - board.heard_at >= HEARD_S:
                board.permission = self._permission(ref)
                spawn(self._subscribe(ref, board))
        elif board.subscription is not None:
            has_changed = robot.assume(board.permission.axes, self._robots.names.get(ref, ""))
            if has_changed:  # pages see the capabilities that the robot is assumed to have
                self._robots.show_announced(component, now)
            view = m.BoardView(
                silent=True,
                by=board.permission.by if board.permission.axes else "",
                refused=self._refusal(ref),
                parked=PARKED if robot.parked else "",
                risk=RISK,
            )
            self._robots.set_server_metric(ref, _METRIC, view)

    def _permission(self, ref: str) -> Permission:
        """Return the permission that the config gives or refuses, or else the one that a person has stored."""
        listed = self._listed.get(ref, ListedRobot())
        if self._refusal(ref):  # no person may decide, so the config does
            # At level named a board gets commands only if its account takes them without a name in the topic.
            takes_plain_commands = listed.plain or not self._is_named
            is_allowed = listed.drive and takes_plain_commands
            return Permission("the config", listed.axes) if is_allowed else Permission()
        try:
            return msgspec.json.decode(self._people.get(_SETTING + ref) or "{}", type=Permission)
        except (PebbleError, msgspec.MsgspecError) as error:
            log.warning("whether pages may drive %s is not known: %s", ref, error)
            return Permission()

    def _refusal(self, ref: str) -> str:
        """Return why a person cannot change the permission; empty if they can."""
        listed = self._listed.get(ref, ListedRobot())
        if self._is_named and not listed.plain:
            return _NAMED
        return "" if listed.drive is None else f"{_CONFIG} decides that: change it there"

    async def _subscribe(self, ref: str, board: _Board) -> None:
        """Subscribe to the board's drive topic, to see whether a command is retained there."""

        def take(message: Message, now: float) -> None:
            if (robot := self._robots.view(ref)) is not None:
                robot.receive(DRIVE, message, now, 0.0)  # the wall time is for heartbeats only

        try:
            board.subscription = await self._broker.subscribe(DRIVE.topic(ref), take)
        except PebbleError as error:
            log.warning("%s is not driven: %s", ref, error)
