"""Publishes a state when it changes, but not more often than its topic may be published."""

from collections import deque
from collections.abc import Callable

STATES_PER_S = 4


class Paced:
    """A rate limit: each change calls ``publish()``, at once or as soon as ``per_s`` calls a second allow it."""

    def __init__(self, publish: Callable[[], object], per_s: int = STATES_PER_S) -> None:
        self._publish = publish
        self._published = deque([float("-inf")] * per_s, maxlen=per_s)  # the times of the newest ones
        self.due: float | None = None  # when a state that has to wait is published

    @property
    def last(self) -> float:
        """Time at which the newest state was published."""
        return self._published[-1]

    def changed(self, now: float) -> None:
        """Publish the changed state now, or let it wait until :attr:`due`."""
        allowed_at = self._published[0] + 1.0
        if now < allowed_at:
            self.due = allowed_at
        else:
            self.due = None
            self._published.append(now)
            self._publish()

    def tick(self, now: float) -> None:
        """Publish a state that had to wait. Call this at :attr:`due`."""
        if self.due is not None and now >= self.due:
            self.changed(now)
