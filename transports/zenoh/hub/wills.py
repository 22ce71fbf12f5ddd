"""When a hub publishes the will of a client that is gone, alone or as one of several linked hubs. Pure.

Every linked hub has the wills of all clients, and one of them is to publish each: the client's *home*, to which its
session was linked, or if that is gone too a successor, later than the client needs to reach another hub.
"""

from collections.abc import Iterable

import msgspec

ALONE_S = 0.1  # before a dead client's will is published, so that its last messages come first
HOME_S = 0.3  # the same among several hubs: the last messages may come by another one
#: Longer than a client of a hub that hangs needs to reach the next: its lease of 2 s and the 2 s in which it tries to
#: connect, less what of it runs side by side (measured: 3.6 s; after 1.5 s there were false wills).
SUCCESSOR_S = 3.0
RANK_S = 0.5  # between one successor and the next
MAX_RANK = 7
LINK_S = 5.0  # a hub stays the home of a client for so long after their link was lost,
SAME_S = 0.25  # though another one may be its home by now, unless its token went with the link
RETURN_S = 2.5  # after a restart clients have this long to reconnect before their wills are published
STILL_S = 1.0  # a hub that stood still for longer has lost its clients to others, without having seen it
PUT_OFF_S = 10.0  # messages put off a will by no more: their sender's name is believed
MAX_LOST = 1000  # sessions whose lost links are remembered


class Due(msgspec.Struct):
    """``successor``: another hub was the home. ``ranked``: it waits for its turn among the successors that are there at
    that time, because hubs do not learn at one instant that another is gone. ``latest``: it is put off no further.
    """

    at: float
    successor: bool
    ranked: bool
    latest: float


class WillTimes:
    """The clients of the hub ``name``, by the names of their sessions, and when their wills are due."""

    def __init__(self, name: str) -> None:
        self.hubs: set[str] = set()  # others that are there
        self._name = name
        self._met_others = False
        self._sessions: dict[str, str] = {}  # Zenoh's id of each client's session
        self._links: dict[str, float | None] = {}  # of a session to this hub: when it was lost, None while it is there
        self._due: dict[str, Due] = {}
        self._still_until = float("-inf")

    # -- what happens

    def on_hub(self, name: str, *, present: bool) -> None:
        """Another hub appears or is gone."""
        self._met_others = self._met_others or present
        (self.hubs.add if present else self.hubs.discard)(name)

    def on_link(self, session: str, now: float, *, present: bool) -> None:
        """A session is linked to this hub, or is no longer."""
        self._links.pop(session, None)
        self._links[session] = None if present else now
        if not present and len(self._links) > MAX_LOST:
            lost = next((one for one, at in self._links.items() if at is not None), session)
            del self._links[lost]

    def on_hello(self, name: str, session: str, now: float, *, alive: bool, has_will: bool) -> None:
        """A client has told its will. If its token never comes, it has died meanwhile."""
        self._sessions.pop(name, None)
        if has_will and session:
            self._sessions[name] = session
        if alive:
            self._due.pop(name, None)
        elif has_will and (not self._met_others or self.is_home(name, now)):
            self._put(name, now + RETURN_S, successor=False)
        elif has_will:
            self._put(name, now + RETURN_S + SUCCESSOR_S, successor=True, ranked=True)

    def on_alive(self, name: str) -> None:
        self._due.pop(name, None)
        session = self._sessions.get(name, "")
        if self._links.get(session) is not None:
            del self._links[session]  # it has come back, by another hub

    def on_gone(self, name: str, now: float) -> None:
        """The token of a client that has left a will is gone."""
        if not self._met_others:
            self._put(name, now + ALONE_S, successor=False)
        elif self.is_home(name, now) and now >= self._still_until:
            lost = self._link_lost(name)
            roamed = lost is not None and now - lost > SAME_S
            self._put(name, now + HOME_S + RANK_S * roamed, successor=False)
        else:
            self._put(name, now + SUCCESSOR_S, successor=True, ranked=True)

    def on_message(self, name: str, now: float) -> None:
        """A retained message of a client has come, perhaps on another way than its token went."""
        if self._met_others and (due := self._due.get(name)) is not None:
            due.at = max(due.at, min(now + HOME_S, due.latest))

    def on_standstill(self, now: float) -> None:
        """This hub was stopped, or its machine asleep: what it sees in the next seconds is old."""
        self._still_until = now + LINK_S
        if self._met_others:
            self.on_other_hub(list(self._due), now)

    def on_new_session(self) -> None:
        """Hubs, links and clients have to be seen again."""
        self.hubs.clear()
        self._sessions.clear()
        self._links.clear()

    def on_restart(self, names: Iterable[str], now: float) -> None:
        """There are wills of before; their clients may come back, here or at another hub."""
        names = [name for name in names if name not in self._due]
        for name in names:
            self._put(name, now + RETURN_S, successor=True)
        if self.hubs:
            self.on_other_hub(names, now)

    def on_other_hub(self, names: Iterable[str], now: float) -> None:
        """Others have had these wills while this hub was away, and come first."""
        for name in names:
            if (due := self._due.get(name)) is not None:
                self._put(name, max(due.at, now + SUCCESSOR_S + RANK_S * MAX_RANK), successor=True, ranked=True)

    def forget(self, name: str) -> None:
        """The client has no will any more."""
        self._due.pop(name, None)
        self._sessions.pop(name, None)

    # -- what follows

    @property
    def next_due(self) -> float:
        turn = self._turn
        return min((due.at + turn * due.ranked for due in self._due.values()), default=float("inf"))

    @property
    def met_others(self) -> bool:
        return self._met_others

    def take_due(self, now: float) -> list[tuple[str, bool]]:
        """The clients whose wills are due, and whether this hub publishes one as a successor; each is returned once."""
        turn = self._turn
        taken = [(name, due.successor) for name, due in self._due.items() if now >= due.at + turn * due.ranked]
        for name, _ in taken:
            self.forget(name)
        return taken

    def is_home(self, name: str, now: float) -> bool:
        """Whether this hub is, or was just now, the one that the client is linked to."""
        lost = self._link_lost(name)
        return lost is None or now - lost < LINK_S

    def _link_lost(self, name: str) -> float | None:
        """When; None: it is there."""
        return self._links.get(self._sessions.get(name, ""), float("-inf"))

    def ends_predecessors(self, name: str, session: str, now: float) -> bool:
        """Whether this hub publishes the pending wills of a client that has begun anew: one of several does."""
        if not self.hubs:
            return True
        return self.is_home(name, now) if session else self._rank == 0  # one of before tells no session

    @property
    def _rank(self) -> int:
        return min(MAX_RANK, sorted({*self.hubs, self._name}).index(self._name))

    @property
    def _turn(self) -> float:
        """How long it leaves the successors before it."""
        return RANK_S * self._rank

    def _put(self, name: str, at: float, *, successor: bool, ranked: bool = False) -> None:
        self._due[name] = Due(at, successor, ranked, at + PUT_OFF_S)
