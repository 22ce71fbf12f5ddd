"""Boards that send heartbeats and never say what they can do, as the original's: whether pages drive them.

The config says so, or a person with the right; that is remembered until it is withdrawn, or the board says itself what
it can do.
"""

import logging
import time
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
from msgspec import Struct

from pebble.contract import DRIVE
from pebble.contract.identity import parse_topic
from pebble.errors import PebbleError
from pebble.extensions.fleet.database import DatabaseError
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

_SETTING = "assumes "  # what a setting of the server begins with; then the component
_METRIC = "web/board"
_CONFIG = "web_interface.robots"
_NAMED = f'At level named it is driven only with "plain": true, in fleet.json and in {_CONFIG}'


class Permission(Struct, frozen=True):
    """Who lets pages drive a board, and by which axes; no axes: nobody does."""

    by: str = ""
    axes: tuple[str, ...] = ()
    at: float = 0.0


class _Board:
    """One that is silent; its drive topic is received, because a command that is retained there moves it."""

    def __init__(self, heard_at: float) -> None:
        self.heard_at = heard_at
        self.permission: Permission | None = None  # not read yet
        self.subscription: Subscription | None = None
        self.is_asking = False


class SilentBoards:
    """It belongs to one server. Only the event loop calls it."""

    def __init__(self, broker: Broker, robots: Robots, drivers: Drivers, people: People, settings: WebSettings) -> None:
        self._broker, self._robots, self._drivers, self._people = broker, robots, drivers, people
        self._listed, self._is_named = settings.listed, settings.level == "named"
        robots.names = {ref: listed.name[:32] for ref, listed in settings.listed.items() if listed.name}
        self._boards: dict[str, _Board] = {}

    def refresh(self, now: float, spawn: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        """Look for boards that are silent, or no longer; to be called a few times a second."""
        for ref in self._boards.keys() - {ref for ref, one in self._robots.components.items() if one.robot.silent}:
            if (subscription := self._boards.pop(ref).subscription) is not None:
                spawn(self._broker.unsubscribe(subscription))
            if ref in self._robots.components:
                self._robots.set_server_metric(ref, _METRIC, m.BoardView(silent=False))
        for ref, component in self._robots.components.items():
            if component.robot.silent and _is_robot(ref):
                self._follow(component, now, spawn)

    def ask(self, op: m.BoardOp, user: str) -> str:
        """Do what a page asks; return why not. Raises DatabaseError."""
        board = self._boards.get(op.ref)
        if board is None or board.permission is None:
            return "It is no board that does not say what it can do"
        if op.do == "clear":
            sent = self._broker.publish(DRIVE.topic(op.ref), b"", retain=True, remember=False)
            return "" if sent else "The server cannot reach the broker"
        if why := self._refusal(op.ref):
            return why
        axes = (*AXES, *["y"] * op.extra) if op.do == "allow" else ()
        permission = Permission(user, axes, time.time())
        self._people.set(_SETTING + op.ref, msgspec.json.encode(permission).decode() if axes else "")
        board.permission = permission
        if not axes:
            self._drivers.stop(op.ref, user)
        return ""

    def _follow(self, component: Component, now: float, spawn: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        ref, robot = component.ref, component.robot
        board = self._boards.get(ref)
        if board is None and robot.online(now) and not self._robots.omitted:  # of a crowd none is taken for one
            board = self._boards[ref] = _Board(now)
        if board is None:
            return
        if board.permission is None:
            if not robot.online(now):
                del self._boards[ref]
            elif now - board.heard_at >= HEARD_S:
                self._read(ref, board)
            return
        if board.permission.axes and board.subscription is None:
            if not board.is_asking:
                board.is_asking = True
                spawn(self._subscribe(ref, board))
            return
        if robot.assume(board.permission.axes, self._robots.names.get(ref, "")):
            self._robots.show_offer(component, now)
        self._show(ref, board, parked=robot.parked)

    def _read(self, ref: str, board: _Board) -> None:
        """Take what the config says, else what a person has said."""
        listed = self._listed.get(ref, ListedRobot())
        if self._is_named and not listed.plain:
            board.permission = Permission()
        elif listed.drive is not None:
            board.permission = Permission("the config", listed.axes if listed.drive else ())
        else:
            try:
                said = self._people.get(_SETTING + ref)
                board.permission = msgspec.json.decode(said, type=Permission) if said else Permission()
            except (DatabaseError, msgspec.MsgspecError) as error:
                board.heard_at += HEARD_S  # then it is tried again
                log.warning("whether pages may drive %s is not known: %s", ref, error)

    def _refusal(self, ref: str) -> str:
        """Why a person cannot change what counts."""
        listed = self._listed.get(ref, ListedRobot())
        if self._is_named and not listed.plain:
            return _NAMED
        return "" if listed.drive is None else f"{_CONFIG} decides that: change it there"

    def _show(self, ref: str, board: _Board, *, parked: bool) -> None:
        permission = board.permission or Permission()
        view = m.BoardView(
            silent=True,
            allowed=bool(permission.axes),
            by=permission.by,
            refused=self._refusal(ref),
            parked=PARKED if parked else "",
            risk=RISK,
        )
        self._robots.set_server_metric(ref, _METRIC, view)

    async def _subscribe(self, ref: str, board: _Board) -> None:
        """Receive what is retained on its drive topic, before anything is sent there."""

        def take(message: Message, now: float) -> None:
            if (robot := self._robots.view(ref)) is not None:
                robot.receive(DRIVE, message, now, 0.0)

        try:
            board.subscription = await self._broker.subscribe(DRIVE.topic(ref), take)
        except PebbleError as error:
            log.warning("%s is not driven: %s", ref, error)
        finally:
            board.is_asking = False


def _is_robot(ref: str) -> bool:
    address = parse_topic(f"{ref}/{DRIVE.direction}/{DRIVE.metric}")
    return address is not None and address.identity.type == "robots"
