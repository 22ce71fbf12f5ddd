"""The time since when received bytes may have waited (T19): in the kernel, which tells no times, or at the broker."""

import socket
from collections import deque
from collections.abc import Callable
from math import inf
from typing import NamedTuple

from pebble.transports import clock
from pebble.transports.mqtt.outgoing import present_round_trip_s

_FAR_S = 1.0  # no round trip of a usable link is longer
_NOTICED_S = 0.1
_BACKLOG_S = 0.2  # after a stall, for what others had sent to the broker meanwhile
_NEAR_S = 0.05  # round trip of a near broker; if one is further away, only PUBACKs show that answers were lost
_LOST = 8  # answers in a row, each right after the newest of several pings, show that earlier ones were lost
_UPLINK_S = 0.5  # TCP's round trips may be so much longer than usual: more may as well be the way to us


class WaitingTime:
    """The earliest time at which the next bytes may have arrived in a socket; all times are of one clock.

    Two facts are known: when the socket was last empty, and how many bytes were in it at one moment after that. The
    counted bytes have arrived after it was empty, all others after the moment of counting.
    """

    def __init__(self, now: float) -> None:
        self.since = now
        self.checked_at = now  # all but the counted bytes have arrived in the socket since then
        self._counted = 0

    def empty(self, now: float) -> None:
        """Note that the socket was empty at ``now``."""
        self.checked_at, self._counted = now, 0

    def found(self, size: int, now: float) -> None:
        """Note that ``size`` bytes are in the socket at ``now``."""
        if self._counted <= 0:
            self.since, self.checked_at, self._counted = self.checked_at, now, size

    def read(self, size: int) -> None:
        """Note that ``size`` bytes were taken out of the socket."""
        self._counted -= size


class _Ping(NamedTuple):
    """An unanswered ping."""

    since: float  # messages before its answer may have waited since then
    sent_at: float
    clear: bool  # no other data of ours was before it, so that the time of its answer tells something


