"""A lease that does not take a flood, an outage or a stalled broker for the silence of who has control. Pure."""

from pebble.motion.lease import Lease

MOST_QUIET_MS = 30_000  # so long control lasts without a message of its holder, whatever else happens


class VouchedLease(Lease):
    """A lease for which a holder is quiet only during the time for which the bridge vouches.

    All messages between its begin and its end have been passed on to the motor owner before the bridge says so.
    """

    vouched: tuple[int, int] | None = None  # None: there is no bridge, and all time counts
    _received_all_since = 0

    def vouch(self, begin: int, end: int, now: int) -> None:
        """Let this time count; one to come is of another clock."""
        if self.vouched is not None and begin <= end <= now:
            self.vouched = max(begin, self._received_all_since), end

    def doubt(self, now: int) -> None:
        """Messages of before may not have been received here, though they were passed on."""
        self._received_all_since = now

    def quiet_ms(self, since: int, now: int) -> int:
        quiet = now - since
        if self.vouched is None or quiet >= MOST_QUIET_MS:
            return quiet
        begin, end = self.vouched
        return end - max(since, begin)

    def tick(self, now: int) -> None:
        self._held = self.key != ""  # computed anew: what counted as quiet may count no more
        super().tick(now)
