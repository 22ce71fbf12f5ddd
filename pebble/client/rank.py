"""Decides which robots keep their places in a bounded table: anybody at a broker can add components to it. Pure."""

from __future__ import annotations

from collections import Counter
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
    """At most ``most`` components by base topic. Where it is full, one gives way:

    * One that is known from before gives way to none, and gets a place of any other.
    * Of the others, those of one rank keep ``share`` places, whatever is invented of other ranks: it gets them from one
      that has more. What a rank has beyond gives way to higher ones.
    * Of equal ones those that were there first stay.
    """

    def __init__(self, most: int, share: int = 0) -> None:
        super().__init__()
        self._most, self._share = most, share
        self._refused: set[Rank] = set()  # there was no room for these: most of a flood is refused without a search
        self._refusals = 0
        self._shared = 0  # places that were got as a share, since ranks may have changed

    def __setitem__(self, base: str, one: R) -> None:
        self._refused.clear()
        super().__setitem__(base, one)

    def refuses(self, rank: Rank) -> bool:
        """Whether there was no room for one of this rank lately."""
        if len(self) < self._most or rank not in self._refused:
            return False
        self._refusals += 1
        if self._refusals % self._most == 0:
            self.ranks_have_changed()
        return True

    def make_room(self, rank: Rank, remove: Callable[[str], object]) -> bool:
        """Makes room for one of this rank by ``remove``, if necessary; False if none gives way to it."""
        if len(self) < self._most:
            return True
        if self.refuses(rank):
            return False
        counts = Counter(one.rank for one in self.values())
        lacks = counts[rank] < self._share and self._shared < self._share

        def gives_way(other: Rank) -> bool:
            return rank.known or (counts[other] > self._share and (lacks or other < rank))

        lowest = self._lowest(lambda one: gives_way(one.rank))
        if lowest is None:
            self._refused.add(rank)
            return False
        self._shared += self[lowest].rank >= rank
        remove(lowest)
        return True

    def below(self, rank: Rank, among: Callable[[R], bool]) -> str | None:
        """One of the lowest rank ``among`` those that are not known from before, and of a lower rank than this."""
        return self._lowest(lambda one: one.rank < rank and among(one))

    def ranks_have_changed(self) -> None:
        """To be called from time to time where ranks fall."""
        self._refused.clear()
        self._shared = 0

    def _lowest(self, gives_way: Callable[[R], bool]) -> str | None:
        """Returns the newest one of equal ranks; None: there is none."""
        found = [base for base in reversed(self) if not self[base].rank.known and gives_way(self[base])]
        return min(found, key=lambda base: self[base].rank, default=None)
