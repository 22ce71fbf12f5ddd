"""The emergency stop of one motor owner: its latch, and resets. Pure; boards and Linux robots share it.

Stopped means latched: nothing moves until a reset, not even after a power cut. Times are milliseconds of any clock;
``diff`` subtracts two of them.
"""


class Latch:
    """A latch with its published state. A restart begins with a new ``boot`` and a ``count`` of 0."""

    def __init__(self, boot: str, names: int, diff) -> None:
        """Store the arguments; ``boot`` is random, ``names`` the number of names of stops to remember."""
        self.latched = False
        self.boot = boot
        self.count = 0  # stops since the start
        self.recent: list[str] = []  # the names of the newest stops, the last one first
        self.client: list[str | None] = []  # the sender of each of them; None: from before the start
        self.by = ""
        self.why = ""
        self.since = 0  # epoch milliseconds of the newest stop
        self.reset_refused: str | None = None  # "boot", "count" or "old"
        self.names = names
        self._diff = diff
        self._waits = False  # after a reset, until persons let go
        self._waits_from = 0

    def restore(self, saved: object) -> None:
        """Continue with ``saved``, a parsed file. A value that ``saved()`` never returns counts as a stop."""
        recent = saved.get("recent") if isinstance(saved, dict) else None
        if isinstance(saved, dict) and isinstance(saved.get("latched"), bool) and isinstance(recent, list):
            self.latched = saved["latched"]
            self.recent = [name for name in recent if is_name(name)][: self.names]
            self.client = [None] * len(self.recent)
            self.by = _text(saved.get("by"), 32)
            self.why = _text(saved.get("why"), 40)
            since = saved.get("since")
            self.since = since if isinstance(since, int) else 0
        else:
            self.latched = True
            self.why = "the saved state cannot be read"

    def saved(self) -> dict:
        """Return the state to save, for ``restore``."""
        return self._fields("latched", "recent", "by", "why", "since")

    def state(self, persisted: bool | None) -> dict:
        """Return the payload of outgoing/estop/{owner}; ``persisted`` None: nothing can be saved."""
        state = self._fields("latched", "boot", "count", "recent", "by", "why", "since", "reset_refused")
        state["persisted"] = persisted
        return state

    def _fields(self, *names: str) -> dict:
        fields = {}
        for name in names:
            fields[name] = getattr(self, name)
        return fields

    def stop(self, name: str, by: str, why: str, since: int) -> bool:
        """Latch and return True; return False if this stop is known already.

        ``name`` is never empty: the receiver of a stop without a name makes one. ``by`` ends in "?" if the sender was
        not checked; a checked sender replaces it when the same stop comes again. If there are too many names, the
        sender with the most names loses its oldest, so that stops of one account do not push out another's. All senders
        that were not checked count as one.
        """
        sender = "?" if by[-1:] == "?" else by.split("/")[0]
        if name in self.recent:
            place = self.recent.index(name)
            if by and self.client[place] == "?":
                self.client[place] = sender
            # the newest stop, of a sender that was not checked, comes again from one that was
            if name == self.recent[0] and by and self.by[-1:] == "?" and by[-1] != "?":
                self.by = by
            return False
        senders = self.client
        senders.insert(0, sender)
        self.recent = [name] + self.recent  # a new list: states that were returned have the old one
        if len(senders) > self.names:  # one from before the start goes first, then of the busiest sender the oldest
            place = max([(other is None, senders.count(other), at) for at, other in enumerate(senders)])[2]
            del self.recent[place], senders[place]
        self.latched = True
        self.count += 1
        self.by = by
        self.why = why
        self.since = since
        self.reset_refused = None
        self._waits = False
        return True

    def reset(self, boot: str, count: int, age: int, now: int) -> bool:
        """End the stop if the sender has seen the newest state, and the reset was read in the last second.

        Then persons are refused until one sends a zero, or all pause for half a second.
        """
        self.reset_refused = None
        if boot != self.boot:
            self.reset_refused = "boot"
        elif count != self.count:
            self.reset_refused = "count"
        elif age >= 1000:
            self.reset_refused = "old"
        if self.reset_refused or not self.latched:
            return False
        self.latched = False
        self._waits = True
        self._waits_from = now
        return True

    def refuses(self, moves: bool, script: bool, now: int) -> bool:
        """True if a drive command has no effect. While latched a zero passes: it may end a script's run."""
        if self.latched:
            return moves
        if not self._waits or script:  # a script is a new one: the stop has barred all runs before it
            return False
        self.tick(now)
        self._waits = self._waits and moves
        self._waits_from = now
        return self._waits

    def tick(self, now: int) -> None:
        """Admit persons again if all have paused for half a second since a reset.

        Call it at least every few minutes, as clocks of boards wrap.
        """
        if self._waits and self._diff(now, self._waits_from) >= 500:
            self._waits = False


def is_name(name: object) -> bool:
    """True if this is the name of a stop: 16 hex digits. A stop with any other name counts as having none."""
    return isinstance(name, str) and len(name) == 16 and not name.strip("0123456789abcdefABCDEF")


def stop_of(body: object) -> tuple[str, str, str]:
    """Return ``(name, by, why)`` of a parsed stop of any shape; the name is "" if it has none."""
    command = fields(body)
    name = command.get("stop")
    return str(name) if is_name(name) else "", _text(command.get("by"), 32), _text(command.get("why"), 40)


def reset_of(body: object) -> tuple[str, int] | None:
    """Return ``(boot, count)`` of a parsed reset; None if it is not a reset."""
    command = fields(body)
    boot = command.get("boot")
    count = command.get("count")
    if isinstance(boot, str) and isinstance(count, int) and not isinstance(count, bool):
        return boot, count
    return None


def fields(body: object) -> dict:
    """Return the fields of a command, bare or wrapped in ``value``."""
    inner = body.get("value") if isinstance(body, dict) else None
    if isinstance(inner, dict):
        return inner
    return body if isinstance(body, dict) else {}


def _text(value: object, limit: int) -> str:
    """Return ``value`` as printable ASCII, without characters that JSON has to escape."""
    if not isinstance(value, str):
        return ""
    return "".join([char if " " <= char <= "~" and char not in '"\\' else "?" for char in value[:limit]])
