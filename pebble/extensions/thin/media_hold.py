"""Lets programs that send pictures or sound wait while a person drives: they share the modem with the commands."""

from collections.abc import Callable, Collection
from typing import Final

HELD: Final = ("camera_publisher", "video_stream", "audio_publisher")
HOLD_S: Final = 5.0  # after the newest command that moves something: each beginning costs 2 KB of states and logs


class MediaHold:
    """Requests to the launcher that ``programs`` wait; ``send_one`` returns False if the launcher is busy."""

    def __init__(self, programs: Collection[str], send_one: Callable[[str, bool], bool]) -> None:
        self._sent = dict.fromkeys((name for name in HELD if name in programs), False)
        self._send_one = send_one
        self._driven_at = float("-inf")

    def note_drive(self, now: float) -> None:
        """Note a command over a thin link that moves something. Any thread may call this."""
        self._driven_at = now

    def send(self, now: float) -> None:
        """Send the requests that have changed with time, and again those that the launcher has not accepted."""
        on = now - self._driven_at < HOLD_S
        for program, sent in self._sent.items():
            if sent is not on and self._send_one(program, on):
                self._sent[program] = on
