"""Pauses between pictures or sound on a thin link. Pure: times are passed in."""

from typing import Final

SLOW_S: Final = 0.25  # longer than a mere round trip: so much waits in the modem, in front of commands
_TIMES: Final = 10  # as long as that: what is sent takes less than a tenth of the link
_LONGEST_S: Final = 30.0  # the link may be a better one by then


class Rests:
    """The pauses after slow pictures or sound: commands share the modem's capacity with them.

    The next picture or sound waits for the end of the pause. ``on`` False: there are no pauses.
    """

    def __init__(self, on: bool) -> None:
        self.on = on
        self._until = float("-inf")

    def note(self, took_s: float, now: float) -> None:
        """Note a message that was just confirmed, after it kept the connection busy for ``took_s``."""
        if self.on and took_s > SLOW_S:
            self._until = max(self._until, now + min(_TIMES * took_s, _LONGEST_S))

    def lasts(self, now: float) -> bool:
        return now < self._until
