"""Topics on which a broker accepts no messages: on MQTT 5 the broker says so, on 3.1.1 it can only hang up.

A topic is withheld after three losses in a row, each soon after a message on it. If several topics are withheld, they
are tried one at a time from then on, so that only the topic at fault stays withheld. Pure but for the log.
"""

import logging
from collections.abc import Iterator, Mapping
from math import inf
from typing import NamedTuple

from pebble.transports.base import Message
from pebble.transports.bounds import BoundedTable
from pebble.transports.mqtt.outgoing import TOPICS, WINDOW_S
from pebble.transports.topics import MAX_BYTES, matches

log = logging.getLogger(__name__)

LOSSES = 3  # of connections in a row, after which a topic is withheld
QUIET_S = 2.0  # after a loss, before a topic is tried
RETRY_S = 60.0  # between two trials of a topic that is at fault
LARGE = 1024  # bytes from which the size of a message is the most likely reason: smaller ones are still sent
_NOT_TAKEN_S = 600.0  # between two log lines about one topic


class Withheld(NamedTuple):
    """A topic whose messages of ``size`` bytes and more are not sent; it is tried again from ``tried_at`` on."""

    size: int
    tried_at: float


class Trial(NamedTuple):
    """A withheld topic that is sent again: it is free at ``ends_at``, unless the connection is lost before."""

    topic: str
    ends_at: float


class RefusedTopics:
    """A table of topics that are not sent, because the broker closes the connection for them.

    Topics that match ``vital`` are withheld only for large messages. The transport's lock for publishing guards
    ``withheld`` and the trial.
    """

    def __init__(self, client_id: str, vital: tuple[str, ...]) -> None:
        self._client_id, self._vital = client_id, vital
        self._losses: dict[str, int] = {}  # in a row, by topic
        self.withheld: dict[str, Withheld] = {}  # by topic: what is not sent, as the broker hangs up
        self._again: dict[str, float] = {}  # topics of refused messages: when a retained one is sent again
        self._trial: Trial | None = None
        self._quiet_at = -inf  # a trial begins after this time, which is QUIET_S after the newest loss
        #: Topics that were logged as refused, withheld or not: why, and when that was last in the log.
        self.not_taken = BoundedTable[tuple[str, float]](TOPICS, TOPICS * MAX_BYTES, lambda _: 0)  # only topics count

    def accepts(self, message: Message) -> bool:
        """True if ``message`` may be sent: its topic is not withheld, or is on trial."""
        entry = self.withheld.get(message.topic)
        if entry is None or len(message.payload) < entry.size:
            return True
        return self._trial is not None and self._trial.topic == message.topic

    def admits(self, message: Message, now: float) -> bool:
        """True if ``message`` may be sent. Begins the trial of a withheld topic if that is due."""
        if self._trial is None and not self.accepts(message) and self._is_due(message.topic, now):
            self._trial = Trial(message.topic, now + WINDOW_S)
        return self.accepts(message)

    def _is_due(self, topic: str, now: float) -> bool:
        return now >= max(self.withheld[topic].tried_at, self._quiet_at)

    def due(self, messages: Mapping[str, Message], where: str, now: float) -> Iterator[Message]:
        """End a trial that has succeeded, and yield the retained message of the next topic to try."""
        if self._trial is not None:
            if now < self._trial.ends_at:
                return
            topic, self._trial = self._trial.topic, None
            self.withheld.pop(topic, None)
            if self.not_taken.pop(topic, None) is not None:
                log.info("%s: %s accepts messages on %s again", self._client_id, where, topic)
        for topic in self.withheld:
            if topic in messages and self._is_due(topic, now):
                self._trial = Trial(topic, now + WINDOW_S)
                yield messages[topic]
                return

    def refuse(self, where: str, topic: str, why: str, now: float) -> None:
        """Note that the broker has refused a message, perhaps because of a quota; `refused_due` yields its topic."""
        if len(self._again) < TOPICS:
            self._again.setdefault(topic, now + RETRY_S)
        self.report(where, topic, why, now)

    def refused_due(self, now: float) -> Iterator[str]:
        """Yield the topics, each once, whose message was refused RETRY_S ago."""
        for topic in [topic for topic, at in self._again.items() if now >= at]:
            del self._again[topic]
            yield topic

    def note_loss(self, where: str, written: Mapping[str, int] | None, now: float) -> None:
        """Note a lost connection. ``written``: by topic, the size of a message that may be why; None: no message is."""
        written, trial, self._trial = written or {}, self._trial, None
        self._quiet_at = now + QUIET_S
        ordinary = [topic for topic in written if not self._is_vital(topic)]  # those that may be withheld at any size
        if trial is not None and ordinary == [trial.topic]:  # no other ordinary one was written
            self._blame(where, trial.topic, written[trial.topic], now)
            return
        self._losses = {topic: self._losses.get(topic, 0) + 1 for topic in written}
        often = {topic: written[topic] for topic, losses in self._losses.items() if losses >= LOSSES}
        suspects = {topic: size for topic, size in often.items() if size >= LARGE}
        if not suspects:  # no large message: it may be any topic but the vital ones
            suspects = {topic: size for topic, size in often.items() if not self._is_vital(topic)}
        if len(suspects) == 1:
            self._blame(where, *suspects.popitem(), now)
        elif suspects:  # one of several: each is withheld, a vital one only if LARGE, until its trial
            for topic in suspects:
                if len(self.withheld) < TOPICS:
                    self.withheld[topic] = Withheld(LARGE if self._is_vital(topic) else 0, now)
        elif not ordinary:  # only vital topics with small messages, which are sent all the same
            for topic, size in often.items():
                why = f"{_closes(size)}, without which this account cannot run a robot"
                self.report(where, topic, why, now, logging.ERROR)

    def _blame(self, where: str, topic: str, size: int, now: float) -> None:
        if topic in self.withheld or len(self.withheld) < TOPICS:
            self.withheld[topic] = Withheld(size // 2 if size >= LARGE else 0, now + RETRY_S)
        self.report(where, topic, f"{_closes(size)}, so it is not sent but for a trial each minute", now, logging.ERROR)

    def _is_vital(self, topic: str) -> bool:
        return any(matches(filter_, topic) for filter_ in self._vital)

    def report(self, where: str, topic: str, why: str, now: float, level: int = logging.WARNING) -> None:
        """Log a refused topic, at most once in a while for each topic, because many messages may follow."""
        _, logged_at = self.not_taken.get(topic, ("", -inf))
        if now - logged_at >= _NOT_TAKEN_S:
            self.not_taken[topic] = why, now
            log.log(level, "%s: %s does not take a message on %s: %s", self._client_id, where, topic, why)


def _closes(size: int) -> str:
    return f"it closes the connection when {size} bytes are published there"
