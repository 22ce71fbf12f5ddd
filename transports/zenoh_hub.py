"""The hub: the one process of a robot that introduces the others to each other and remembers for them.

It keeps the newest message of every kept topic, and the wills of living clients. Live messages between the robot's
processes do not pass it. ``python -m pebble.transports.zenoh_hub RUN_DIR [--journal FILE] [--lease-ms N]``
"""

from __future__ import annotations

import logging
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from pebble.errors import PebbleError, TransportError
from pebble.transports import zenoh_wire as wire
from pebble.transports.base import QoS
from pebble.transports.counters import Counters
from pebble.transports.journal import Journal
from pebble.transports.kept_store import Kept, KeptStore, Parked, Record
from pebble.transports.keymap import topic_to_key
from pebble.transports.roster import Lock, Roster, new_name, prepare_run_dir
from pebble.transports.settings import ZenohSettings
from pebble.transports.zenoh_barrier import Barrier
from pebble.transports.zenoh_session import HUB_SOCKET, close_at_exit, open_session, session_config

log = logging.getLogger(__name__)

QUEUE_LIMIT = 10_000  # events waiting for the hub's thread; more make their senders wait
WILL_DELAY_S = 0.1  # a dead client's last messages overtake its will only if they need longer than this
RETURN_S = 2.5  # after a restart clients have this long to come back before their wills are spoken
PATIENCE_S = 0.5  # a subscriber's question waits this long for kept messages known to be on their way

_Task = Callable[[], None]


class ZenohHub:
    """Opens at once, works on threads of its own, and leaves nothing behind when closed."""

    def __init__(self, settings: ZenohSettings) -> None:
        self.name = new_name()
        self.counters = Counters()
        self._settings = settings
        self._lock: Lock | None = None
        self._session: zenoh.Session | None = None
        self._clerk: Clerk | None = None

    def open(self) -> ZenohHub:
        """Raises TransportError if this robot has a hub already, or the run directory or journal cannot be used."""
        run_dir = self._settings.run_dir
        prepare_run_dir(run_dir)
        self._lock = Lock.take(run_dir / "hub.lock")
        if self._lock is None:
            raise TransportError(f"there is a hub for {run_dir} already (it holds {run_dir / 'hub.lock'})")
        try:
            self._start(run_dir)
        except BaseException:
            self.close()
            raise
        close_at_exit(self)
        return self

    def close(self) -> None:
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]  # no new event from here on
        if self._clerk is not None:
            self._clerk.close()
        if self._lock is not None:
            for left in (HUB_SOCKET, HUB_SOCKET + ".lock"):
                (self._settings.run_dir / left).unlink(missing_ok=True)
            self._lock.release()
        self._session = self._clerk = self._lock = None

    def _start(self, run_dir: Path) -> None:
        journal = None if self._settings.journal is None else Journal(self._settings.journal)
        siblings = Roster(run_dir).sockets()  # they would find us within 0.5 s; we find them at once
        self._clerk = Clerk(self.name, journal, self.counters)
        try:
            config = session_config(self._settings, "router", listen=[run_dir / HUB_SOCKET], connect=siblings)
            self._session = open_session(config)
        except zenoh.ZError as error:
            raise TransportError(f"the hub cannot open {run_dir / HUB_SOCKET}: {error}") from None
        Barrier(self._session, self.name, lambda: 0)
        self._clerk.serve(self._session)
        self._token = self._session.liveliness().declare_token(wire.UP + self.name)


