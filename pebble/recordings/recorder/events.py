"""Writes down what happens to the recording itself, between the messages that are recorded."""

import json
from collections import Counter
from collections.abc import Callable
from typing import Any

from pebble.recordings.recorder.clock import RecordingClock
from pebble.recordings.recorder.intake import Intake


class Events:
    """Any thread may note one; ``boot_ns`` is the clock that ``clock`` translates."""

    def __init__(
        self, intake: Intake, clock: RecordingClock, boot_ns: Callable[[], int], counters: Counter[str]
    ) -> None:
        self._intake, self._clock, self._boot_ns, self._counters = intake, clock, boot_ns, counters

    def note(self, name: str, **about: Any) -> None:
        """Write down what happened now."""
        boot_ns = self._boot_ns()
        payload = json.dumps({"t": self._clock.at(boot_ns) // 10**6, "event": name, **about}).encode()
        self._intake.add_event(payload, boot_ns)
        self._counters[f"event_{name}"] += 1

    def gap(self, since_ns: int, why: str, **about: Any) -> None:
        """Write down that nothing was recorded since ``since_ns`` (since 1970)."""
        now_ns = self._clock.now()
        self.note("gap", since=since_ns // 10**6, until=now_ns // 10**6, why=why, **about)
