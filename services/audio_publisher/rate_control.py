"""Reduces sound on a slow connection: first the headers, by more parts in a packet, then the bitrate. Pure."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from pebble.extensions.media.in_flight import InFlight
from pebble.extensions.media.opus import BUNDLE_LIMIT
from pebble.extensions.media.rests import Rests
from pebble.transports.base import Outgoing

LEAST_BITRATE: Final = 16_000  # of Opus: below it speech gets hard to follow
#: Age of the oldest packet in flight, beyond a round trip, above which the newest are dropped. On a slow connection
#: Opus gets smaller; what it waits for are packets that were lost and are sent again. Measured by `pebble bench impair`
#: at 64 kbit/s and 5 % loss, windows of 12 s: with 0.2 s it lost 3 to 8 % of the sound, with 0.5 s 0 to 1.5 %.
WAITING_LIMIT_S: Final = 0.2
OPUS_WAITING_LIMIT_S: Final = 0.5
_SLOW_S = 0.12  # packets wait for longer than this: the connection cannot carry what is sent
_FAST_S = 0.08  # an acknowledgement may be delayed by 40 ms and is noticed only 20 ms later: less says nothing
_EMPTY_S = 0.03  # nothing waits
_BEACON_S = 0.15  # so often at least where an access point delays acknowledgements until its beacon (every 102.4 ms)
_PATIENCE_S = 0.3  # of slowness, before something is done
_PAUSE_S = 0.4  # before more is done: what waits already takes longer to leave, and commands wait behind it
_FIRST_CALM_S = 1.0  # of fastness, before a step up is tried while the connection has never been slow
_CALM_S = 10.0  # the same once it was; twice that after each try that failed
_CALMEST_S = 300.0
_GAP_S = 2.0  # without a poll, for want of a connection or of Opus: older measurements say nothing
_OVERHEAD = 60  # bytes of a topic, headers and pings that a packet may add to what is in flight
_LIMIT = 256  # packets in flight that are remembered; far more than may wait


@dataclass(frozen=True, slots=True)
class Step:
    """A way to encode Opus. ``reduced`` describes it for display."""

    bundle: int
    bitrate: int
    reduced: str = ""


def steps(bundle: int, bitrate: int) -> tuple[Step, ...]:
    """Return the steps of quality, from the configured one down to the lowest useful one.

    A step that would save nothing is left out.
    """
    steps = [Step(bundle, bitrate)]
    if bundle < BUNDLE_LIMIT:
        steps.append(Step(BUNDLE_LIMIT, bitrate, f"{BUNDLE_LIMIT} parts a packet"))
    if bitrate > LEAST_BITRATE:
        reduced = f"{BUNDLE_LIMIT} parts a packet, {LEAST_BITRATE // 1000} kbit/s"
        steps.append(Step(BUNDLE_LIMIT, LEAST_BITRATE, reduced))
    return tuple(steps)


class RateController:
    """A controller of the packets that are sent, and of their Opus encoding (``step``).

    ``outgoing()`` returns the unacknowledged messages. ``thin``: the link may be thin; a pause follows a slow packet.
    """

    def __init__(
        self, bundle: int, bitrate: int, now: float, outgoing: Callable[[], Outgoing], *, thin: bool = False
    ) -> None:
        self._steps, self._outgoing = steps(bundle, bitrate), outgoing
        self._levels = LevelControl(len(self._steps) - 1, now)
        self._in_flight = InFlight(_OVERHEAD, _LIMIT)
        self._rests, self._is_resting = Rests(thin), False  # pauses after slow packets; one lasts, by the last poll
        self._age_s = 0.0  # of the oldest packet in flight, beyond a round trip

    @property
    def step(self) -> Step:
        return self._steps[self._levels.level]

    def poll(self, now: float, encoding: str) -> None:
        """Measure how long packets wait, and choose another step if that is better. Only Opus has steps."""
        outgoing = self._outgoing()
        for packet in self._in_flight.acknowledge(outgoing.waiting):
            self._rests.note(now - packet.at - outgoing.round_trip_s, now)
        self._is_resting = self._rests.lasts(now)
        self._age_s = max(0.0, self._in_flight.age_s(now) - outgoing.round_trip_s)
        if encoding == "opus":
            self._levels.poll(self._age_s, now)

    def may_send(self, encoding: str) -> bool:
        """True if another packet would arrive in time, by the last poll."""
        return not self._is_resting and self._age_s <= (OPUS_WAITING_LIMIT_S if encoding == "opus" else WAITING_LIMIT_S)

    def sent(self, size: int, now: float) -> None:
        """Note that the connection has accepted a packet of ``size`` bytes."""
        self._in_flight.sent(size + _OVERHEAD, now)

    def connection_lost(self) -> None:
        self._in_flight.clear()


class LevelControl:
    """The choice of a step. It begins with the last step, because the connection is not known yet.

    Quality falls while packets wait, and rises once none has waited for a time, which grows with each rise that failed.
    """

    def __init__(self, last: int, now: float) -> None:
        self.level = self._last = last  # which step; 0 is as configured
        self._slow_since: float | None = None  # since when packets wait too long (_SLOW_S)
        self._fast_since: float | None = None  # since when they wait briefly (_FAST_S)
        self._polled_at = float("-inf")
        self._empty_at = float("-inf")  # when a poll last found that nothing waits (_EMPTY_S)
        self._changed_at = now
        self._raised_at = float("-inf")  # when the quality last rose
        self._calm_s = _FIRST_CALM_S  # how long it has to be fast before a step up

    def poll(self, age_s: float, now: float) -> None:
        """Note that the oldest packet has waited for ``age_s``, and change the level if that is better."""
        if now - self._polled_at > _GAP_S:  # what was measured before says nothing about now
            self._slow_since = self._fast_since = None
        self._polled_at = now
        self._slow_since = _since(self._slow_since, age_s > _SLOW_S, now)
        if age_s < _EMPTY_S:
            self._empty_at = now
        is_fast = age_s < _FAST_S or now - self._empty_at < _BEACON_S  # a Wi-Fi beacon may delay answers
        self._fast_since = _since(self._fast_since, is_fast, now)
        if now - self._changed_at < _PAUSE_S:
            return
        if self._slow_since is not None and now - self._slow_since >= _PATIENCE_S and self.level < self._last:
            # From the first fall on, calm has to last for _CALM_S at least, and twice as long as before if this fall
            # comes soon after the last rise: then that rise has failed.
            last_rise_failed = now - self._raised_at < 2 * self._calm_s
            longer_s = 2 * self._calm_s if last_rise_failed else self._calm_s
            self._calm_s = min(max(_CALM_S, longer_s), _CALMEST_S)
            self.level, self._changed_at = self.level + 1, now
        elif self.level and self._fast_since is not None:
            calm_since = max(self._fast_since, self._changed_at)  # earlier it was at another step
            if now - calm_since > self._calm_s:
                self.level, self._changed_at, self._raised_at = self.level - 1, now, now


def _since(before: float | None, holds: bool, now: float) -> float | None:
    """Return since when a condition holds; None if it does not. ``before``: the result of the last call."""
    if not holds:
        return None
    return now if before is None else before
