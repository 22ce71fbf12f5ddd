"""What linked hubs tell each other: which wills were published, and after a separation what they retain.

A hub that sees another appear compares tables with it: the one with the smaller name asks. What it asks and is given
goes by queries on a thread of its own; everything else happens on the hub's thread.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import msgspec
import zenoh
from msgspec.structs import replace

from pebble.transports.zenoh import wire
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.hub import merge
from pebble.transports.zenoh.hub.links import Links
from pebble.transports.zenoh.hub.records import Retained
from pebble.transports.zenoh.hub.store import HubStore
from pebble.transports.zenoh.hub.wills import WillTimes
from pebble.transports.zenoh.keymap import topic_to_key

log = logging.getLogger(__name__)

PATIENCE_S = 2.0  # queries of clients wait so long for a merge: until then an older value may be here
ASK_S = 1.0  # for a table of another hub, or for our own thread
VALUES_S = 10.0  # for values, which may be large
ASKED = 5  # times, before another hub counts as one that does not merge
MAX_REPLACED = 1000  # values that a will replaced, in case its client comes back
MAX_REPLACED_BYTES = 4096  # of one of them: heartbeats have a tenth of it
_PAUSE_S = 0.1
_LONGEST_NAME = 12  # of a hub; an exchange is longer


if TYPE_CHECKING:
    _Queued = Callable[[Callable[[Any], None]], zenoh.handlers.Callback[Any]]


class Hub(Protocol):
    """What a mesh uses of its hub, on the hub's thread but for `post`."""

    @property
    def store(self) -> HubStore: ...
    @property
    def alive_clients(self) -> set[str]: ...
    def post(self, task: Callable[[], None]) -> None: ...
    def apply(self, record: Retained, age_s: float) -> bool: ...
    def forget_will(self, name: str) -> None: ...
    def ask_again(self, *, merge: bool = False) -> None: ...


class _Decided(NamedTuple):
    """Keys to ask for, values and ages to give, and the clients whose wills each side forgets."""

    want: list[str]
    give: list[merge.Value]
    ages: dict[str, float]
    they_forget: list[str]
    we_forget: list[str]
    at: float


