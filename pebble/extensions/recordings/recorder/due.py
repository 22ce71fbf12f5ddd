"""Tasks that are repeated at intervals. Pure."""

from collections.abc import Callable


class Due:
    """Tasks to repeat, each with its interval."""

    def __init__(self, boot_ns: Callable[[], int]) -> None:
        self._boot_ns = boot_ns
        self._done: dict[str, int] = {}  # by task: when it was due last
        self._began = boot_ns()
        self._checked: tuple[int, int] | None = None  # both clocks at the last call of suspended_s

    def every(self, what: str, seconds: float) -> bool:
        """True if the task ``what`` is due: at the earliest ``seconds`` after it was due last, or first asked for."""
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
