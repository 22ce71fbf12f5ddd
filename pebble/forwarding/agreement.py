"""Who is right about a kept topic that both sides may write (a flag), when the two meet after a while apart.

Pure: it is told what each side said and answers what to do; it neither sends nor looks at a clock. The rules:

1. What changes while we look always counts, whichever side says it.
2. What is found as a kept copy counts only against silence: at a meeting the *winner* side is right, and kept copies
   of the other side fill what the winner does not know. They are held back until the winner has had its say.
3. A side that lost what it knew is told again.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from pebble.forwarding.routing import Side

TOPICS = 4096  # remembered; beyond it the one that was new first is forgotten


class Verdict(Enum):
    PASS = "tell the other side"  # noqa: S105  (no password)
    KNOWN = "nothing new"
    HOLD = "wait for the winner"
    RETELL = "the speaker is wrong: tell it what is right"
    OVERTAKEN = "changed on the other side while this one was away"


@dataclass(frozen=True, slots=True)
class Word:
    """The last that was said about a topic, and by whom."""

    payload: bytes
    side: Side


class Agreement:
    """The state of all two-way kept topics between two sides."""

    def __init__(self, winner: Side) -> None:
        self._winner = winner
        self._last: dict[str, Word] = {}
        self._held: dict[str, bytes] = {}  # kept copies of the loser that wait for the winner
        self._told: dict[Side, dict[str, bytes]] = {side: {} for side in Side}
        self._heard: dict[Side, set[str]] = {side: set() for side in Side}  # since the connection began
        self._settled = dict.fromkeys(Side, False)
        self._overtaken: set[str] = set()  # changed by the loser while the winner was away

    @property
    def settled(self) -> bool:
        """Have the kept copies of both sides come?"""
        return all(self._settled.values())

    def value(self, topic: str) -> bytes | None:
        """What both sides hold to be true, as far as we know."""
        word = self._last.get(topic)
        return None if word is None else word.payload

    def begin(self, side: Side) -> None:
        """The connection of ``side`` was lost, or is new: kept copies are due."""
        self._heard[side].clear()
        self._settled[side] = False

    def heard(self, side: Side, topic: str) -> bool:
        """Has ``side`` said anything about ``topic`` since its connection began?"""
        return topic in self._heard[side]

    def hear(self, side: Side, topic: str, payload: bytes, *, kept: bool, other_away: bool = False) -> Verdict:
        """``side`` says ``payload``; ``kept``: as a copy of something said earlier."""
        if len(self._heard[side]) < TOPICS:
            self._heard[side].add(topic)
        verdict = self._judge_copy(side, topic, payload) if kept else Verdict.PASS
        if verdict is Verdict.HOLD:
            if topic in self._held or len(self._held) < TOPICS:
                self._held[topic] = payload
        elif verdict is Verdict.PASS:
            self._held.pop(topic, None)
            if side is self._winner:
                self._overtaken.discard(topic)
            elif other_away and len(self._overtaken) < TOPICS:
                self._overtaken.add(topic)
            self._note(topic, Word(payload, side))
        return verdict

    def tell(self, side: Side, topic: str, payload: bytes) -> None:
        """``payload`` was published to ``side``."""
        self._told[side][topic] = payload

    def settle(self, side: Side) -> list[tuple[Side, str, bytes]]:
        """Its kept copies have come: returns what is to be published now, and to which side."""
        self._settled[side] = True
        owed: list[tuple[Side, str, bytes]] = []
        if side is self._winner:
            self._overtaken.clear()
            for topic, payload in self._held.items():
                self._note(topic, Word(payload, side.other))
                owed.append((side, topic, payload))
            self._held.clear()
        fresh = {topic for _, topic, _ in owed}
        owed += [
            (side, topic, word.payload)
            for topic, word in self._last.items()
            if topic not in fresh and word.payload and self._ignorant(side, topic, word)
        ]
        return owed

    def _judge_copy(self, side: Side, topic: str, payload: bytes) -> Verdict:
        word = self._last.get(topic)
        if side is self._winner:
            if topic in self._overtaken:
                return Verdict.OVERTAKEN
            return Verdict.KNOWN if word is not None and word.payload == payload else Verdict.PASS
        if word is None:
            return Verdict.PASS if self._settled[self._winner] else Verdict.HOLD
        if word.payload == payload:
            return Verdict.KNOWN
        return Verdict.RETELL if word.side is self._winner else Verdict.PASS

    def _ignorant(self, side: Side, topic: str, word: Word) -> bool:
        return topic not in self._heard[side] and self._told[side].get(topic) != word.payload

    def _note(self, topic: str, word: Word) -> None:
        if topic not in self._last and len(self._last) >= TOPICS:
            oldest = next(iter(self._last))
            del self._last[oldest]
            for told in self._told.values():
                told.pop(oldest, None)
        self._last[topic] = word
