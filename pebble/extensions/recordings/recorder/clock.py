"""The clock for times of arrival, and tasks that are repeated at intervals. Pure."""

from collections.abc import Callable
from typing import Final

_JUMP_NS: Final = 500_000_000
_FOLLOWED_PER_S: Final = 5_000_000  # nanoseconds per second: clocks drift, and NTP slews by 0.5 ms per second


class RecordingClock:
    """Wall time without jumps, except those that :meth:`follow` returns.

    It is an offset from a clock that cannot be set and counts while the machine is suspended. ``wall_ns`` and
    ``boot_ns`` return those clocks, in nanoseconds.
    """

    def __init__(self, wall_ns: Callable[[], int], boot_ns: Callable[[], int]) -> None:
        self._wall_ns, self._boot_ns = wall_ns, boot_ns
        self._checked_at = boot_ns()
        self.offset_ns = wall_ns() - self._checked_at

    def at(self, boot_ns: int) -> int:
        """Return the wall time (nanoseconds since 1970) for a time of the other clock."""
        return boot_ns + self.offset_ns

    def now(self) -> int:
        return self.at(self._boot_ns())

    def follow(self) -> float:
        """Follow the wall clock; call this once a second. Return by how many seconds it was set, else 0.

        Small differences are followed slowly, so that time never stands still within a file.
        """
        now = self._boot_ns()
        difference = self._wall_ns() - now - self.offset_ns
        most = (now - self._checked_at) * _FOLLOWED_PER_S // 10**9
        self._checked_at = now
        if abs(difference) > _JUMP_NS:
            self.offset_ns += difference
            return difference / 1e9
        self.offset_ns += max(-most, min(most, difference))
        return 0.0


class Due:
    """Tasks to repeat, each with its interval."""

    def __init__(self, boot_ns: Callable[[], int]) -> None:
        self._boot_ns = boot_ns
        self._done: dict[str, int] = {}  # by task: when it was due last
        self._began = boot_ns()
        self._checked: tuple[int, int] | None = None  # both clocks at the last call of suspended_s

    def every(self, what: str, seconds: float) -> bool:
        """True if the task ``what`` is due: ``seconds`` have passed since it was due last.

        At a task's first call, this object must be ``seconds`` old; if it is not, ``seconds`` count from that call.
        """
        now = self._boot_ns()
        if now - self._done.get(what, self._began) < seconds * 1e9:
            self._done.setdefault(what, now)
            return False
        self._done[what] = now
        return True

    def suspended_s(self, awake_ns: int) -> float:
        """Return for how many seconds the machine was suspended since the last call.

        ``awake_ns``: the time of a clock that stands still meanwhile.
        """
        now = self._boot_ns()
        boot_before, awake_before = self._checked or (now, awake_ns)
        self._checked = now, awake_ns
        return ((now - boot_before) - (awake_ns - awake_before)) / 1e9
