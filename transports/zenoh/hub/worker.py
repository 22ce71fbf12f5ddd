"""The thread of a hub: it stores what is retained, publishes wills, and answers clients and other hubs."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
import zenoh

from pebble.transports import clock
from pebble.transports.base import QoS
from pebble.transports.counters import Counters
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.hub.admission import Admission
from pebble.transports.zenoh.hub.intake import Intake
from pebble.transports.zenoh.hub.journal import Journal
from pebble.transports.zenoh.hub.mesh import Mesh
from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill
from pebble.transports.zenoh.hub.store import HubStore
from pebble.transports.zenoh.hub.turns import Task
from pebble.transports.zenoh.hub.waiting import WaitingQueries
from pebble.transports.zenoh.hub.wills import STILL_S, WillTimes
from pebble.transports.zenoh.keymap import topic_to_key

log = logging.getLogger(__name__)

_SENT_S = 0.1  # a will has left by then; what a session that is closed has to send reaches some and not others
_LOOK_S = 0.25  # a hub among others looks so often whether it stood still

_NEVER = float("inf")


class HubWorker:
    """One thread and one queue for all messages and queries of the hub, so that the order of arrival decides (T8)."""

    def __init__(
        self, name: str, store: HubStore, admission: Admission, journal: Journal | None, counters: Counters
    ) -> None:
        self._store, self._journal, self._counters, self._admission = store, journal, counters, admission
        self._recalled = False  # the records of the journal
        self.alive_clients: set[str] = set()
        self._wills = WillTimes(name)
        self._mesh = Mesh(name, self, self._wills)
        self._token = _Token(name)
        self._waiting, self._intake = WaitingQueries(), Intake()
        self._session: zenoh.Session | None = None
        self._pause_of_wills = _PauseOfWills()
        self._thread = threading.Thread(target=self._run, name="pebble-hub", daemon=True)
        if journal is not None:
            self._write_journal(journal)

    @property
    def store(self) -> HubStore:
        return self._store

    def serve(self, session: zenoh.Session) -> None:
        """Serve the clients of ``session`` instead of those of the one before, which is closed."""
        if self._session is not None:
            self.post(self._await_return)
        self._session = session
        self._pause_of_wills.end()
        # Its own messages would wait for room in the queue that this thread empties.
        others, retain = zenoh.Locality.REMOTE, direct(partial(self._intake.retain, self._store_retained))
        session.declare_subscriber(wire.RETAINED + "**", retain, allowed_origin=others)
        session.declare_queryable(wire.RETAINED + "**", direct(partial(self._intake.ask, self._query)), complete=True)
        for what, work in ((wire.HELLO, self._on_hello), (wire.BYE, self._on_bye)):
            session.declare_queryable(what, self._queued(work))
            session.declare_queryable(f"{what}/*", direct(partial(self._intake.greet, work)))
        come = direct(partial(self._intake.come, self._on_client))
        session.liveliness().declare_subscriber(wire.LIVE + "*", come, history=True)
        if self._store.has_history:
            self._mesh.serve(session, self._queued)
        self._token.declare(session)
        if not self._thread.is_alive():
            self._thread.start()

    @property
    def has_met_others(self) -> bool:
        return self._wills.met_others

    def is_cut(self) -> bool:
        """Whether another hub is not seen, and a new session would mend it."""
        return self._mesh.is_cut()

    def hold_wills(self) -> None:
        """Publish no will before the next session: hubs that did not get it of this one would publish it, too."""
        self._pause_of_wills.begin()

    def close(self) -> None:
        if self._thread.is_alive():
            self._intake.end()
            self._thread.join(5)
        self._waiting.drop()
        if self._journal is not None:
            self._journal.close()

    # -- the thread

    def _queued(self, work: Callable[[Any], None]) -> zenoh.handlers.Callback[Any]:
        return direct(lambda event: self.post(lambda: work(event)))

    def post(self, task: Task) -> None:
        """Do ``task`` on the hub's thread."""
        self._intake.put(task)

    def _run(self) -> None:
        turn = clock.since_boot()
        while True:
            if (task := self._intake.take(self._pause())) is None:
                return
            before, turn = turn, clock.since_boot()
            if self._wills.met_others and turn - before > _LOOK_S + STILL_S:
                self._wills.on_standstill(time.monotonic())
                self._mesh.on_standstill()
            self._do(task)
            self._answer_waiting()
            self._publish_due_wills()
            if self._journal is not None and self._journal.rewrite_due:
                self._do(partial(self._write_journal, self._journal))

    def _do(self, task: Task) -> None:
        try:
            task()
        # What another program or a lost connection can cause:
        except (ValueError, msgspec.DecodeError, zenoh.ZError) as error:
            self._counters.add("bad")
            bad = self._counters["bad"]
            if bad & (bad - 1) == 0:  # the 1st, 2nd, 4th, 8th…
                log.warning("the hub received something it does not understand: %s (%d so far)", error, bad)
        except Exception:  # no client may end the hub
            log.exception("the hub failed on one of its tasks")

    def _pause(self) -> float | None:
        now = time.monotonic()
        pauses = [_NEVER if self._pause_of_wills.is_on else self._wills.next_due - now]
        pauses.append(self._waiting.due(self._mesh.merging_until) - now)
        if self._journal is not None:
            pauses.append(self._journal.wait_s)
        if self._wills.met_others:
            pauses.append(_LOOK_S)
        pause = max(0.0, min(pauses))
        return None if pause == _NEVER else pause

    # -- retained messages

    def _store_retained(self, sample: zenoh.Sample) -> None:
        if sample.attachment is None or "*" in str(sample.key_expr):
            raise ValueError(f"{sample.key_expr} has no stamp, or is no single key")
        stamp = wire.Stamp.unpack(sample.attachment.to_bytes())
        self.apply(Retained(str(sample.key_expr).removeprefix(wire.RETAINED), sample.payload.to_bytes(), stamp))
        self._wills.on_message(stamp.origin, time.monotonic())
        self._waiting.received(stamp.origin, stamp.retained_count)

    def _query(self, query: zenoh.Query) -> None:
        """Queue a subscriber's query, which names the messages that the answer must include."""
        try:
            needs = wire.decode_counts(_payload(query))
        except (ValueError, msgspec.DecodeError):
            query.drop()  # type: ignore[no-untyped-call]
            self._intake.answered()
            raise
        now = time.monotonic()
        if not self._waiting.add(needs, query, now, merging=now < self._mesh.merging_until):
            self._answer(query)

    def _answer_waiting(self) -> None:
        now = time.monotonic()
        if now >= self._mesh.merging_until:
            for query in self._waiting.take(now):
                self._intake.in_turn(self._answer, query)

    def _answer(self, query: zenoh.Query) -> None:
        self._intake.answered()
        with query:
            for retained in self._selected(query.key_expr):
                query.reply(wire.RETAINED + retained.key, retained.payload, attachment=retained.stamp.pack())

    def _selected(self, wanted: zenoh.KeyExpr) -> list[Retained]:
        text = str(wanted)
        if "*" not in text:
            retained = self._store.get(text.removeprefix(wire.RETAINED))
            return [] if retained is None else [retained]
        begin = text.partition("*")[0].rstrip("$/")  # of all of a fleet's it sorts most out soon
        every = ((wire.RETAINED + retained.key, retained) for retained in self._store.retained())
        return [retained for key, retained in every if key.startswith(begin) and wanted.intersects(key)]

    # -- clients

    def _on_hello(self, query: zenoh.Query) -> None:
        with query:
            account = wire.account_of(str(query.key_expr), wire.HELLO)
            admitted = self._admission.hello(account, wire.decode_hello(_payload(query)), self._store.wills())
            if admitted is None:
                return
            hello = admitted
            now = time.monotonic()
            alive, has_will = hello.name in self.alive_clients, hello.will is not None
            self._wills.on_hello(hello.name, hello.session, now, alive=alive, has_will=has_will)
            if self._wills.ends_predecessors(hello.name, hello.session, now):
                self._end_predecessor(hello)
            self.apply(StoredWill(hello.name, hello.will))
            lacking = self._store.lacks(hello)
            if lacking:
                self._waiting.forget(hello.name)
            elif not account:  # no subscriber waits for what other machines retain
                self._waiting.count_from(hello.name, hello.retained_count)
            query.reply(wire.asked(wire.HELLO, account), wire.encode(lacking))

    def _end_predecessor(self, hello: wire.Hello) -> None:
        """Publish the pending will of a restarted client's former session now, unless it has published there since.

        One of before a restart waits, as another hub may have published it.
        """
        if hello.will is None:
            return
        for name in self._store.wills() - {hello.name}:
            will = self._store.will(name)
            if will is None or (self._store.has_history and self._mesh.may_have_published(name)):
                continue
            if will.client == hello.will.client:
                self._mesh.publish(name)
                self.forget_will(name)
                if topic_to_key(will.topic) not in hello.own:
                    self._publish_will(name, will)

    def _on_bye(self, query: zenoh.Query) -> None:
        with query:
            account = wire.account_of(str(query.key_expr), wire.BYE)
            name = wire.decode_name(_payload(query))
            if self._admission.owns(account, name):
                self.forget_will(name)
                query.reply(wire.asked(wire.BYE, account), b"")

    def _on_client(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).removeprefix(wire.LIVE)
        if sample.kind == zenoh.SampleKind.PUT:
            if self._admission.sessions(name, self.alive_clients):
                self.alive_clients.add(name)
            self._wills.on_alive(name)
            self._mesh.on_alive(name)
            return
        self.alive_clients.discard(name)
        self._waiting.forget(name)
        if self._store.will(name) is not None:
            self._wills.on_gone(name, time.monotonic())

    def _publish_due_wills(self) -> None:
        pause = self._pause_of_wills
        with pause.lock:
            for name, is_successor in () if pause.is_on else self._wills.take_due(time.monotonic()):
                if (will := self._store.will(name)) is not None:
                    pause.published_at = time.monotonic()
                    self._do(partial(self._publish_due_will, name, will, is_successor=is_successor))

    def _publish_due_will(self, name: str, will: wire.Will, *, is_successor: bool) -> None:
        try:
            self._mesh.publish(name)
        except zenoh.ZError:  # this session is being replaced by another one
            self._wills.on_restart([name], time.monotonic())
            raise
        overtaken = self._is_overtaken(name, will)
        if is_successor and will.retain and self._wills.met_others and not overtaken:
            self._mesh.replace(name, topic_to_key(will.topic))
        self.forget_will(name)
        if not overtaken:
            self._publish_will(name, will)

    def _is_overtaken(self, name: str, will: wire.Will) -> bool:
        """Whether the client has begun anew since, and published where its will would come."""
        now = self._store.get(topic_to_key(will.topic))
        later = None if now is None or now.stamp.origin == name else self._store.will(now.stamp.origin)
        return later is not None and later.client == will.client

    def forget_will(self, name: str) -> None:
        """The client ``name`` has no will any more."""
        self._wills.forget(name)
        self.apply(StoredWill(name, None))

    def _publish_will(self, name: str, will: wire.Will) -> None:
        key, qos = topic_to_key(will.topic), QoS(will.qos)
        stamp = wire.Stamp(qos, 0, name)
        if will.retain:
            self.apply(Retained(key, will.payload, stamp))
        if self._session is not None and will.retain and self._wills.met_others:
            self._session.put(wire.RETAINED + key, will.payload, attachment=stamp.pack(), **wire.BLOCK)
        if self._session is not None:
            self._session.put(
                key, will.payload, attachment=wire.pack_live(qos, retain_requested=will.retain), **wire.BLOCK
            )
        self._counters.add("wills")

    # -- store and journal

    def apply(self, record: Record, age_s: float = 0.0) -> bool:
        """Store what is admitted of ``record``; returns whether that changed anything."""
        admitted = self._admission.admitted(record)
        changed = admitted is not None and self._store.apply(admitted, age_s)
        if changed and self._journal is not None:
            self._journal.append(wire.encode(admitted))
        return changed

    def ask_again(self, *, merge: bool = False) -> None:
        """Have all clients ask what is retained here, as if a hub had just come; see :meth:`_Token.renew`."""
        self._token.renew(merge=merge)

    def _write_journal(self, journal: Journal) -> None:
        """Write all records anew, together with those of an earlier hub: these are read once, as soon as they can be.

        Never before: the file would be lost.
        """
        if journal.appeared:
            self._recalled = False
        self._recalled = self._recalled or self._recall(journal)
        if self._recalled:
            journal.rewrite(map(wire.encode, self._store.records()))

    def _recall(self, journal: Journal) -> bool:
        loaded = journal.load()
        if loaded is None:
            return False
        earlier, decode = self._store.empty(), msgspec.msgpack.Decoder(Record).decode
        for data in loaded:
            try:
                if (record := self._admission.admitted(decode(data))) is not None:
                    earlier.apply(record, _NEVER)
            except msgspec.DecodeError as error:
                log.warning("journal %s has a record of another kind: %s", journal.path, error)
        earlier.take_over(self._store)
        self._store = earlier
        self._await_wills()
        return True

    def _await_return(self) -> None:
        """Clients of a session that was closed have as long to come back as after a restart."""
        self._wills.on_new_session()
        self.alive_clients.clear()
        self._waiting.forget_all()
        self._await_wills()

    def _await_wills(self) -> None:
        absent = self._store.wills() - self.alive_clients
        self._wills.on_restart(absent, time.monotonic())
        self._mesh.recall(absent)
        if self._wills.hubs:  # a journal that could be read late
            self._mesh.merge_again()


