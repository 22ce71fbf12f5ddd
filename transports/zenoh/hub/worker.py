"""The thread of a hub: it stores retained messages, publishes wills, and answers clients."""

from __future__ import annotations

import logging
import threading
import time
from functools import partial
from typing import TYPE_CHECKING

import msgspec
import zenoh

from pebble.transports.base import QoS
from pebble.transports.counters import Counters
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.hub.admission import Admission
from pebble.transports.zenoh.hub.intake import Intake, Task
from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill
from pebble.transports.zenoh.hub.store import HubStore
from pebble.transports.zenoh.hub.waiting import WaitingQueries
from pebble.transports.zenoh.hub.wills import WillTimes
from pebble.transports.zenoh.keymap import topic_to_key

if TYPE_CHECKING:
    from pebble.transports.zenoh.hub.journal import Journal

log = logging.getLogger(__name__)

_NEVER = float("inf")


class HubWorker:
    """The thread and queue for all messages and queries of a hub, so that their order of arrival decides (T8)."""

    def __init__(
        self, name: str, store: HubStore, admission: Admission, journal: Journal | None, counters: Counters
    ) -> None:
        self._store, self._journal, self._counters, self._admission = store, journal, counters, admission
        self.alive_clients: set[str] = set()  # names of their sessions
        self._name, self._wills = name, WillTimes()
        self._has_met = False  # another hub; it was logged
        self._token: zenoh.LivelinessToken | None = None  # shows that this hub is up
        self._waiting, self._intake = WaitingQueries(), Intake()
        self._session: zenoh.Session | None = None
        self._thread = threading.Thread(target=self._run, name="pebble-hub", daemon=True)
        if journal is not None:
            self._recall(journal)

    def serve(self, session: zenoh.Session) -> None:
        """Serve the clients of ``session``, in place of the former session, which is closed."""
        if self._session is not None:
            self.post(self._await_return)  # its clients get time to return before their wills are published
        self._session = session
        # REMOTE: a message of the hub's own would wait for room in the queue on the thread that empties the queue.
        retain = direct(lambda sample: self._intake.receive(partial(self._store_retained, sample), len(sample.payload)))
        session.declare_subscriber(wire.RETAINED + "**", retain, allowed_origin=zenoh.Locality.REMOTE)
        session.declare_queryable(wire.RETAINED + "**", direct(partial(self._intake.ask, self._query)), complete=True)
        for what, work in ((wire.HELLO, self._on_hello), (wire.BYE, self._on_bye)):
            for key in (what, f"{what}/*"):  # without an account, and with one
                session.declare_queryable(key, direct(partial(self._intake.greet, work)))
        note_client = direct(lambda sample: self.post(partial(self._on_client, sample)))
        session.liveliness().declare_subscriber(wire.LIVE + "*", note_client, history=True)
        session.liveliness().declare_subscriber(wire.UP + "*", direct(self._on_hub), history=True)
        self._token = session.liveliness().declare_token(wire.UP + self._name)
        if not self._thread.is_alive():
            self._thread.start()

    def close(self) -> None:
        if self._thread.is_alive():
            self._intake.end()
            self._thread.join(5)
        self._waiting.drop()
        if self._journal is not None:
            self._journal.close()

    # -- the thread

    def post(self, task: Task) -> None:
        """Run ``task`` on the hub's thread."""
        self._intake.put(task)

    def _run(self) -> None:
        while True:
            if (task := self._intake.take(self._pause())) is None:
                return
            self._do(task)
            for query in self._waiting.take(time.monotonic()):  # nothing is missing for them, or they wait no longer
                self._intake.ask(self._answer, query)
            self._publish_due_wills()
            if self._journal is not None and time.monotonic() >= self._journal.rewrite_at:
                self._write_journal(self._journal)

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
        again = _NEVER if self._journal is None else self._journal.rewrite_at
        due = min(self._wills.next_due, self._waiting.due(), again)
        return None if due == _NEVER else max(0.0, due - time.monotonic())

    # -- retained messages

    def _store_retained(self, sample: zenoh.Sample) -> None:
        if sample.attachment is None or "*" in str(sample.key_expr):
            raise ValueError(f"{sample.key_expr} has no stamp, or is no single key")
        stamp = wire.Stamp.unpack(sample.attachment.to_bytes())
        self.apply(Retained(str(sample.key_expr).removeprefix(wire.RETAINED), sample.payload.to_bytes(), stamp))
        self._waiting.received(stamp.origin, stamp.retained_count)

    def _query(self, query: zenoh.Query) -> None:
        """Answer a subscriber's query, at once or when as many messages of each client have come as it names."""
        try:
            needs = wire.decode_counts(_payload(query))
        except (ValueError, msgspec.DecodeError):
            query.drop()  # type: ignore[no-untyped-call]  # it ends without an answer
            raise
        if not self._waiting.add(needs, query, time.monotonic()):  # it need not wait, or finds no room
            self._answer(query)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            for retained in self._selected(query.key_expr):
                query.reply(wire.RETAINED + retained.key, retained.payload, attachment=retained.stamp.pack())

    def _selected(self, wanted: zenoh.KeyExpr) -> list[Retained]:
        """Return the stored messages whose keys, under `wire.RETAINED`, a query asks for."""
        text = str(wanted)
        if "*" not in text:
            retained = self._store.get(text.removeprefix(wire.RETAINED))
            return [] if retained is None else [retained]
        begin = text.partition("*")[0].rstrip("$/")  # of all matches: no $ of "$*"; no /, as "a/**" matches "a"
        keyed = ((wire.RETAINED + retained.key, retained) for retained in self._store.retained())
        return [retained for key, retained in keyed if key.startswith(begin) and wanted.intersects(key)]

    # -- clients

    def _on_hello(self, query: zenoh.Query) -> None:  # a client tells its will, and digests of what it retains
        with query:
            account = wire.account_of(str(query.key_expr), wire.HELLO)
            hello = self._admission.hello(account, wire.decode_hello(_payload(query)))
            if hello is None:  # the hub must not answer
                return
            alive, has_will = hello.name in self.alive_clients, hello.will is not None
            self._wills.on_hello(hello.name, time.monotonic(), alive=alive, has_will=has_will)
            self._end_predecessor(hello)
            self.apply(StoredWill(hello.name, hello.will))
            lacking = self._store.lacks(hello)
            if lacking:
                self._waiting.forget(hello.name)  # not all is here: the client sends these, and then another hello
            elif not account:  # no subscriber waits for what other machines retain
                self._waiting.count_from(hello.name, hello.retained_count)
            query.reply(wire.asked(wire.HELLO, account), wire.encode(lacking))

    def _end_predecessor(self, hello: wire.Hello) -> None:
        """Publish the will that a client left before its restart, unless the client retains a value on that topic."""
        if hello.will is None:
            return
        for name in self._store.wills() - {hello.name}:
            will = self._store.will(name)
            if will is not None and will.client == hello.will.client:
                self.forget_will(name)
                if topic_to_key(will.topic) not in hello.own:  # else the client retains a value there, or removed it
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
            self.alive_clients.add(name)
            self._wills.forget(name)
            return
        self.alive_clients.discard(name)
        self._waiting.forget(name)
        if self._store.will(name) is not None:
            self._wills.on_gone(name, time.monotonic())

    def _on_hub(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and str(sample.key_expr) != wire.UP + self._name and not self._has_met:
            self._has_met = True
            log.warning(
                "another hub is connected to this one: each publishes the will of a client that is gone, and what they "
                "retain apart stays apart; connect plain Zenoh routers to a hub, or use one hub"
            )

    def _publish_due_wills(self) -> None:
        for name in self._wills.take_due(time.monotonic()):
            if (will := self._store.will(name)) is not None:
                self.forget_will(name)
                self._do(partial(self._publish_will, name, will))

    def forget_will(self, name: str) -> None:
        """Forget the will of the client ``name``."""
        self._wills.forget(name)
        self.apply(StoredWill(name, None))

    def _publish_will(self, name: str, will: wire.Will) -> None:
        key, qos = topic_to_key(will.topic), QoS(will.qos)
        stamp = wire.Stamp(qos, 0, name)  # 0: the hub made it
        if will.retain:
            self.apply(Retained(key, will.payload, stamp))
        if self._session is not None:
            self._session.put(
                key, will.payload, attachment=wire.pack_live(qos, retain_requested=will.retain), **wire.BLOCK
            )
        self._counters.add("wills")

    # -- store and journal

    def apply(self, record: Record) -> None:
        """Store the admitted part of ``record``."""
        admitted = self._admission.admitted(record)
        if admitted is not None and self._store.apply(admitted) and self._journal is not None:
            self._journal.put(admitted.id, None if admitted.is_removal else wire.encode(admitted))

    def _recall(self, journal: Journal) -> None:
        """Store the records of an earlier hub, as far as the present rules admit them."""
        decode = msgspec.msgpack.Decoder(Record).decode
        for data in journal.load():
            try:
                if (record := self._admission.admitted(decode(data))) is not None:
                    self._store.apply(record)
            except msgspec.DecodeError as error:
                log.warning("journal %s has a record of another kind: %s", journal.path, error)
        self._write_journal(journal)  # without what was replaced, or is not admitted any more
        self._await_wills()  # of clients that do not come back

    def _write_journal(self, journal: Journal) -> None:
        journal.rewrite((record.id, wire.encode(record)) for record in self._store.records())

    def _await_return(self) -> None:
        """Give the clients of a closed session time to come back, as after a restart."""
        self.alive_clients.clear()
        self._waiting.forget_all()
        self._await_wills()

    def _await_wills(self) -> None:
        self._wills.on_restart(self._store.wills() - self.alive_clients, time.monotonic())


def _payload(query: zenoh.Query) -> bytes:
    if query.payload is None:
        raise ValueError(f"{query.key_expr} without payload")
    return query.payload.to_bytes()
