"""Over which time the bridge vouches that all that the operators' broker had for the robot was passed on in time."""

from collections.abc import Hashable

from pebble.contract import DRIVE
from pebble.contract.payloads import ControlVouched
from pebble.transports import Transport

PERIOD_S = 0.5


class Vouching:
    """The time that ends with the newest prompt answer of the broker, and begins after the newest loss or delay.

    What the broker had before it answered has been passed on before that is said here. So a motor owner that counts
    only this time as silence takes nothing for it that was late or lost on the way.
    """

    def __init__(self, remote: Transport, now: float, noticed_s: float | None = None) -> None:
        """``noticed_s``: for a transport that asks for no answers: so late a lost connection is noticed."""
        self._remote, self._noticed_s = remote, noticed_s
        self._begin = self._end = now
        self._losses: Hashable = None

    def check(self, passes: bool, losses: Hashable, now: float) -> ControlVouched:
        """Return what holds now; every PERIOD_S. ``losses`` changes whenever a message may have been lost here.

        A broker that would be asked to wait for longer than a drive command may is late.
        """
        delivered_s = self._delivered_s()
        if not passes or losses != self._losses or delivered_s is None:
            self._begin = self._end = now
        else:
            self._end = max(self._end, now - delivered_s)
        self._losses = losses if passes else None
        return ControlVouched(begin=round(1000 * self._begin), end=round(1000 * self._end))

    def _delivered_s(self) -> float | None:
        """Return how long ago all was sent that is delivered; None: it is late."""
        if self._noticed_s is not None:
            return self._noticed_s
        answer = self._remote.answer
        return None if answer is None or answer.late_s > DRIVE.waits_s else answer.delivered_s
