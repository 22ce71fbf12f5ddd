"""Tasks that are repeated at intervals. Pure."""

from collections.abc import Callable


class Due:
    """Tasks to repeat, each with its interval."""

    def __init__(self, boot_ns: Callable[[], int]) -> None:
        self._boot_ns = boot_ns
        self._done: dict[str, int] = {}
        self._began = self._awake_at = boot_ns()
        self._awake: int | None = None

    def every(self, what: str, seconds: float) -> bool:
        now = self._boot_ns()
        if now - self._done.get(what, self._began) < seconds * 1e9:
            self._done.setdefault(what, now)
            return False
        self._done[what] = now
        return True

    def suspended_s(self, awake_ns: int) -> float:
        """Return for how many seconds the machine was suspended since the last call."""
        now = self._boot_ns()
        slept = 0 if self._awake is None else (now - self._awake_at) - (awake_ns - self._awake)
        self._awake, self._awake_at = awake_ns, now
        return slept / 1e9
