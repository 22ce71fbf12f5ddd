"""The frames in flight: how many are permitted, and how long each kept the connection busy. Pure."""

from dataclasses import dataclass

from pebble.extensions.media.in_flight import InFlight, Sent

#: The other side's TCP may delay an acknowledgement by 40 ms: this much says nothing about the connection.
SLACK_S = 0.05
#: An access point delays it until its next beacon, every 102.4 ms as a rule, while the radio here saves power. Then
#: this much says nothing either; but only then, because on a slow connection commands wait behind such pictures.
BEACON_SLACK_S = 0.12
_BEACON_S = 3.0  # for how long an observed beacon delay is assumed to go on
_PROBE_S = 2.0  # between two frames that are sent to observe it
_PROMPT_S = 0.1  # beyond a round trip: a frame that took no longer did not wait behind another
_MOST = 32  # frames in flight at once; 30 per second need no more over a round trip of a second
_SLACK_BYTES = 64  # of pings and headers


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """A frame that the other side has acknowledged."""

    sent_at: float
    took_s: float  # how long it kept the connection busy; short times are given the benefit of the doubt


class SendWindow:
    """The frames in flight on one connection, and how many are permitted.

    Over a long round trip several frames travel at once: at first one, then one more for each that arrived promptly,
    because the capacity of the path shows only after a round trip.

    If an access point delays acknowledgements until its next beacon, they come together: a late frame is acknowledged
    at once with younger frames, for which a slow connection would have needed longer. This shows only while a younger
    frame is in flight. So if the only frame is late, another is let through now and then.
    """

    def __init__(self) -> None:
        self._frames = InFlight(_SLACK_BYTES)
        self._limit = 1  # frames that may be in flight
        self._free_at = 0.0  # when the newest acknowledgement came: no earlier frame kept the connection busy any more
        self._round_trip_s, self._polled_at = 0.0, float("-inf")  # at the last poll
        self._beacon_until = float("-inf")  # until then an access point is assumed to delay acknowledgements
        self._probed_at = float("-inf")  # when a frame was last let through beside a late one, to observe that

    def __len__(self) -> int:
        return len(self._frames)

    def clear(self) -> None:
        """Forget all frames in flight, because the connection is lost."""
        self._frames.clear()
        self._limit = 1

    def sent(self, size: int, now: float) -> None:
        oldest = self._frames.oldest
        if oldest is not None and len(self._frames) == 1 and now - oldest.at - self._round_trip_s > SLACK_S:
            self._probed_at = now
        self._frames.sent(size, now)

    def poll(self, waiting: int, round_trip_s: float, now: float) -> list[Acknowledged]:
        """Return the frames acknowledged since the last poll, and adapt how many may be in flight.

        ``waiting`` bytes are still unacknowledged.
        """
        since_s = now - self._polled_at
        self._round_trip_s, self._polled_at = round_trip_s, now
        frames, slack_s = self._frames.acknowledge(waiting), self._slack_s(now)
        acknowledged = []
        for frame in frames:
            began = max(frame.at + round_trip_s, self._free_at)  # until then it travelled, or waited behind another
            self._free_at = now  # so the others that are acknowledged with it took no time
            is_prompt = now - frame.at - round_trip_s <= _PROMPT_S
            self._limit = max(1, min(_MOST, self._limit + (1 if is_prompt else -1)))
            took_s = max(0.0, now - began)
            acknowledged.append(Acknowledged(frame.at, _credible(took_s, slack_s)))
        if len(frames) > 1:
            self._note_beacon(frames, since_s, now)
        return acknowledged

    def _note_beacon(self, frames: list[Sent], since_s: float, now: float) -> None:
        """Note that an access point delays acknowledgements, if those of ``frames`` came together and late."""
        sizes = [frame.size for frame in frames]
        needed_s = since_s * sizes[0] / sum(sizes[1:])  # by the first frame, at the pace of those that came with it
        if now - frames[0].at - self._round_trip_s > max(SLACK_S, 2 * needed_s):
            self._beacon_until = now + _BEACON_S

    def full(self, round_trip_s: float, now: float) -> bool:
        """True if another frame would have to wait for those in flight."""
        if len(self._frames) >= self._limit:
            return True
        late_s = self.age_s(round_trip_s, now)
        probe = len(self._frames) == 1 and late_s <= BEACON_SLACK_S - SLACK_S and now - self._probed_at >= _PROBE_S
        return late_s > 0 and not probe

    def age_s(self, round_trip_s: float, now: float) -> float:
        """Return how much longer than a round trip the oldest frame has been in flight; 0 if there is none."""
        if not len(self._frames):
            return 0.0
        return max(0.0, self._frames.age_s(now) - round_trip_s - self._slack_s(now))

    def _slack_s(self, now: float) -> float:
        """Return the delay up to which an acknowledgement says nothing about the connection."""
        return BEACON_SLACK_S if now < self._beacon_until else SLACK_S


def _credible(took_s: float, slack_s: float) -> float:
    """Return the part of ``took_s`` that the connection certainly caused.

    It is 0 below ``slack_s``, and all of it from twice ``slack_s`` on.
    """
    return took_s * min(1.0, max(0.0, took_s / slack_s - 1.0))
