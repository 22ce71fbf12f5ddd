"""A lease that does not take a flood, an outage or a stalled broker for silence of its holder. Pure."""

from pebble.motion.lease import Lease

ENDS_AFTER_MS = 30_000  # so long control lasts without a message of its holder, whatever else happens
_IDLE_MS, _OTHERS_MS = 5000, 2000  # as in Lease


class VouchedLease(Lease):
    """A lease for which a holder is quiet only during the time for which the bridge vouches.

    The bridge vouches for a time after it has passed on all messages of that time to the motor owner.
    """

    vouched: tuple[int, int] | None = None  # None: there is no bridge, and all time counts
    _received_all_since = 0

    def vouch(self, begin: int, end: int, now: int) -> None:
        """Note the time for which the bridge vouches; a time in the future is from another clock and is ignored."""
        if self.vouched is not None and begin <= end <= now:
            self.vouched = max(begin, self._received_all_since), end

    def doubt(self, now: int) -> None:
        """Note that earlier messages may not have been received here, though they were passed on."""
        self._received_all_since = now

    def tick(self, now: int) -> None:
        """End control that is over, as in Lease, which has no method for a part of this, to save memory on boards.

        The quiet time is computed anew in each call, because the vouched time may shrink.
        """
        if self.others and now - self._received >= _OTHERS_MS:
            self.others, self.changed = False, True
        if self.asker and now - self._asked >= self._wait:
            self.asker, self.changed = (), True
        self._held = self.key != "" and self._quiet_ms(self._held_from, now) < _IDLE_MS
        if self.key and (self._quiet_ms(self._since, now) >= self._limit_ms or (self.asker and not self._held)):
            self._end(now)

    def _quiet_ms(self, since: int, now: int) -> int:
        """Return for how long the holder has sent nothing, as far as the bridge vouches."""
        quiet = now - since
        if self.vouched is None or quiet >= ENDS_AFTER_MS:
            return quiet
        begin, end = self.vouched
        return end - max(since, begin)