class Mesh:
    """The other hubs, seen from the hub ``name``."""

    def __init__(self, name: str, hub: Hub, wills: WillTimes) -> None:
        self.merges = 0
        self._name, self._hub, self._wills = name, hub, wills
        self._session: zenoh.Session | None = None
        self._unmerged: dict[str, float] = {}  # until when clients wait, by hub
        self._recalled: set[str] = set()  # clients whose wills are of before a restart
        # By clients whose wills this hub published as a successor: what was there, when that came.
        self._replaced: dict[str, tuple[Retained, float]] = {}
        self._names: dict[str, set[str]] = {}  # under which each other hub is there
        self._compared: dict[str, float] = {}  # when another hub got our table
        self._taken: dict[str, int] = {}  # values of another hub, in the parts so far
        self._links = Links(time.monotonic())

    def serve(self, session: zenoh.Session, queued: _Queued) -> None:
        """Take part in the mesh of ``session``; ``queued`` brings an event to the hub's thread."""

        def on_token(sample: zenoh.Sample) -> None:
            # Our own come on the thread that declares them: it must not wait for room in the queue that it empties.
            if _named(sample)[0] != self._name:
                self._hub.post(partial(self._on_hub, sample))

        self._session = session
        self._names.clear()
        self._hub.post(self._links.on_new_session)
        others = zenoh.Locality.REMOTE
        session.declare_subscriber(wire.PUBLISHED, queued(self._on_published), allowed_origin=others)
        session.declare_queryable(wire.MERGE + self._name, queued(self._on_merge))
        session.declare_queryable(wire.STATE + self._name, queued(self._on_state))
        session.liveliness().declare_subscriber(wire.UP + "*", direct(on_token), history=True)
        session.info.declare_transport_events_listener(queued(self._on_link), history=True)

    # -- for the hub's other tasks

    def is_cut(self) -> bool:
        """Whether its connections must be made anew."""
        seen = len(self._wills.hubs) if self._wills.met_others else None
        return self._links.is_cut(seen, time.monotonic())

    def on_standstill(self) -> None:
        self._links.on_standstill(time.monotonic())

    @property
    def merging_until(self) -> float:
        """Until when queries of clients wait, in the past if there is nothing to wait for."""
        return max(self._unmerged.values(), default=float("-inf"))

    def recall(self, names: Iterable[str]) -> None:
        """These clients' wills are of before a restart: another hub may have published them meanwhile."""
        self._recalled = set(names)

    def may_have_published(self, name: str) -> bool:
        """Whether another hub may have published the will of ``name`` while this one was away."""
        return name in self._recalled

    def merge_again(self) -> None:
        """Compare with every other hub once more."""
        for name in self._wills.hubs:
            self._begin(name)
        self._hub.ask_again(merge=True)

    def publish(self, name: str) -> None:
        """Have the other hubs forget the will of ``name``, which is published next."""
        if self._session is not None and self._wills.met_others:
            self._session.put(wire.PUBLISHED, wire.encode(name), **wire.BLOCK)

    def replace(self, name: str, key: str) -> None:
        """A successor publishes the will of ``name``, on ``key``."""
        before = self._hub.store.get(key)
        if before is None or len(before.payload) > MAX_REPLACED_BYTES:
            return
        while len(self._replaced) >= MAX_REPLACED:
            del self._replaced[next(iter(self._replaced))]
        self._replaced[name] = before, time.monotonic() - self._hub.store.age_s(key)

    def on_alive(self, name: str) -> None:
        """A client is there: a will that was published for it in its absence is taken back."""
        self._recalled.discard(name)
        if (replaced := self._replaced.pop(name, None)) is None:
            return
        before, arrived = replaced
        now = self._hub.store.get(before.key)
        if now is not None and now.stamp.origin == name and not now.stamp.retained_count:
            self._hub.apply(before, max(0.0, time.monotonic() - arrived))
            self._hub.ask_again()

    # -- other hubs

    def _on_link(self, event: zenoh.TransportEvent) -> None:
        present, session, now = event.kind == zenoh.SampleKind.PUT, str(event.transport.zid), time.monotonic()
        self._wills.on_link(session, now, present=present)
        if event.transport.whatami == zenoh.WhatAmI.ROUTER:
            self._links.on_link(session, now, present=present)

    def _on_published(self, sample: zenoh.Sample) -> None:
        name = wire.decode_name(sample.payload.to_bytes())
        if name not in self._hub.alive_clients:  # else it is cut off from the hub that says so
            self._hub.forget_will(name)

    def _on_hub(self, sample: zenoh.Sample) -> None:
        name, under = _named(sample)
        names = self._names.setdefault(name, set())
        was_there = bool(names)
        (names.add if sample.kind == zenoh.SampleKind.PUT else names.discard)(under)
        if not names:
            del self._names[name]
            self._unmerged.pop(name, None)
        self._wills.on_hub(name, present=bool(names))
        if names and not was_there:
            self._unmerged[name] = time.monotonic() + PATIENCE_S
            self._begin(name)

    def _begin(self, name: str) -> None:
        if self._name < name and self._session is not None:
            asked = self._session, name
            threading.Thread(target=self._merge, args=asked, name="pebble-merge", daemon=True).start()

    # -- the one with the smaller name asks, on a thread of its own

    def _merge(self, session: zenoh.Session, name: str) -> None:
        for turn in range(ASKED):
            try:
                self._merge_once(session, name)
            except (zenoh.ZError, ValueError, msgspec.DecodeError, queue.Empty) as error:
                log.warning("hub %s: the merge with it failed, and is tried again: %s", name, str(error) or "no answer")
                time.sleep(_PAUSE_S * 3**turn)  # a second link to it has appeared meanwhile, or it is gone
            else:
                return
            if name not in self._names or session is not self._session:
                return  # it is gone

    def _merge_once(self, session: zenoh.Session, name: str) -> None:
        table = self._ask_table(session, name)
        if table is None:
            log.warning("hub %s does not merge: an older one, which publishes each will a second time", name)
        else:
            self._exchange(session, name, self._on_hub_thread(lambda: self._decide(table)))

    def _ask_table(self, session: zenoh.Session, name: str) -> merge.Table | None:
        """The parts of its table as one; None: it does not answer."""
        for _ in range(ASKED):
            answers = wire.ask(session, wire.MERGE + name, self._name.encode(), ASK_S)
            parts = [merge.decode_table(data) for data in answers]
            if parts:
                if parts.pop().rows:
                    raise ValueError("its table was cut off")
                rows = {key: row for part in parts for key, row in part.rows.items()}
                return replace(parts[0], rows=rows)
            time.sleep(_PAUSE_S)  # its queryable is not known here yet
        return None

    def _on_hub_thread(self, decide: Callable[[], _Decided]) -> _Decided:
        decided: queue.Queue[_Decided] = queue.Queue()
        self._hub.post(lambda: decided.put(decide()))
        return decided.get(timeout=ASK_S)

    def _decide(self, theirs: merge.Table) -> _Decided:
        store = self._hub.store
        mine, alive = store.table(), self._hub.alive_clients | set(theirs.alive)
        want, give = merge.compare(mine, theirs.rows, alive)
        store.know(merge.known_ages(mine, theirs.rows))
        return _Decided(
            want,
            sorted(store.values(give), key=_size),  # a large one holds up no small one
            merge.known_ages(theirs.rows, mine),
            merge.published(theirs.recalled, mine, store.wills()),
            merge.published(self._recalled_keys(), theirs.rows, theirs.wills),
            time.monotonic(),
        )

    def _exchange(self, session: zenoh.Session, name: str, decided: _Decided) -> None:
        ages = list(decided.ages.items())
        parts: list[tuple[list[merge.Value], dict[str, float]]]
        parts = [(part, {}) for part in merge.in_parts(iter(decided.give))]
        parts += [([], dict(ages[at : at + merge.MAX_ROWS])) for at in range(0, len(ages), merge.MAX_ROWS)]
        got: list[merge.Value] = []
        for number, (values, some) in enumerate(parts, 1):
            last, waited = number == len(parts), time.monotonic() - decided.at
            give = [replace(one, age_s=one.age_s + waited) for one in values]
            older = {key: age_s + waited for key, age_s in some.items()}
            want, forget = (decided.want, decided.they_forget) if last else ([], None)
            asked = merge.encode(merge.Exchange(self._name, want, give, older, forget))
            answers = [merge.decode_values(data) for data in wire.ask(session, wire.MERGE + name, asked, VALUES_S)]
            if not answers or answers.pop():
                raise ValueError("its answer was cut off")
            got += chain.from_iterable(answers)
        self._hub.post(lambda: self._adopt(name, self._take(got, decided.at), decided.we_forget, len(decided.give)))

    # -- on the hub's thread

    def _on_merge(self, query: zenoh.Query) -> None:
        """Each answer ends with an empty part, so that one that is cut off shows."""
        with query:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            key = str(query.key_expr)
            if len(payload) <= _LONGEST_NAME:
                if (asker := payload.decode()) in self._names:
                    self._compared[asker] = time.monotonic()
                for part in (*self._table(), merge.Table({}, [], [], {})):
                    query.reply(key, merge.encode(part))
                return
            asked = merge.decode_exchange(payload)
            for values in merge.in_parts(iter(sorted(self._hub.store.values(asked.want), key=_size))):
                if values:
                    query.reply(key, merge.encode(values))
            query.reply(key, merge.encode([]))
        if (since := self._compared.get(asked.asker)) is None:
            raise ValueError(f"hub {asked.asker} has not asked for the table")
        self._hub.store.know(asked.ages)
        self._taken[asked.asker] = self._taken.get(asked.asker, 0) + self._take(asked.give, since)
        if asked.forget is not None:
            del self._compared[asked.asker]
            self._adopt(asked.asker, self._taken.pop(asked.asker), asked.forget, len(asked.want))

    def _table(self) -> Iterator[merge.Table]:
        rows = list(self._hub.store.table().items())
        first = sorted(self._hub.alive_clients), sorted(self._hub.store.wills()), self._recalled_keys()
        for at in range(0, max(1, len(rows)), merge.MAX_ROWS):
            part = dict(rows[at : at + merge.MAX_ROWS])
            yield merge.Table(part, [], [], {}) if at else merge.Table(part, *first)

    def _recalled_keys(self) -> dict[str, str]:
        wills = {name: self._hub.store.will(name) for name in self._recalled - self._hub.alive_clients}
        return {name: topic_to_key(will.topic) for name, will in wills.items() if will is not None}

    def _adopt(self, name: str, taken: int, forget: Collection[str], gave: int) -> None:
        self._recalled -= self._hub.alive_clients
        self._recalled &= self._hub.store.wills()
        for client in self._recalled.intersection(forget):
            self._hub.forget_will(client)
        self._recalled -= set(forget)
        self._wills.on_other_hub(self._recalled, time.monotonic())
        self._unmerged.pop(name, None)
        self.merges += 1
        log.info("merged with hub %s: took %d retained messages, gave %d", name, taken, gave)
        if taken:
            self._hub.ask_again()

    def _take(self, values: Iterable[merge.Value], since: float) -> int:
        """Store what was asked for at ``since``, but where something has come meanwhile, or its age became known."""
        taken, waited = 0, time.monotonic() - since
        for one in values:
            mine, theirs = self._hub.store.row(one.key), merge.row_of(one)
            if not merge.is_overtaken(mine, waited) and merge.is_newer(theirs, mine, ()):
                stamp = wire.Stamp(one.qos, one.retained_count, one.origin)
                taken += self._hub.apply(Retained(one.key, one.payload, stamp), one.age_s)
        return taken

    def _on_state(self, query: zenoh.Query) -> None:
        with query:
            store, hub = self._hub.store, self._hub
            clients = hub.alive_clients - self._wills.hubs - {self._name}
            counts = len(clients), len(store.wills()), len(store.retained())
            state = HubState(self._name, sorted(self._wills.hubs), *counts, self.merges, len(self._links.routers))
            query.reply(str(query.key_expr), merge.encode(state))


class HubState(msgspec.Struct, frozen=True):
    """What a hub tells people of itself. ``hubs``: the others that it sees; ``links``: those it has a connection to."""

    name: str
    hubs: list[str]
    clients: int
    wills: int
    retained: int
    merges: int
    links: int = 0


decode_state = msgspec.msgpack.Decoder(HubState).decode


def _named(token: zenoh.Sample) -> tuple[str, str]:
    """The hub that a token is of, and the name under which it is there."""
    under = str(token.key_expr).removeprefix(wire.UP)
    return under.partition(wire.RENEWAL)[0], under


def _size(value: merge.Value) -> int:
    return len(value.payload)
