"""Decides which robots keep their places in a bounded table: anybody at a broker can add components to it. Pure."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

from pebble.contract import CAPABILITIES, ESTOP_STATE
from pebble.runtime.robot_estop import RobotEstop
from pebble.transports import Message


class Rank(NamedTuple):
    """How much speaks for a component being a real robot; the first difference decides."""

    has_state: bool = False  # a motor owner of it has published whether it is stopped
    known: bool = False  # from before
    has_capabilities: bool = False
    live: bool = False  # anything but retained messages has arrived from it

    @classmethod
    def of(cls, estop: RobotEstop, *, known: bool, live: bool) -> Rank:
        """That of a component of which this is known."""
        return cls(bool(estop.states), known, estop.has_capabilities, live)

    @classmethod
    def at_most(cls, metric: str, *, known: bool, live: bool) -> Rank:
        """The highest that a component can have of which only a message of this metric is known."""
        return cls(metric.startswith(_STATE), known, metric == CAPABILITIES.metric, live)

    @classmethod
    def of_message(cls, base: str, message: Message, *, known: bool, live: bool) -> Rank:
        """That of a component of which only this message is known."""
        estop = RobotEstop(base)
        estop.receive(message)
        return cls.of(estop, known=known, live=live)


class Ranked(Protocol):
    """What a table holds."""

    @property
    def rank(self) -> Rank: ...


_STATE = ESTOP_STATE.metric.partition("{")[0]

R = TypeVar("R", bound=Ranked)


class RankedTable(dict[str, R]):
    """At most ``most`` components by base topic; where it is full, one of the lowest rank gives way to a higher one."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most = most
        self._floor = Rank()  # none in the table has a lower rank, so that most of a flood is refused without a search

    def __setitem__(self, base: str, one: R) -> None:
        self._floor = min(self._floor, one.rank)
        super().__setitem__(base, one)

    def refuses(self, rank: Rank) -> bool:
        """Whether there is surely no room for one of this rank."""
        return len(self) >= self._most and rank <= self._floor

    def make_room(self, rank: Rank, remove: Callable[[str], object]) -> bool:
        """Makes room for one of this rank by ``remove``, if necessary; False if none has a lower rank."""
        if len(self) < self._most:
            return True
        lowest = self.lowest(rank)
        if lowest is None:
            return False
        remove(lowest)
        return True

    def lowest(self, below: Rank) -> str | None:
        """One of the lowest rank there is, if that is ``below`` this one."""
        if below <= self._floor:
            return None
        base = min(self, key=lambda one: self[one].rank)
        self._floor = self[base].rank
        return base if self._floor < below else None

    def ranks_may_have_fallen(self) -> None:
        """To be called from time to time where ranks fall; where they only rise, never."""
        self._floor = Rank()
