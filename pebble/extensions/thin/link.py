"""The capacity of the way to the remote broker: its measured level, and how many bytes may be on their way. Pure.

Losses alone do not lower the level: a lost packet that is sent again delays an answer, but not TCP's own round trips.
"""

from collections import deque
from math import inf

from msgspec import Struct

from pebble.contract.payloads import LinkLevel
from pebble.extensions.media.in_flight import InFlight
from pebble.extensions.thin.sieve import Rank
from pebble.transports import Answer

_ORDER: tuple[LinkLevel, ...] = ("wide", "narrow", "thin")
_LITTLE_KBIT = 32.0  # less does not carry the commands and heartbeats of a robot on a wide link
_UNANSWERED_S = 0.5  # how often a question without an answer counts
_REST_S = 0.05  # a shorter queue is none
_STANDING_S, _STANDS_S = 0.3, 1.5  # a queue that is longer for so long does not drain by itself: as much comes as goes
_DRAINED_S, _DRAINED_FOR_S = 0.1, 5.0  # one that is shorter for so long has drained
_REMEMBERED_S, _PART_S = 600.0, 60.0  # how long a short round trip counts, and how exactly
_LONGEST_WAIT_S = 600.0
_PROVED_S = 60.0  # a level that lasts for so long was reached rightly
_SOON_S = 0.15  # what is sent may wait for so long
_FIRST_BYTES, _LEAST_BYTES, _MOST_BYTES = 1500, 300, 64 * 1024  # that may be on their way, while that is learned
_MOST = 256  # messages that are remembered
_SLACK_BYTES = 64  # of pings and headers
_CARRIED = 0.75  # of what a link carries; the rest are headers of small packets
_POLL_S = 0.1  # so late an acknowledgement is noticed
_RUN_S = 1.0  # late commands that are further apart are no run


class _Rule(Struct, frozen=True):
    """A rule for leaving a level, by the time for which answers to pings waited in a queue."""

    worse_s: float  # if two of three waited longer, the level falls
    rise_s: float  # if there was no queue for so long, it rises


_RULES: dict[LinkLevel, _Rule] = {
    "wide": _Rule(0.15, inf),
    "narrow": _Rule(0.3, 20.0),
    "thin": _Rule(inf, 60.0),
}


class ShortestTrip:
    """The shortest round trip of the last ten minutes. In a shorter time a lasting queue would become the norm."""

    def __init__(self) -> None:
        self._parts: deque[tuple[float, float]] = deque()  # when each began, and the shortest in it

    def note(self, seconds: float, now: float) -> None:
        """Note a round trip. A part is forgotten once its last round trip, too, is older than _REMEMBERED_S."""
        began, shortest = self._parts[-1] if self._parts else (-inf, inf)
        if now - began >= _PART_S:
            self._parts.append((now, seconds))
        else:
            self._parts[-1] = began, min(shortest, seconds)
        while now - self._parts[0][0] >= _REMEMBERED_S + _PART_S:
            self._parts.popleft()

    @property
    def seconds(self) -> float:
        return min((shortest for _, shortest in self._parts), default=0.0)


class Crowd:
    """A detector of a standing queue. Operators and streams then send less until it has drained."""

    def __init__(self) -> None:
        self.stands = False
        self._contrary_since: float | None = None  # when measurements began to contradict ``stands``

    def note(self, queue_s: float, now: float) -> None:
        """Note how much longer answers take than the fastest; after some time of contradiction, change ``stands``."""
        contradicts = queue_s < _DRAINED_S if self.stands else queue_s > _STANDING_S
        if not contradicts:
            self._contrary_since = None
        elif self._contrary_since is None:
            self._contrary_since = now
        elif now - self._contrary_since >= (_DRAINED_FOR_S if self.stands else _STANDS_S):
            self.stands, self._contrary_since = not self.stands, None


