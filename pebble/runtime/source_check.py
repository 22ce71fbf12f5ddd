"""Checks that the contents of a source do not repeat themselves. Pure."""

from collections import deque
from collections.abc import Hashable
from typing import Final

REPEATS_S: Final = 5.0  # with the same content: measurements are never the same for so long


class SourceCheck:
    """A record of a source's newest contents. One thread writes, any thread reads."""

    def __init__(self, *, remembered: int = 1) -> None:
        """Make a record. ``remembered``: how many recent contents to compare."""
        self.content: Hashable = None  # the newest
        self.same_s = 0.0  # for so long no new content has come
        self.changes = 0  # so often a new content has come
        self.alternates = False  # several remembered contents come in turn
        self._recent: deque[Hashable] = deque(maxlen=remembered)
        self._at = 0.0  # when the newest came

    @property
    def repeats(self) -> bool:
        return self.same_s >= REPEATS_S

    def clear(self) -> None:
        """Forget the source's history, because it was opened again."""
        self.same_s, self.changes = 0.0, 0
        self._recent.clear()

    def take(self, content: Hashable, now: float, *, counts: bool = True) -> None:
        """Note a content. ``counts``: False while repetitions are normal, as for a sensor at rest."""
        if content not in self._recent:
            if self._recent:
                self.changes += 1
            self._recent.append(content)
            self.same_s = 0.0
        else:
            if counts:
                self.same_s += now - self._at
            self.alternates = content != self.content
        self.content, self._at = content, now
