"""Who has control of one motor owner: a lease that it gives, renews and ends. Pure; boards and Linux robots share it.

Control orders people; it is no safety function. A stop and a zero need none. A drive command names the control under
which it is sent by a key, which is new whenever another one gets control: so commands of before have no effect.
``who`` is ``(by, id, device)``; ``by`` is an account, or a server and its person, ``page-1/ann``.
"""

SHORTEST_MS = 1000
USUAL_MS = 3000
LONGEST_MS = 10_000
BY = 40  # characters
DEVICE = 20

# Commands without a key move the motors, only while nobody has control, or never.
DRIVE = "drive"
FREE = "free"
REFUSE = "refuse"

_IDLE_MS = 5000  # so long after the last command that moved anything, control is given to others at once
_OTHERS_MS = 2000
_KEYS = 80  # characters, so that nobody can try many
_NOBODY = ("", "", "")
_LETTERS = "abcdefghijklmnopqrstuvwxyz0123456789_-/"


class Lease:
    """``hold`` and ``release`` for requests; ``refuses`` for drive commands; ``tick`` regularly."""

    def __init__(self, now: int, diff, random, strangers: str = DRIVE, named: bool = False) -> None:
        """``random`` returns 8 hex digits. ``named``: of two who have the same id or key, the account decides."""
        self.key = ""  # "": nobody has control
        self.holder = _NOBODY
        self.asker = _NOBODY
        self.others = False  # a command without a key has moved something in the last 2 s
        self.changed = True  # since the last state
        self.halts = False  # another one has control, or nobody: the motors are to be stopped
        self._diff = diff
        self._random = random
        self._strangers = strangers
        self._named = named
        self._since = self._moved = self._asked = self._other = now
        self._for = self._asks_for = 0
        self._idle = True

    def hold(self, who: tuple, for_ms: int, over: bool, now: int) -> None:
        """Request control, or renew it. ``over``: whoever has it is not asked."""
        self.tick(now)
        for_ms = min(max(for_ms, SHORTEST_MS), LONGEST_MS)
        if self.key and self._same(who, self.holder):
            self._since = now
            self._for = for_ms
        elif over or self._idle:
            self._give(who, for_ms, now)
        elif self.asker is _NOBODY or self._same(who, self.asker):
            self.changed = self.changed or self.asker is _NOBODY
            self.asker = who
            self._asks_for = for_ms
            self._asked = now

    def release(self, who: tuple, now: int) -> None:
        """End control, or the request for it."""
        self.tick(now)
        if self.key and self._same(who, self.holder):
            self._end(now)
        elif self._same(who, self.asker):
            self.asker = _NOBODY
            self.changed = True

    def holds(self, key: str, by: str) -> bool:
        """Whether a command with this key is from who has control. For several motor owners it has the key of each."""
        own = self.key
        if own == "" or (key != own and (len(key) > _KEYS or own not in key.split(" "))):
            return False
        return not self._named or _account(by) == _account(self.holder[0])

    def refuses(self, moves: bool, script: bool, key: str, by: str, now: int) -> bool:
        """Whether a drive command has no effect; one of who has control renews it. A zero always has an effect.

        With names, a command from elsewhere has a ``by``; without one it is a program's of the robot. ``tick`` first.
        """
        if self.holds(key, by):
            self._since = now
            return False
        if not moves or (not key and (script or (self._named and not by))):
            return False
        return key != "" or self._strangers == REFUSE or (self._strangers == FREE and self.key != "")

    def moved(self, key: str, now: int) -> None:
        """A person's command that moves something was admitted."""
        if key:
            self._moved = now
            self._idle = False
        else:
            self._other = now
            self.changed = self.changed or not self.others
            self.others = True

    def tick(self, now: int) -> None:
        """Let what is over end; at least every few minutes, because clocks of boards wrap."""
        diff = self._diff
        if self.others and diff(now, self._other) >= _OTHERS_MS:
            self.others = False
            self.changed = True
        if self.asker is not _NOBODY and diff(now, self._asked) >= self._asks_for:
            self.asker = _NOBODY
            self.changed = True
        if not self._idle and diff(now, self._moved) >= _IDLE_MS:
            self._idle = True
        if self.key and (diff(now, self._since) >= self._for or (self._idle and self.asker is not _NOBODY)):
            self._end(now)

    def state(self, boot: str) -> dict:
        """The payload of outgoing/control/{owner}."""
        by, name, device = self.holder
        asks, asks_id, _ = self.asker
        return {
            "by": by, "id": name, "key": self.key, "device": device, "asks": asks, "asks_id": asks_id,
            "others": self.others, "named": self._named, "boot": boot,
        }  # fmt: skip

    def _same(self, who: tuple, other: tuple) -> bool:
        return who[1] == other[1] and (not self._named or _account(who[0]) == _account(other[0]))

    def _give(self, who: tuple, for_ms: int, now: int) -> None:
        self._change(who, self._random())
        self._for = for_ms
        self._since = self._moved = now
        self._idle = False

    def _end(self, now: int) -> None:
        if self.asker is _NOBODY:
            self._change(_NOBODY, "")
            self._idle = True
        else:
            self._give(self.asker, self._asks_for, now)

    def _change(self, holder: tuple, key: str) -> None:
        self.holder = holder
        self.key = key
        self.asker = _NOBODY
        self.changed = self.halts = True


def _account(by: str) -> str:
    return by.split("/")[0]


def shown(text: str, limit: int) -> str:
    """``text`` in the letters of names; "/" separates a server and its person."""
    small = [char.lower() if "A" <= char <= "Z" else char for char in text[:limit]]
    return "".join([char if char in _LETTERS else "_" for char in small])