class LinkMeter:
    """A meter of the level of a link (thin to wide), by the answers to pings.

    At `auto` the level depends on the queue: how much longer answers take than the fastest one. The level falls early
    and rises late: after each rise that fails, the time without a queue before the next rise doubles, up to ten
    minutes. ``kbit``: the rate of the link in the config, if any; at `auto` a small one makes the level thin for good.
    """

    def __init__(self, profile: str, kbit: float | None = None) -> None:
        thin = profile == "thin" or (profile == "auto" and kbit is not None and kbit < _LITTLE_KBIT)
        self.level: LinkLevel = "thin" if thin else "wide"
        self.queue_s = 0.0
        self._fixed = thin or profile != "auto"  # the level never changes
        self._answer_number, self._answered_at = 0, -inf  # of the newest answer, and when an answer last counted
        self._shortest = ShortestTrip()
        self._newest: deque[float] = deque(maxlen=3)  # queues that were measured at this level
        self._rise_s = {level: rule.rise_s for level, rule in _RULES.items()}  # time without a queue before a rise
        self._rests_since: float | None = None  # since when there is no queue
        self._risen_at = -inf
        self._crowd = Crowd()  # tells whether a queue stands now

    @property
    def crowded(self) -> bool:
        """True if more is on its way than drains, in either direction."""
        return self._crowd.stands

    @property
    def round_trip_s(self) -> float:
        return self._shortest.seconds

    def follow(self, answer: Answer | None, now: float) -> None:
        """Update the level by the newest answer, which counts once; one that is overdue counts every half second.

        ``answer`` None: there is no connection.
        """
        if answer is None:
            self.lost()
            return
        is_new = answer.number != self._answer_number
        is_overdue = answer.seconds > _UNANSWERED_S and now - self._answered_at >= _UNANSWERED_S
        if is_new or is_overdue:
            self._answer_number, self._answered_at = answer.number, now
            self.answered(answer.seconds, now, answer.queue_s)

    def answered(self, seconds: float, now: float, tcp_queue_s: float | None = None) -> None:
        """Note how long an answer took. ``tcp_queue_s``: the excess of TCP's own round trips over the shortest one."""
        self._shortest.note(seconds, now)
        queue_s = seconds - self._shortest.seconds
        self.queue_s = queue_s if tcp_queue_s is None else min(queue_s, tcp_queue_s)
        self._crowd.note(self.queue_s, now)
        if not self._fixed:
            self._newest.append(self.queue_s)
            self._decide(now)

    def lost(self) -> None:
        """Note that the connection is lost; the next measurements belong to another connection."""
        self._answer_number = 0
        self._crowd = Crowd()
        self._forget()

    def _forget(self) -> None:
        """Forget the measurements of this level."""
        self._newest.clear()
        self._rests_since = None

    def _decide(self, now: float) -> None:
        """Change the level, if the newest measurements call for it."""
        level = self.level
        if sum(queue_s > _RULES[level].worse_s for queue_s in self._newest) >= 2:
            self._fall(now)
            return
        if self.queue_s >= _REST_S:
            self._rests_since = None
        elif self._rests_since is None:
            self._rests_since = now
        elif now - self._rests_since >= self._rise_s[level]:
            self._change(_ORDER[_ORDER.index(level) - 1])  # the next better one; at "wide" rise_s is infinite
            self._risen_at = now

    def _fall(self, now: float) -> None:
        lower = _ORDER[_ORDER.index(self.level) + 1]
        rise_failed = now - self._risen_at < max(_PROVED_S, self._rise_s[lower])
        self._rise_s[lower] = min(2 * self._rise_s[lower], _LONGEST_WAIT_S) if rise_failed else _RULES[lower].rise_s
        self._change(lower)

    def _change(self, level: LinkLevel) -> None:
        self.level = level
        self._forget()


class Room:
    """The number of bytes that may be on their way to the remote broker, so that nothing waits there for long.

    If the link's capacity is known, they drain within 150 ms beyond a round trip. Otherwise the number is learned: it
    grows a little with each message that is confirmed without delay, and shrinks much with each that is not.
    """

    def __init__(self, kbit: float | None = None) -> None:
        self._rate = None if kbit is None else _CARRIED * kbit * 125  # bytes/s
        self._bytes = float(_FIRST_BYTES if self._rate is None else _LEAST_BYTES)  # that may be on their way
        self._in_flight = InFlight(_SLACK_BYTES, _MOST)
        self._waiting = 0  # bytes that are not confirmed
        self._was_full = False  # since the last poll a message found no room

    def poll(self, waiting: int, round_trip_s: float, now: float) -> None:
        """Note how many bytes are not confirmed. ``round_trip_s``: the shortest one; what takes longer has waited."""
        self._waiting = waiting
        confirmed = self._in_flight.acknowledge(waiting)
        if self._rate is not None:
            self._bytes = max(_LEAST_BYTES, self._rate * (round_trip_s + _SOON_S))
        elif any(now - sent.at - round_trip_s > _SOON_S + _POLL_S for sent in confirmed):  # one was delayed
            self._bytes = max(_LEAST_BYTES, 0.7 * self._bytes)
        elif self._was_full:  # otherwise there was no need for more
            self._bytes = min(_MOST_BYTES, self._bytes + sum(sent.size for sent in confirmed))
        self._was_full = False

    def takes(self, rank: Rank, size: int, now: float) -> bool:
        """Return True if ``size`` bytes of this rank may be sent now, and note them; with 0 it only asks.

        One message may always be on its way; if it is larger than the room, it fills it. Higher ranks may use several
        times the room, so they need not wait for such a message of a lower rank.
        """
        fits = not self._waiting or self._waiting + min(size, self._bytes) <= self._bytes * rank
        self._was_full = self._was_full or not fits
        if fits and size:
            self._in_flight.sent(size, now)
            self._waiting += size
        return fits


class LateRun:
    """A count of late commands in a row, from senders that do not adapt to the link.

    A command in time, or a pause, restarts the count.
    """

    def __init__(self) -> None:
        self.count = 0
        self._since = self._newest_at = 0.0  # when the first and the newest command of the run came

    def note(self, late: bool, now: float) -> None:
        """Count a ``late`` command whose sender does not tell its age; a command in time restarts the count."""
        if not late:
            self.count = 0
            return
        if not self.count or now - self._newest_at > _RUN_S:
            self.count, self._since = 0, now
        self.count, self._newest_at = self.count + 1, now

    def seconds(self, now: float) -> float:
        """Return for how long all commands have been late; 0 if the last one was in time."""
        return now - self._since if self.count else 0.0
