"""Detects broken sensors: their values must change while the wheels turn. Pure."""

from collections import defaultdict
from collections.abc import Hashable, Mapping

from pebble.runtime.source_check import REPEATS_S, SourceCheck


class MovingSensors:
    """The sensors of one board, by their names. At rest, a sensor may repeat its value."""

    def __init__(self) -> None:
        self._checks: dict[str, SourceCheck] = defaultdict(SourceCheck)
        self._drives_until = float("-inf")

    def drive(self, until: float) -> None:
        """Note until when the wheels are commanded to move; a time in the past ends the motion."""
        self._drives_until = until

    def take(self, values: Mapping[str, Hashable], now: float) -> None:
        for name, value in values.items():
            self._checks[name].take(value, now, counts=now < self._drives_until)

    @property
    def problem(self) -> str:
        """The problem in words, or empty. Sensors that have never changed count only if no sensor changes now."""
        still = [name for name, check in self._checks.items() if check.repeats]
        if len(still) < len(self._checks):
            still = [name for name in still if self._checks[name].changes]  # which have changed before
        if not still:
            return ""
        verb = "repeats its value" if len(still) == 1 else "repeat their values"
        return f"{', '.join(still)} {verb} while the wheels are commanded for {REPEATS_S:g} s and more"
