"""Detects messages that circulate: we forward them, and something else brings them back. Pure.

A broker's own bridge, or a second robot with this id, may forward the same topics. If a probe that we publish on one
side comes back on the other, its topic circulates. It is sent on that very topic, because what brings messages back may
carry no other. Its payload is white space that encodes a random number; no parser of commands accepts that. On topics
other than commands the payload is the topic's value with this white space behind it, which does not change the value.
"""

import logging
import secrets
import threading
from collections.abc import Callable, Hashable
from enum import Enum
from typing import Any, Final

from msgspec import Struct

from pebble.contract import OUTGOING, Kind
from pebble.forwarding.routing import Side
from pebble.forwarding.subjects import Subject
from pebble.transports import Message

log = logging.getLogger(__name__)

_DIGITS = b" \t"  # no line ends: tools print a message as a line
_LENGTH = 32  # digits of a probe's number
_PROBES = 256  # remembered: ours, and those of others
_TOPICS = 1024  # that are watched; the oldest is forgotten
_MOST_CLOSED = 256  # topics that circulate
_PAYLOADS = 64  # of one topic, counted at a time
_LONGEST = 16 * 1024  # bytes that a probe repeats

#: A payload that is received more often within this time may circulate, unless an operator holds a key. If any topic
#: circulates, each is suspicious. Sensors repeat themselves for hours: their reports are suspicious in a storm only.
SUSPICIOUS, _WINDOW_S = 5, 2.0
#: No operator and no script repeats a payload so often in this time.
STORM = 150
PROBE_PERIOD_S, _PERIOD_IN_STORM_S = 1.0, 0.1  # between two probes of a topic
UNANSWERED = 3  # probes, after which nothing brings messages back any more
#: A stop is published again after 0.5 s at the earliest; one that comes back is faster.
_STOP_PERIOD_S = 0.25


class Finding(Enum):
    """A finding about a received message: what the forwarder must do with it."""

    PASS = "forward it"  # noqa: S105  (no password)
    SUSPECT = "send a probe, then forward it"
    CIRCULATES = "do not forward it"
    RELAY = "another bridge's probe: forward it as it is"
    PROBE = "one of ours, or forwarded already"


class _Way(Struct):
    """The messages of one topic that are forwarded from one side to the other, counted to find cycles."""

    began: float  # when the present period of counting began, of _WINDOW_S
    counts: dict[int, int] = {}  # of payloads, by their hash, in this period
    probed_at: float = float("-inf")
    unanswered: int = 0  # probes since the last one that came back
    closed: bool = False  # what is forwarded this way comes back

    def count(self, payload: bytes, now: float) -> int:
        """Count a message; return how often its payload came in this period, 0 if there are too many payloads."""
        if now - self.began > _WINDOW_S:
            self.began, self.counts = now, {}
        key = hash(payload)
        if key not in self.counts and len(self.counts) >= _PAYLOADS:
            return 0
        self.counts[key] = count = self.counts.get(key, 0) + 1
        return count


