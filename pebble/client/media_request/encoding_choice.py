"""Which encoding a robot is requested to send, one for all its viewers. Pure: times are passed in."""

from collections.abc import Collection, Sequence
from typing import Final

BEST_FIRST: Final = ("h264", "pbvd", "json")
_BETTER_AFTER_S: Final = 5.0  # a viewer that reloads its page comes back within this time


def best(offered: Collection[str], viewers: Sequence[frozenset[str]], pinned: str = "") -> str | None:
    """The best of what most viewers decode; None: whatever the robot sends.

    ``offered`` is empty for robots that do not list encodings. A pin counts for all viewers.
    """
    if pinned in offered:
        return pinned
    known = [encoding for encoding in BEST_FIRST if encoding in offered]
    return max(known, key=lambda encoding: sum(encoding in can for can in viewers), default=None)


class EncodingChoice:
    """Changes at once where a viewer needs it, and back to a better encoding only after a while."""

    def __init__(self) -> None:
        self.pinned = ""
        self.current: str | None = None
        self._wanted_since: tuple[str | None, float] = (None, 0.0)

    def update(self, offered: Collection[str], viewers: Sequence[frozenset[str]], now: float) -> str | None:
        """The encoding to request now. Without viewers nothing changes."""
        if not viewers and self.current in offered:
            return self.current
        wanted = best(offered, viewers, self.pinned)
        if wanted != self._wanted_since[0]:
            self._wanted_since = (wanted, now)
        if not self._suits(offered, viewers) or wanted == self.pinned or now - self._wanted_since[1] >= _BETTER_AFTER_S:
            self.current = wanted
        return self.current

    def _suits(self, offered: Collection[str], viewers: Sequence[frozenset[str]]) -> bool:
        """Whether the present encoding is offered, and decoded by as many viewers as any other."""
        if self.current is None or self.current not in offered:
            return False
        return best((self.current,), viewers) is not None and all(
            sum(self.current in can for can in viewers) >= sum(other in can for can in viewers) for other in offered
        )
