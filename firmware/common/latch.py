"""The emergency stop of one motor owner: what latches it, and what resets it. Pure; boards and Linux robots share it.

Stopped means latched: nothing moves until a reset, also after a power cut. Times are milliseconds of any clock;
``diff`` subtracts two of them.
"""

_QUIET_MS = 500  # after a reset persons are refused until one sends a zero, or all pause for so long
_OLD_MS = 1000  # a reset that was read longer ago is refused
_BY = 32
_WHY = 40


class Latch:
    """``latched``, and what others need to know of it. A restart begins with a new ``boot`` and a ``count`` of 0."""

    def __init__(self, boot: str, names: int, diff) -> None:
        """``boot`` is random; ``names`` is how many names of stops are remembered."""
        self.latched = False
        self.boot = boot
        self.count = 0  # stops since the start
        self.recent: list[str] = []  # the names of the newest stops, the last one first
        self.by = ""
        self.why = ""
        self.since = 0  # epoch milliseconds of the newest stop
        self.reset_refused: str | None = None  # "boot", "count" or "old"
        self._names = names
        self._diff = diff
        self._waits = False  # after a reset, for persons to let go
        self._waits_from = 0

    def restore(self, saved: object) -> None:
        """Begin as ``saved``, a parsed file; anything that ``saved()`` never returns counts as a stop."""
        recent = saved.get("recent") if isinstance(saved, dict) else None
        if isinstance(saved, dict) and isinstance(saved.get("latched"), bool) and isinstance(recent, list):
            self.latched = saved["latched"]
            self.recent = [name for name in recent if is_name(name)][: self._names]
            self.by = _text(saved.get("by"), _BY)
            self.why = _text(saved.get("why"), _WHY)
            since = saved.get("since")
            self.since = since if isinstance(since, int) else 0
        else:
            self.latched = True
            self.why = "the saved state cannot be read"

    def saved(self) -> dict:
        """What ``restore`` needs."""
        names = ("latched", "recent", "by", "why", "since")
        return {name: getattr(self, name) for name in names}

    def state(self, persisted: bool | None) -> dict:
        """The payload of outgoing/estop/{owner}; ``persisted`` None: nothing can be saved."""
        names = ("latched", "boot", "count", "recent", "by", "why", "since", "reset_refused")
        state = {name: getattr(self, name) for name in names}
        state["persisted"] = persisted
        return state

    def stop(self, name: str, by: str, why: str, since: int) -> bool:
        """Latch, unless this stop is known already: then nothing changes, and the result is False.

        ``name`` is never empty: whoever receives a stop without a name makes one.
        """
        if name in self.recent:
            return False
        self.recent = ([name] + self.recent)[: self._names]
        self.latched = True
        self.count += 1
        self.by = by
        self.why = why
        self.since = since
        self.reset_refused = None
        self._waits = False
        return True

    def reset(self, boot: str, count: int, age: int, now: int) -> bool:
        """End the stop if the sender saw the newest state; ``age`` is how long ago the command was read."""
        self.reset_refused = (
            "boot" if boot != self.boot else "count" if count != self.count else "old" if age >= _OLD_MS else None
        )
        if self.reset_refused or not self.latched:
            return False
        self.latched = False
        self._waits = True
        self._waits_from = now
        return True

    def refuses(self, moves: bool, script: bool, now: int, ours: bool = True) -> bool:
        """Whether a drive command has no effect. While latched a zero passes: it may end the run of a script.

        ``ours`` False: somebody else has control, so this zero does not show that the one who drives lets go.
        """
        if self.latched:
            return moves
        if not self._waits or script:
            return False
        self.tick(now)
        if not moves and not ours:
            return False
        self._waits = self._waits and moves
        self._waits_from = now
        return self._waits

    def tick(self, now: int) -> None:
        """To be called at least every few minutes, because clocks of boards wrap."""
        if self._waits and self._diff(now, self._waits_from) >= _QUIET_MS:
            self._waits = False


def is_name(name: object) -> bool:
    """Whether this names a stop: 16 hex digits. A stop with any other name has none."""
    return isinstance(name, str) and len(name) == 16 and all(char in "0123456789abcdefABCDEF" for char in name)


def stop_of(body: object) -> tuple[str, str, str]:
    """``(name, by, why)`` of a parsed stop, of whatever shape; the name is "" if it has none."""
    fields = _fields(body)
    name = fields.get("stop")
    return str(name) if is_name(name) else "", _text(fields.get("by"), _BY), _text(fields.get("why"), _WHY)


def reset_of(body: object) -> tuple[str, int] | None:
    """``(boot, count)`` of a parsed reset; None if it is none."""
    fields = _fields(body)
    boot = fields.get("boot")
    count = fields.get("count")
    if isinstance(boot, str) and isinstance(count, int) and not isinstance(count, bool):
        return boot, count
    return None


def _fields(body: object) -> dict:
    inner = body.get("value") if isinstance(body, dict) else None
    if isinstance(inner, dict):
        return inner
    return body if isinstance(body, dict) else {}


def _text(value: object, limit: int) -> str:
    """Printable ASCII, without what JSON would have to escape."""
    if not isinstance(value, str):
        return ""
    return "".join([char if " " <= char <= "~" and char not in '"\\' else "?" for char in value[:limit]])