class Cycles:
    """The topics whose messages circulate, and from which side. Two threads may call it at once."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._ways: dict[tuple[Side, str], _Way] = {}  # by the side from which messages come, and their topic
        self._ours: dict[bytes, Side] = {}  # our probes, and the side each was sent to
        self._others: dict[tuple[Side, bytes], bool] = {}  # probes of other bridges that were relayed; an ordered set
        self._stops: dict[tuple[Side, bytes], float] = {}  # when each stop passed last, by side and payload
        #: Messages from this side on this topic come back there if they are forwarded.
        self.closed_ways: Final[set[tuple[Side, str]]] = set()

    def examine(self, side: Side, subject: Subject, message: Message) -> Finding:
        """Return the finding about a message from ``side`` that may be forwarded. Must be fast.

        Counts the message, notes an answered probe. If the topic circulates, a drive command does not pass; others may.
        """
        topic, payload = message.topic, message.payload
        if subject.is_stop:
            return Finding.CIRCULATES if self._repeats_stop(side, topic, payload) else Finding.PASS
        is_one_shot, usual = subject.kind.one_shot, _usual_count(subject)  # usual: so many equal ones start no probe
        number = _number_of(payload) if payload[-1:] in _DIGITS else None
        with self._lock:
            if number is not None:
                return self._receive_probe(side, topic, number)
            way, now = self._ways.get((side, topic)) or self._way(side, topic), self._clock()
            count = way.count(payload, now)
            if way.closed:
                may_pass = subject.runs or not is_one_shot  # `Publisher.is_echo` recognises them when they return
                if not may_pass or count > SUSPICIOUS:
                    return Finding.CIRCULATES
            is_new_storm = count > STORM and not way.closed  # that a closed way circulates is no news
            period = _PERIOD_IN_STORM_S if is_new_storm else PROBE_PERIOD_S
            never_probed = way.probed_at == float("-inf")
            # Where any topic circulates, all others may as well: each is probed once.
            is_suspicious = way.closed or count > usual or (never_probed and bool(self.closed_ways))
            can_be_probed = is_one_shot or len(payload) <= _LONGEST
            # Another bridge may have begun since the last probe: so the first suspicious message is probed at once.
            is_due = now - way.probed_at >= period or count == usual + 1  # usual + 1: the first suspicious one
            return Finding.SUSPECT if is_suspicious and can_be_probed and is_due else Finding.PASS

    def _repeats_stop(self, side: Side, topic: str, payload: bytes) -> bool:
        """True if a stop comes faster than a sender repeats it: it circulates. Counts it; notes when one passes."""
        with self._lock:
            now, key = self._clock(), (side, payload)
            often = self._way(side, topic).count(payload, now) > SUSPICIOUS
            if often and now - self._stops.get(key, float("-inf")) < _STOP_PERIOD_S:
                return True
            _remember(self._stops, key, now)
            return False

    def probe(self, side: Side, topic: str) -> bytes:
        """Make a probe about ``topic`` from ``side``; return its payload, to be published on the other side."""
        number = bytes(_DIGITS[byte % len(_DIGITS)] for byte in secrets.token_bytes(_LENGTH))
        with self._lock:
            way = self._way(side, topic)
            way.probed_at = self._clock()
            way.unanswered += 1
            _remember(self._ours, number, side.other)
        return number

    def poll(self) -> list[tuple[Side, str]]:
        """Allow topics that no longer circulate; return the topics that need another probe. Call this once a second."""
        with self._lock:
            now, due = self._clock(), []
            for side, topic in list(self.closed_ways):
                way = self._ways[side, topic]
                if now - way.probed_at < PROBE_PERIOD_S / 2:  # probed since the last call: an answer may be coming
                    continue
                if way.unanswered >= UNANSWERED:
                    self._open(side, topic)
                else:
                    due.append((side, topic))
            return due

    # -- with the lock held

    def _receive_probe(self, side: Side, topic: str, number: bytes) -> Finding:
        """Return what to do with a probe from ``side``: a probe of another bridge is relayed once, ours ends here.

        If ours was sent to the other side, it has come back by another way: its topic circulates.
        """
        sent_to = self._ours.get(number)
        if sent_to is side.other:
            self._close(side, topic)
        if sent_to is not None or (side, number) in self._others:
            return Finding.PROBE
        _remember(self._others, (side, number), True)
        return Finding.RELAY

    def _close(self, side: Side, topic: str) -> None:
        """Close a way: what is forwarded from ``side`` on ``topic`` comes back there."""
        way = self._way(side, topic)
        way.unanswered = 0
        if way.closed or len(self.closed_ways) >= _MOST_CLOSED:
            return
        way.closed = True
        if self.closed_ways:
            log.info("%s circulates, too, from the %s side", topic, side.value)
        else:
            log.error(
                "%s circulates: something else forwards it from the %s to the %s side. Drive commands that circulate "
                "are not forwarded. Remove it from the other bridge (a broker's `connection`), or the other robot",
                topic,
                side.other.value,
                side.value,
            )
        self.closed_ways.add((side, topic))

    def _open(self, side: Side, topic: str) -> None:
        """Open a way: what is forwarded from ``side`` on ``topic`` comes back no more."""
        self._ways[side, topic].closed = False
        self.closed_ways.discard((side, topic))
        if not self.closed_ways:
            log.info("%s and what else circulated does so no more: everything is forwarded again", topic)

    def _way(self, side: Side, topic: str) -> _Way:
        way = self._ways.get((side, topic))
        if way is None:
            if len(self._ways) >= _TOPICS:
                del self._ways[next(key for key in self._ways if key not in self.closed_ways)]
            way = self._ways[side, topic] = _Way(self._clock())
        return way


def _usual_count(subject: Subject) -> int:
    """Return how many equal messages within 2 s are normal; more of them start a probe.

    The first message of an action is probed already, before the action can run twice. Another command that runs
    something is probed at its first repetition, all others after several, so that other programs seldom see a probe.
    """
    if subject.kind.direction == OUTGOING:
        return STORM
    if subject.kind is Kind.ACTION:
        return 0
    return 1 if subject.runs else SUSPICIOUS


def _number_of(payload: bytes) -> bytes | None:
    """Return the number of a probe, still as white space; None if ``payload`` is no probe."""
    text = payload.rstrip(_DIGITS)
    return payload[-_LENGTH:] if len(payload) - len(text) == _LENGTH else None


def _remember(memory: dict[Any, Any], key: Hashable, value: object) -> None:
    if key not in memory and len(memory) >= _PROBES:
        del memory[next(iter(memory))]
    memory[key] = value
