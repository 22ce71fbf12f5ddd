"""Rows of the audit before they are stored: repeated ones merged, and a quota for each person and kind. Pure."""

from collections import Counter, defaultdict
from dataclasses import dataclass

from pebble.fleet.tries import network_of

#: What anybody can cause, without a right and without a login: in a table of its own.
REFUSED = frozenset({"login-refused", "login-limited", "audit-dropped"})
WINDOW_S = 60.0  # repeated rows within this time are one
EACH = 60  # different rows of one person and kind within it; what is beyond is one row more
GROUPS = 100  # persons, or addresses, that have rows of their own of a kind within it
WAITING = 1000  # rows of one class that wait to be stored
OTHERS = "(others)"
_MAX_TEXT = 200


@dataclass(slots=True)
class Entry:
    """One row of the audit log; ``at`` and ``last`` are epoch seconds, of the first and the last of ``count``."""

    at: float
    what: str
    ref: str
    user: str
    device: str
    address: str
    detail: str
    count: int = 1
    last: float = 0.0
    number: int = 0  # in its table; 0: it is not stored yet

    @property
    def refused(self) -> bool:
        return self.what in REFUSED


class Merging:
    """Merges what is added, until it is taken. Bounded by GROUPS, EACH and WAITING; what does not fit is counted."""

    def __init__(self) -> None:
        self.dropped = 0
        self._since = float("-inf")
        self._open: dict[object, Entry] = {}
        self._groups: defaultdict[str, Counter[str]] = defaultdict(Counter)  # by kind: open rows of each
        self._waiting: dict[bool, dict[int, Entry]] = {False: {}, True: {}}  # by identity, the oldest first

    @property
    def waits(self) -> bool:
        return any(self._waiting.values())

    def add(self, entry: Entry, now: float) -> None:
        """Count it; ``now`` is monotonic."""
        if now - self._since >= WINDOW_S:
            self._since = now
            self._open.clear()
            self._groups.clear()
        entry.last = entry.at
        key = self._key(entry)
        row = self._open.get(key, entry)
        if id(row) not in self._waiting[entry.refused]:
            if len(self._waiting[entry.refused]) >= WAITING:
                self.dropped += 1
                return
            self._waiting[entry.refused][id(row)] = row
        if row is entry:
            self._open[key] = entry
        else:
            _merge(row, entry)

    def take(self) -> list[Entry]:
        """What is to be stored now; the rows stay open, and wait again when they change."""
        rows = [row for waiting in self._waiting.values() for row in waiting.values()]
        for waiting in self._waiting.values():
            waiting.clear()
        return rows

    def give_back(self, rows: list[Entry]) -> None:
        """They could not be stored: they wait again, before what came meanwhile."""
        for refused, waiting in self._waiting.items():
            again = {id(row): row for row in rows if row.refused is refused}
            self._waiting[refused] = {**again, **waiting}

    def begin_again(self) -> None:
        """Rows have no numbers any more."""
        self._since = float("-inf")
        for waiting in self._waiting.values():
            for row in waiting.values():
                row.number = 0

    def _key(self, entry: Entry) -> object:
        """What the row has in common with those that are merged with it. Beyond the quotas it loses its own texts."""
        groups = self._groups[entry.what]
        who = network_of(entry.address) if entry.refused else entry.user  # of a login that failed the user is a claim
        if who not in groups and len(groups) >= GROUPS:
            who = OTHERS
            if entry.refused:
                entry.address = OTHERS
            else:
                entry.user = OTHERS
        shared = entry.what, who
        key = shared if entry.refused else (*shared, entry.ref, entry.device, entry.address, entry.detail)
        if key in self._open:
            return key
        if groups[who] >= EACH:
            entry.ref, entry.device, entry.detail = OTHERS, "", ""
            return shared
        groups[who] += 1
        return key


def new(at: float, what: str, ref: str, user: str, device: str, address: str, detail: str) -> Entry:
    """An entry whose texts can be stored."""
    what, ref, user, device, address, detail = map(_storable, (what, ref, user, device, address, detail))
    return Entry(at, what, ref, user, device, address, detail)


def _merge(row: Entry, entry: Entry) -> None:
    row.count += entry.count
    row.last = entry.at
    if row.address not in (entry.address, network := network_of(entry.address)):
        row.address = network if network_of(row.address) == network else OTHERS
    if entry.user not in row.user.split(", ") and not row.user.endswith("…"):
        longer = f"{row.user}, {entry.user}"
        row.user = longer if len(longer) < _MAX_TEXT else f"{row.user}, …"


def _storable(text: str) -> str:
    return text[:_MAX_TEXT].encode(errors="replace").decode()