class _Token:
    """Clients ask a hub what is retained there as soon as its token appears: its name, or a further one of it."""

    def __init__(self, name: str) -> None:
        self._name, self._renewals = name, 0
        self._session: zenoh.Session | None = None
        self._token: zenoh.LivelinessToken | None = None

    def declare(self, session: zenoh.Session) -> None:
        self._session = session
        self._token = session.liveliness().declare_token(wire.UP + self._name)

    def renew(self, *, merge: bool) -> None:
        """Take a further name, which is there before the old one goes: no client is without a hub for a moment.

        ``merge``: the old one goes first, so that other hubs compare with this one again.
        """
        session, before = self._session, self._token
        if session is None or before is None:
            return
        if merge:
            before.undeclare()  # type: ignore[no-untyped-call]
        self._renewals += 1
        name = f"{self._name}{wire.RENEWAL}{self._renewals}"
        session.declare_queryable(wire.SYNC + name, direct(partial(_answer_nothing, wire.SYNC + name)))
        self._token = session.liveliness().declare_token(wire.UP + name)
        if not merge:
            before.undeclare()  # type: ignore[no-untyped-call]


class _PauseOfWills:
    """No will is published between two sessions."""

    def __init__(self) -> None:
        self.lock = threading.Lock()  # while wills are published
        self.is_on = False
        self.published_at = float("-inf")  # the last one

    def begin(self) -> None:
        with self.lock:
            self.is_on = True
        time.sleep(max(0.0, self.published_at + _SENT_S - time.monotonic()))

    def end(self) -> None:
        self.is_on = False


def _answer_nothing(key: str, query: zenoh.Query) -> None:
    """A hub has sent no retained messages of its own."""
    with query:
        query.reply(key, wire.pack_count(0))


def _payload(query: zenoh.Query) -> bytes:
    if query.payload is None:
        raise ValueError(f"{query.key_expr} without payload")
    return query.payload.to_bytes()
