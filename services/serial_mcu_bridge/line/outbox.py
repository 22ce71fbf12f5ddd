"""The lines that wait to be sent: the newest of each kind."""

from typing import NamedTuple

_DRIVE = "drive"


class _Waiting(NamedTuple):
    line: bytes
    expires: float  # on the caller's monotonic clock


class Outbox:
    """Slots for waiting lines, one per kind: a newer line replaces an older one. A line may also be a frame.

    Pure: the clock is passed in. A drive line that could not be sent in time is replaced by the stop line.
    """

    def __init__(self, stop: bytes, drive_timeout_s: float) -> None:
        self._stop, self._drive_timeout = stop, drive_timeout_s
        self.waiting: dict[str, _Waiting] = {}  # by kind

    def drive(self, line: bytes, now: float, valid_s: float, replaces: str = "") -> None:
        """Add a drive line that is valid for ``valid_s``, at most the timeout; drop a line of kind ``replaces``."""
        self.waiting.pop(replaces, None)
        self._place(_DRIVE, _Waiting(line, now + min(valid_s, self._drive_timeout)))

    def halt(self) -> None:
        """Put the stop line in the drive line's slot. It never expires."""
        self._place(_DRIVE, _Waiting(self._stop, float("inf")))

    def put(self, kind: str, line: bytes) -> None:
        """Add a line of any kind but drive lines, such as ``put("lights", …)``. It never expires."""
        self._place(kind, _Waiting(line, float("inf")))

    def take(self, now: float) -> bytes | None:
        """Return the line to send next, drive lines first; None if nothing waits."""
        kind = _DRIVE if _DRIVE in self.waiting else next(iter(self.waiting), None)
        if kind is None:
            return None
        waiting = self.waiting.pop(kind)
        return waiting.line if now <= waiting.expires else self._stop

    def clear(self) -> None:
        self.waiting.clear()

    def _place(self, kind: str, waiting: _Waiting) -> None:
        self.waiting.pop(kind, None)
        self.waiting[kind] = waiting
