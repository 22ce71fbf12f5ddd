"""When a device was heard last, and whether it may have stopped reading what is sent to it."""

from __future__ import annotations

UNREAD_S = 1.0  # without a report, from a board that reports at rest


class Hearing:
    """A pseudo-terminal hides how much its reader has left unread, so a silent device behind one may obey late."""

    def __init__(self) -> None:
        self.reports_at_rest = False  # set by the owner, who knows the protocol
        self.received = 0  # chunks of bytes from the device since it was opened and has booted
        self.unread = 0  # drive lines that were not sent, because earlier ones were probably not read
        self.stopped = False  # one stop was sent in their place
        self.at = 0.0  # monotonic seconds

    def begin(self, now: float) -> None:
        """Count as heard a device that has just been opened."""
        self.at, self.stopped = now, False

    def heard(self, now: float) -> None:
        self.received += 1
        self.at, self.stopped = now, False