class Clerk:
    """One thread and one queue for everything the hub is told and asked, so that arrival is the order (T8)."""

    def __init__(self, name: str, journal: Journal | None, counters: Counters) -> None:
        self._name, self._journal, self._counters = name, journal, counters
        self._store = KeptStore()
        self._heard: dict[str, int] = {}  # how many messages to be kept have arrived, by client that said hello
        self._living: set[str] = set()
        self._dying: dict[str, float] = {}  # when to speak a will
        self._waiting: list[tuple[float, dict[str, int], zenoh.Query]] = []
        self._tasks: queue.Queue[_Task | None] = queue.Queue(QUEUE_LIMIT)
        self._session: zenoh.Session | None = None
        self._thread = threading.Thread(target=self._run, name="pebble-hub", daemon=True)
        if journal is not None:
            self._recall(journal)

    def serve(self, session: zenoh.Session) -> None:
        self._session = session
        session.declare_subscriber(wire.KEPT + "**", self._inbox(self._keep))
        session.declare_queryable(wire.KEPT + "**", self._inbox(self._asked), complete=True)
        session.declare_queryable(wire.HELLO, self._inbox(self._hello))
        session.declare_queryable(wire.BYE, self._inbox(self._bye))
        session.liveliness().declare_subscriber(wire.LIVE + "*", self._inbox(self._client), history=True)
        self._thread.start()

    def close(self) -> None:
        if self._thread.is_alive():
            self._tasks.put(None)
            self._thread.join(5)
        for _, _, query in self._waiting:
            query.drop()  # type: ignore[no-untyped-call]
        self._waiting.clear()
        if self._journal is not None:
            self._journal.close()

    # -- the thread

    def _inbox(self, work: Callable[[Any], None]) -> zenoh.handlers.Callback[Any]:
        return zenoh.handlers.Callback(lambda event: self._tasks.put(lambda: work(event)), indirect=False)

    def _run(self) -> None:
        while True:
            try:
                task = self._tasks.get(timeout=self._pause())
                if task is None:
                    return
                self._do(task)
            except queue.Empty:
                pass
            self._answer_waiting()
            self._speak_due()

    def _do(self, task: _Task) -> None:
        try:
            task()
        except (ValueError, msgspec.DecodeError, zenoh.ZError) as error:  # what a stranger or a dying link can cause
            self._counters.add("bad")
            log.warning("the hub was told something it does not understand: %s", error)
        except Exception:  # nothing a client does may end the hub
            log.exception("the hub failed on one of its tasks")

    def _pause(self) -> float | None:
        deadlines = [*self._dying.values(), *(until for until, _, _ in self._waiting)]
        return max(0.0, min(deadlines) - time.monotonic()) if deadlines else None

    # -- kept copies

    def _keep(self, sample: zenoh.Sample) -> None:
        if sample.attachment is None:
            raise ValueError(f"{sample.key_expr} has no stamp")
        stamp = wire.Stamp.unpack(sample.attachment.to_bytes())
        self._apply(Kept(str(sample.key_expr).removeprefix(wire.KEPT), sample.payload.to_bytes(), stamp))
        if stamp.number and stamp.origin in self._heard:
            self._heard[stamp.origin] = max(stamp.number, self._heard[stamp.origin])

    def _asked(self, query: zenoh.Query) -> None:
        """A subscriber wants its kept copies, and says which messages it must not miss."""
        try:
            needs = wire.decode_numbers(_payload(query))
        except (ValueError, msgspec.DecodeError):
            query.drop()  # type: ignore[no-untyped-call]
            raise
        self._waiting.append((time.monotonic() + PATIENCE_S, needs, query))

    def _answer_waiting(self) -> None:
        if not self._waiting:
            return
        now = time.monotonic()
        waiting, self._waiting = self._waiting, []
        for until, needs, query in waiting:
            if now >= until or all(self._heard.get(name, -1) >= number for name, number in needs.items()):
                self._do(lambda query=query: self._answer(query))  # type: ignore[misc]
            else:
                self._waiting.append((until, needs, query))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            for kept in self._selected(query.key_expr):
                query.reply(wire.KEPT + kept.key, kept.payload, attachment=kept.stamp.pack())

    def _selected(self, wanted: zenoh.KeyExpr) -> list[Kept]:
        text = str(wanted)
        if "*" not in text:
            kept = self._store.get(text.removeprefix(wire.KEPT))
            return [] if kept is None else [kept]
        return [kept for kept in self._store.kept() if wanted.intersects(wire.KEPT + kept.key)]

    # -- clients

    def _hello(self, query: zenoh.Query) -> None:
        with query:
            hello = wire.decode_hello(_payload(query))
            self._take_over(hello)
            self._apply(Parked(hello.name, hello.will))
            if hello.name in self._living:
                self._dying.pop(hello.name, None)
            elif hello.will is not None:
                self._dying[hello.name] = time.monotonic() + RETURN_S  # died in between, if its token never comes
            lacking = self._store.lacks(hello)
            if lacking:
                self._heard.pop(hello.name, None)
            else:
                self._heard[hello.name] = hello.number
            query.reply(wire.HELLO, wire.encode(lacking))

    def _take_over(self, hello: wire.Hello) -> None:
        """A client is back under its id before its former will was spoken: now, unless it has said otherwise since."""
        if hello.will is None:
            return
        for name in self._store.wills() - {hello.name}:
            will = self._store.will(name)
            if will is not None and will.client == hello.will.client:
                self._dying.pop(name, None)
                self._apply(Parked(name, None))
                if topic_to_key(will.topic) not in hello.own:
                    self._speak(name, will)

    def _bye(self, query: zenoh.Query) -> None:
        with query:
            self._apply(Parked(wire.decode_name(_payload(query)), None))
            query.reply(wire.BYE, b"")

    def _client(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).removeprefix(wire.LIVE)
        if sample.kind == zenoh.SampleKind.PUT:
            self._living.add(name)
            self._dying.pop(name, None)
            return
        self._living.discard(name)
        self._heard.pop(name, None)
        if self._store.will(name) is not None:
            self._dying[name] = time.monotonic() + WILL_DELAY_S

    def _speak_due(self) -> None:
        now = time.monotonic()
        for name in [name for name, due in self._dying.items() if now >= due]:
            del self._dying[name]
            will = self._store.will(name)
            if will is not None:
                self._apply(Parked(name, None))
                self._do(lambda name=name, will=will: self._speak(name, will))  # type: ignore[misc]

    def _speak(self, name: str, will: wire.Will) -> None:
        key, qos = topic_to_key(will.topic), QoS(will.qos)
        if will.retain:
            self._apply(Kept(key, will.payload, wire.Stamp(qos, 0, name)))
        if self._session is not None:
            self._session.put(key, will.payload, attachment=wire.pack_live(qos, keep=will.retain), **wire.BLOCK)
        self._counters.add("wills")

    # -- memory

    def _apply(self, record: Record) -> None:
        if self._store.apply(record) and self._journal is not None and self._journal.append(wire.encode(record)):
            self._journal.rewrite(map(wire.encode, self._store.records()))

    def _recall(self, journal: Journal) -> None:
        decode = msgspec.msgpack.Decoder(Record).decode
        for data in journal.load():
            try:
                self._store.apply(decode(data))
            except msgspec.DecodeError as error:
                log.warning("journal %s has a record of another kind: %s", journal.path, error)
        journal.rewrite(map(wire.encode, self._store.records()))
        self._dying = dict.fromkeys(self._store.wills(), time.monotonic() + RETURN_S)