class BrokerDelay:
    """A measure of how long messages that arrive now have waited at the broker. The broker answers a ping after them.

    A ping that itself took long to get there, behind our own data, tells nothing. The usual time of an answer is no
    delay: it is that of the shortest answer of this connection, or TCP's own round trip.

    A broker that has stood still reads a packet of each client in turn: it may have answered all our pings before it
    has read the last old message of another client. So if nothing at all has come since an overdue ping was sent, the
    messages of the next moment count as having waited as long as the ping.

    Answers carry no number, and mosquitto drops some where a client's queue is full: each later answer then counts for
    an earlier ping. A PUBACK shows that, and so do several answers in a row that come right after the newest ping.
    """

    def __init__(self) -> None:
        self._pings: deque[_Ping] = deque()  # oldest first
        self._read_answer = self._delivered_answer = 0.0, 0.0  # when its ping was sent, and how long it took
        self._shortest = _FAR_S
        self._newest = 0.0  # seconds that the newest answer took; 0: that tells nothing
        self._came_at = 0.0  # when something was received last
        self._stall = 0.0  # seconds for which the broker stood still; messages count as having waited so long
        self._until = 0.0  # until this time they count so
        self._prompt = 0  # answers in a row that came right after the newest of several pings

    def usual(self, seconds: float) -> None:
        """Note the time of an answer that did not wait anywhere, such as TCP's."""
        self._shortest = min(self._shortest, seconds)

    def asked(self, now: float, *, clear: bool) -> None:
        """Note that a ping was sent; ``clear``: no other data of ours was on its way."""
        self._pings.append(_Ping(now, now, clear))

    def stalled(self, since: float, now: float) -> None:
        """Note a ping after a pause in our own reading, from ``since`` on: messages may have waited at the broker."""
        self._pings.append(_Ping(since, now, clear=True))

    def answered(self, now: float) -> None:
        """Note that the oldest ping was answered."""
        if self._pings:
            ping = self._pings.popleft()
            took_s = now - ping.sent_at
            self._read_answer = ping.sent_at, took_s
            self._newest = took_s if ping.clear else 0.0  # else our own data held up the ping
            self.usual(took_s)  # if it is the shortest
        is_near = self._shortest <= _NEAR_S  # far away, an answer soon after the newest ping may be an older ping's
        if is_near and self._pings and now - self._pings[-1].sent_at <= self._shortest + _NEAR_S:
            self._prompt += 1
        else:
            self._prompt = 0
        if self._prompt >= _LOST:  # each was for the newest ping: earlier answers are lost, none is to come
            self._pings.clear()
            self._newest = 0.0

    def acknowledged(self, sent_at: float, now: float) -> None:
        """Note a PUBACK for a message sent at ``sent_at``: earlier pings were answered, or their answers are lost."""
        while self._pings and self._pings[0].sent_at < sent_at:
            self._pings.popleft()
        self._newest = min(self._newest, now - sent_at)

    def delivered(self) -> None:
        """Note that all messages that were read have been delivered."""
        self._delivered_answer = self._read_answer

    def delivery(self, now: float) -> tuple[float, float]:
        """Return the age of the newest ping answered before :meth:`delivered` was called, and how late answers are."""
        sent_at, took = self._delivered_answer
        waits = now - self._pings[0].sent_at if self._pings else 0.0
        return now - sent_at, max(took, waits) - self._shortest

    def seconds(self, now: float, round_trip_s: Callable[[], float]) -> float:
        """Return how long messages received at ``now`` have waited; ``round_trip_s`` asks for TCP's present round trip.

        | case                                      | it has waited                                              |
        |-------------------------------------------|------------------------------------------------------------|
        | the newest ping was answered late         | as long as the answer took                                 |
        | a ping is unanswered                      | since it was sent, or since the pause in reading before it |
        | the broker stood still until a moment ago | as long as it stood still                                  |
        | none of these is longer than usual        | not at all                                                 |

        The longest counts, less the time of the way itself.
        """
        since = sent_at = now  # if no ping is unanswered
        for ping in self._pings:
            if ping.clear:  # the oldest one that no other data of ours held up
                since, sent_at = ping.since, ping.sent_at
                break
        if self._came_at <= sent_at and now - sent_at > self._shortest + _NOTICED_S:  # nothing came since the ping
            self._stall, self._until = now - sent_at, now + _BACKLOG_S
        self._came_at = now
        waited = max(self._newest, now - since, self._stall if now < self._until else 0.0)  # the cases, in their order
        if waited <= self._shortest + _NOTICED_S:
            return 0.0
        # TCP's present round trip, but no less than the usual one, and at most _UPLINK_S more than that.
        way_s = max(self._shortest, min(round_trip_s(), self._shortest + _UPLINK_S))
        return waited - way_s


class ReadAge:
    """The time since when the batch that is being read may have waited, in the socket or at the broker."""

    def __init__(self, now: float) -> None:
        self.waiting, self.delay = WaitingTime(now), BrokerDelay()
        self.since = now  # that time
        self.received_at = now  # a time before bytes were taken out of the socket
        #: The last sign that answers are behind retained messages, or behind a long one.
        self.arriving_at = -inf
        self.has_retained = False  # there are retained messages in the batch

    def update(self, now: float, sock: socket.socket | None) -> None:
        """Set `since` for the bytes that are read next, at ``now``."""
        self.since = self.waiting.since
        waited = self.delay.seconds(now, lambda: 0.0 if sock is None else present_round_trip_s(sock))
        if waited > 0:
            self.since = min(self.since, now - waited)

    def note_arriving(self) -> None:
        self.arriving_at = clock.since_boot()

    def note_handled(self) -> None:
        """Note that retained messages were handled: while this was done, the broker does not count as silent."""
        self.note_arriving()
        self.has_retained = False
