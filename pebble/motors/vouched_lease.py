"""A lease whose holder is not taken for silent because of a flood, an outage or a stalled broker. Pure."""

from pebble.motion.lease import Lease

ENDS_AFTER_MS = 30_000  # so long control lasts without a message of its holder, whatever else happens
_IDLE_MS, _OTHERS_MS = 5000, 2000  # as in Lease


class VouchedLease(Lease):
    """A lease that does not take its holder for silent because messages were held up.

    Silence counts only in periods for which the bridge vouches, because it has passed on every message that came in
    them. After ``ENDS_AFTER_MS`` it counts in any case.
    """

    vouched: tuple[int, int] | None = None  # begin and end; None: there is no bridge, and all time counts
    _received_all_since = 0  # before it messages may have been lost in this process

    def vouch(self, begin: int, end: int, now: int) -> None:
        """Note the period for which the bridge vouches. Ignore one from the future: it is of another clock."""
        if self.vouched is not None and begin <= end <= now:
            self.vouched = max(begin, self._received_all_since), end

    def doubt(self, now: int) -> None:
        """Note that messages which the bridge has forwarded until now may be lost in this process."""
        self._received_all_since = now

    def tick(self, now: int) -> None:
        """End control whose time is over. This repeats Lease.tick, which is kept in one piece to save memory on boards.

        The silent time is computed in each call, because the vouched time may shrink.
        """
        if self.others and now - self._received >= _OTHERS_MS:
            self.others, self.changed = False, True
        if self.asker and now - self._asked >= self._wait:
            self.asker, self.changed = (), True
        self._held = self.key != "" and self._quiet_ms(self._held_from, now) < _IDLE_MS
        # Not renewed for too long, or another client asks and the holder is idle:
        if self.key and (self._quiet_ms(self._since, now) >= self._limit_ms or (self.asker and not self._held)):
            self._end(now)

    def _quiet_ms(self, since: int, now: int) -> int:
        """Return for how long the holder has been silent, counting only vouched time."""
        quiet = now - since
        if self.vouched is None or quiet >= ENDS_AFTER_MS:
            return quiet
        begin, end = self.vouched
        return end - max(since, begin)