def _payload(query: zenoh.Query) -> bytes:
    if query.payload is None:
        raise ValueError(f"{query.key_expr} without payload")
    return query.payload.to_bytes()


def run_hub(settings: ZenohSettings, stop: threading.Event) -> None:
    """Be the hub until ``stop`` is set. Raises TransportError if that cannot work."""
    hub = ZenohHub(settings).open()
    try:
        stop.wait()
    finally:
        hub.close()


def main(arguments: list[str]) -> int:
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        run_hub(_settings(arguments), stop)
    except PebbleError as error:
        sys.stderr.write(f"zenoh_hub: {error}\n")
        return 1
    return 0


def _settings(arguments: list[str]) -> ZenohSettings:
    """By hand: a parser would be a tenth of this small process."""
    usage = "usage: python -m pebble.transports.zenoh_hub RUN_DIR [--journal FILE] [--lease-ms N]"
    if not arguments or len(arguments) % 2 == 0:
        raise TransportError(usage)
    run_dir, *options = arguments
    settings = ZenohSettings(run_dir=Path(run_dir).absolute())
    for option, value in zip(options[::2], options[1::2], strict=True):
        if option == "--journal":
            settings = replace(settings, journal=Path(value).absolute())
        elif option == "--lease-ms" and value.isdecimal():
            settings = replace(settings, lease_ms=int(value))
        else:
            raise TransportError(usage)
    return settings


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
