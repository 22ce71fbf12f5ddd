"""Topics on which a broker takes no messages: it says so, or it hangs up on them."""

import logging
import time
from collections.abc import Iterator, Mapping
from math import inf

from pebble.transports.base import Message
from pebble.transports.bounds import BoundedTable
from pebble.transports.mqtt.connection import Connection
from pebble.transports.mqtt.suspects import TOPICS, Kind, SuspectTopics, Written
from pebble.transports.topics import MAX_BYTES

log = logging.getLogger(__name__)

_TRY_S = 0.25  # between two looks whether a topic that is withheld may be tried
_NOT_TAKEN_S = 600.0  # between two log lines about one topic that the broker does not take


class RefusedTopics:
    """The transport's lock of publishing guards all but `report`."""

    def __init__(self, client_id: str, vital: tuple[str, ...]) -> None:
        self._client_id = client_id
        self.suspects = SuspectTopics(vital)
        self.withheld = self.suspects.withheld
        #: Topics on which the broker takes no messages: why, and when that was last in the log.
        self.not_taken = BoundedTable[tuple[str, float]](TOPICS, TOPICS * MAX_BYTES, lambda _: 0)
        self.arrived_at = -inf  # the newest message
        self._tried_at = 0.0  # when it was last looked whether one of them may be tried

    def note_loss(self, where: str, written: Mapping[str, Written] | None) -> None:
        assessment = self.suspects.lost(written, time.monotonic())
        if assessment is not None:
            level = logging.WARNING if assessment.kind is Kind.SUSPECTED else logging.ERROR
            log.log(level, "%s: %s", self._client_id, assessment.text(where))

    def report(self, where: str, topic: str, why: str, level: int = logging.WARNING) -> None:
        """Log it once for each topic, and again after a while: any number of messages may follow."""
        now = time.monotonic()
        if now - self.not_taken.get(topic, ("", -inf))[1] >= _NOT_TAKEN_S:
            self.not_taken[topic] = why, now
            log.log(level, "%s: %s does not take a message on %s: %s", self._client_id, where, topic, why)

    def to_try(self, connection: Connection, own: Mapping[str, Message]) -> Iterator[Message]:
        """What is to be sent now: the newest of a topic that the broker accepts again, and the next one to try."""
        now = time.monotonic()
        confirmed = self.suspects.confirm(now, connection.has_accepted)
        if confirmed is not None:
            tried, reported = confirmed
            if reported:
                log.info("%s: %s accepts messages on %s again", self._client_id, connection.where, tried.topic)
            if (newest := own.get(tried.topic)) is not None and newest is not tried:
                yield newest
        elif now - self._tried_at < _TRY_S:
            return
        self._tried_at = now
        for topic in self.suspects.due(now, self.arrived_at):
            message = own.get(topic)
            if message is not None and not self.suspects.accepts(message):
                yield message
                return
