"""The times at which a hub publishes the wills of lost clients. Pure."""

from collections.abc import Iterable

GONE_S = 0.1  # before a dead client's will is published, so that its last messages come first
RETURN_S = 2.5  # after a restart clients have this long to reconnect before their wills are published


class WillTimes:
    """The times at which wills are due, by the session names of their clients."""

    def __init__(self) -> None:
        self._due: dict[str, float] = {}

    def on_hello(self, name: str, now: float, *, alive: bool, has_will: bool) -> None:
        """Note a client's hello. ``alive``: its token is there; if not, and none follows, its will is due."""
        if alive:
            self._due.pop(name, None)
        elif has_will:
            self._due[name] = now + RETURN_S

    def on_gone(self, name: str, now: float) -> None:
        """Note that a client that has left a will here is gone: its token has disappeared."""
        self._due[name] = now + GONE_S

    def on_restart(self, names: Iterable[str], now: float) -> None:
        """Give the clients of these stored wills time to come back after a restart, before the wills are published."""
        for name in names:
            self._due.setdefault(name, now + RETURN_S)

    def forget(self, name: str) -> None:
        """Forget the will of a client that is present, or no longer has a will."""
        self._due.pop(name, None)

    @property
    def next_due(self) -> float:
        return min(self._due.values(), default=float("inf"))

    def take_due(self, now: float) -> list[str]:
        """Remove and return the clients whose wills are due."""
        due_names = [name for name, due in self._due.items() if now >= due]
        for name in due_names:
            del self._due[name]
        return due_names
