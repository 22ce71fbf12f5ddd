"""The time for which the bridge vouches that all messages of the operators' broker were forwarded promptly."""

from collections.abc import Hashable

from pebble.contract import DRIVE
from pebble.contract.payloads import ControlVouched
from pebble.transports import Transport

PERIOD_S = 0.5


class Vouching:
    """The vouched time: from the newest loss or delay to the newest prompt answer of the broker.

    Messages that the broker had before its answer are forwarded before the motor owner gets this time. A motor owner
    that counts silence only within this time does not take late or lost messages for silence.
    """

    def __init__(self, remote: Transport, now: float, noticed_s: float | None = None) -> None:
        """Store the arguments; ``noticed_s``: for a transport without pings, the time after which a loss is noticed."""
        self._remote, self._noticed_s = remote, noticed_s
        self._begin = self._end = now
        self._losses: Hashable = None  # as the last call got them; None: it began anew

    def check(self, passes: bool, losses: Hashable, now: float) -> ControlVouched:
        """Update and return the vouched time; ``losses`` changes when a message may have been lost here.

        ``passes``: the broker's messages reach the motor owners now. Call it every PERIOD_S. A broker is late if its
        answer takes longer than a drive command may wait.
        """
        delivered_s = self._delivered_s()
        if not passes or losses != self._losses or delivered_s is None:
            self._begin = self._end = now
        else:
            self._end = max(self._end, now - delivered_s)
        self._losses = losses if passes else None  # None: the next call begins anew, too
        return ControlVouched(begin=round(1000 * self._begin), end=round(1000 * self._end))

    def _delivered_s(self) -> float | None:
        """Return an age in seconds: every message that is older has been delivered. None if the broker is late."""
        if self._noticed_s is not None:
            return self._noticed_s
        answer = self._remote.answer
        return None if answer is None or answer.late_s > DRIVE.waits_s else answer.delivered_s
