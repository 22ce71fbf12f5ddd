"""Decides which value of a retained topic counts if both sides may publish it (a flag). Pure.

A live message always counts, whichever side publishes it. `resolve` has the rules for the retained messages that a
subscription brings. At a reconnect the *winner* side is right; the *loser* side only adds topics that the winner lacks.
A side that has lost a value, or *went back* (was restored from an earlier save), receives the newest value again.
Silence does not mean that a side has no value: the winner's may still arrive after the loser's was sent to the winner.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from msgspec import Struct

from pebble.forwarding.routing import Side
from pebble.transports.bounds import BoundedTable

TOPICS = 4096  # remembered; beyond it the oldest is dropped,
BYTES = 8 << 20  # as it is beyond this size of topics and values
_EARLIER = 8  # values of a topic that are recognised


class Resolution(Enum):
    PASS = "publish it to the other side"  # noqa: S105  (no password)
    KNOWN = "nothing new"
    HOLD = "wait for the winner"
    RESTORE = "publish it to both sides: what the sender had was overwritten before it came"
    CORRECT = "publish the right value to the sender"
    OVERTAKEN = "changed on the other side while this one was away"


class LastValue(Struct, frozen=True):
    """The newest value of a topic, and the side that published it."""

    payload: bytes
    side: Side
    earlier: tuple[int, ...] = ()  # hashes of the values before it

    def then(self, payload: bytes, side: Side) -> LastValue:
        if payload == self.payload:
            return LastValue(payload, side, self.earlier)
        return LastValue(payload, side, (*self.earlier, hash(self.payload))[-_EARLIER:])


class Facts(NamedTuple):
    """The facts about a topic at the moment when one side sends a retained message on it."""

    last: LastValue | None  # the newest value, whichever side published it
    winner: Side
    went_back: bool = False  # the sender has older values than it had a moment ago
    overtaken: bool = False  # the loser has changed it while the winner was away, or since the winner seemed to lack it
    offered: bool = False  # the winner seemed to lack it, and was sent the loser's value
    awaits_winner: bool = False  # the winner's retained messages have not arrived


def resolve(sender: Side, payload: bytes, facts: Facts) -> Resolution:
    """Return the resolution for a retained message. The first line that fits counts; a live message always passes.

    | sender | known of the topic                                | value          | then                             |
    |--------|---------------------------------------------------|----------------|----------------------------------|
    | winner | the loser has changed it meanwhile                | any            | OVERTAKEN: dropped               |
    | winner | the winner went back                              | an earlier one | CORRECT: sender gets the newest  |
    | winner | any                                               | the newest one | KNOWN: dropped                   |
    | winner | it seemed to have none, and got the loser's       | another one    | RESTORE: published on both sides |
    | winner | any                                               | another one    | PASS: published on the other     |
    | loser  | nothing; the winner's messages have not arrived   | any            | HOLD: waits for these            |
    | loser  | nothing; the winner's messages have arrived       | any            | PASS: published on the other     |
    | loser  | any                                               | the newest one | KNOWN: dropped                   |
    | loser  | the newest one is the winner's                    | another one    | CORRECT: sender gets the newest  |
    | loser  | the loser went back                               | an earlier one | CORRECT: sender gets the newest  |
    | loser  | the newest one is the loser's                     | another one    | PASS: published on the other     |
    """
    last = facts.last
    is_newest = last is not None and last.payload == payload
    is_earlier = facts.went_back and not is_newest and last is not None and hash(payload) in last.earlier
    if sender is facts.winner:
        if facts.overtaken:
            return Resolution.OVERTAKEN
        if is_earlier:
            return Resolution.CORRECT
        if is_newest:
            return Resolution.KNOWN
        return Resolution.RESTORE if facts.offered else Resolution.PASS
    if last is None:
        return Resolution.HOLD if facts.awaits_winner else Resolution.PASS
    if is_newest:
        return Resolution.KNOWN
    return Resolution.CORRECT if last.side is facts.winner or is_earlier else Resolution.PASS


class Reconciliation:
    """The values of all retained topics that both sides may publish."""

    def __init__(self, winner: Side) -> None:
        self._winner = winner
        self._last = BoundedTable[LastValue](TOPICS, BYTES, lambda last: len(last.payload))
        self._held = BoundedTable[bytes](TOPICS, BYTES, len)  # the loser's values, until the winner's have arrived
        self._published = {side: BoundedTable[bytes](TOPICS, BYTES, len) for side in Side}  # forwarded to each
        self._received: dict[Side, set[str]] = {side: set() for side in Side}  # since the connection began
        # Topics on which nothing of the winner has arrived since its connection began:
        self._offered: set[str] = set()  # those that the winner seemed to lack: it was sent the loser's values
        self._newer: set[str] = set()  # changed by the loser after the winner's retained messages counted as received
        self._synchronized = dict.fromkeys(Side, False)  # its retained messages count as received
        self._overtaken: set[str] = set()  # changed by the loser while the winner was away

    def has_synchronized(self, *sides: Side) -> bool:
        """True if the retained messages of ``sides`` have arrived."""
        return all(self._synchronized[side] for side in sides)

    def value(self, topic: str) -> bytes | None:
        """Return the newest value; None if there is none."""
        last = self._last.get(topic)
        return None if last is None else last.payload

    def begin(self, side: Side) -> None:
        """Forget what ``side`` has sent: its connection was lost, and its retained messages will arrive again."""
        self._received[side].clear()
        if side is self._winner:
            self._offered.clear()
            self._newer.clear()
        self._synchronized[side] = False

    def has_received(self, side: Side, topic: str) -> bool:
        """True if ``side`` has published on ``topic`` since its connection began."""
        return topic in self._received[side]

    def receive(
        self,
        side: Side,
        topic: str,
        payload: bytes,
        *,
        retained: bool,
        other_away: bool = False,
        went_back: bool = False,
    ) -> Resolution:
        """Return what to do with a message of ``side``; ``retained``: a subscription brought it, so it may be old.

        ``other_away``: the other side has no connection. ``went_back``: ``side`` has older values than a moment ago.
        """
        if len(self._received[side]) < TOPICS:
            self._received[side].add(topic)
        resolution = Resolution.PASS
        if retained:
            resolution = resolve(side, payload, self._facts(topic, went_back=went_back))
        if resolution is Resolution.HOLD:
            self._held[topic] = payload
        elif resolution in (Resolution.PASS, Resolution.RESTORE):
            self._held.pop(topic, None)
            if side is self._winner:
                self._overtaken.discard(topic)
                self._newer.discard(topic)
                self._offered.discard(topic)
            elif other_away and len(self._overtaken) < TOPICS:
                self._overtaken.add(topic)  # what the winner brings when it returns is older
            elif not retained and self._may_come_late(topic) and len(self._newer) < TOPICS:
                self._newer.add(topic)  # what the winner, which is here, still brings is older
            self._set(topic, payload, side)
        return resolution

    def note_published(self, side: Side, topic: str, payload: bytes) -> None:
        """Note that ``payload`` was forwarded to ``side``."""
        self._published[side][topic] = payload

    def synchronize(self, side: Side) -> list[tuple[Side, str, bytes]]:
        """Note that all retained messages of ``side`` have arrived; return the values to publish, by side and topic."""
        self._synchronized[side] = True
        due: list[tuple[Side, str, bytes]] = []
        if side is self._winner:
            self._overtaken.clear()  # the winner's values have come; for those that come late there is _newer
            for topic, payload in self._held.items():
                self._set(topic, payload, side.other)  # it is the loser's value
                due.append((side, topic, payload))  # to the winner, which has none
            self._held.clear()
        released = {topic for _, topic, _ in due}
        due += [  # and all other newest values that ``side`` lacks
            (side, topic, last.payload)
            for topic, last in self._last.items()
            if topic not in released and self._is_missing(side, topic, last)
        ]
        if side is self._winner:
            self._offered.update(topic for _, topic, _ in due)  # the winner seems to lack all of them
        return due

    def _set(self, topic: str, payload: bytes, side: Side) -> None:
        last = self._last.get(topic)
        self._last[topic] = LastValue(payload, side) if last is None else last.then(payload, side)

    def _facts(self, topic: str, *, went_back: bool) -> Facts:
        return Facts(
            self._last.get(topic),
            winner=self._winner,
            went_back=went_back,
            overtaken=topic in self._overtaken or topic in self._newer,
            offered=topic in self._offered,
            awaits_winner=not self._synchronized[self._winner],
        )

    def _may_come_late(self, topic: str) -> bool:
        """True if an old value of the winner may still arrive, although its retained messages count as received."""
        return self._synchronized[self._winner] and topic not in self._received[self._winner]

    def _is_missing(self, side: Side, topic: str, last: LastValue) -> bool:
        """True if ``side`` lacks the newest value. It lacks a removal only if a value was forwarded to it before."""
        return topic not in self._received[side] and self._published[side].get(topic, b"") != last.payload
