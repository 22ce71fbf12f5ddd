"""Zenoh: the robot's processes talk to each other directly, and a hub remembers kept copies and wills.

Every process is a peer with a link to every sibling, so that live traffic survives the hub (docs/transports.md).
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import zenoh

from pebble.errors import TransportError
from pebble.transports import zenoh_wire as wire
from pebble.transports.base import Message, QoS, State, Subscription, Transport
from pebble.transports.keymap import filter_to_key, key_to_topic, topic_to_key
from pebble.transports.roster import Roster, Seat, new_name, prepare_run_dir
from pebble.transports.settings import ZenohSettings
from pebble.transports.zenoh_ages import Ages
from pebble.transports.zenoh_barrier import Barrier
from pebble.transports.zenoh_echo import Echo
from pebble.transports.zenoh_session import HUB_SOCKET, check_process, close_at_exit, open_session, session_config
from pebble.transports.zenoh_watch import View, Watch

log = logging.getLogger(__name__)

OPEN_MEET_S = 1.0  # the longest wait for siblings that do not answer when opening,
MEET_S = 0.5  # when subscribing or finding the hub again,
FETCH_S = 0.7  # the same for the hub's kept copies, which it may hold back for half a second
GOODBYE_S = 0.3  # and when closing
HUB_ANSWER_S = 1.0
KEPT_ANSWER_S = 3.0
_RETRY_S = 0.2
_PUBLISHERS = 1000  # topics for which one is declared
_TOPIC_LIMIT = 10_000  # topics whose priority, or removal, is remembered

_V = TypeVar("_V")


class ZenohTransport(Transport):
    """One client of a robot's fabric. CONNECTING means that the hub is away; living peers still hear each other."""

    def __init__(self, client_id: str, settings: ZenohSettings, *, will: Message | None = None) -> None:
        super().__init__(client_id, will=will)
        self._settings = settings
        self._roster = Roster(settings.run_dir)
        self._linking = threading.RLock()  # subscribing and a new connection do not mix
        self._subscribers: dict[Subscription, zenoh.Subscriber[None]] = {}
        self._urgent: dict[str, bool] = {}  # by topic: a topic has one priority, or it would overtake itself (T3)
        self._removed: dict[str, None] = {}  # kept topics we have removed, in case a dying hub did not hear it
        self._number = 0  # of messages to be kept, so far
        self._announcing = False
        self._putting = 0  # the thread that is handing a live message to Zenoh
        self._connection = 0
        self._turn = threading.Lock()  # an answer belongs to one connection: none is offered after the next has begun
        self._reset()

    def _reset(self) -> None:
        self._name = ""
        self._pid = os.getpid()
        self._late_s = self._settings.lease_ms / 1000
        self._ages = Ages(wire.BOOT, self._late_s)
        self._seat: Seat | None = None
        self._session: zenoh.Session | None = None
        self._publishers: dict[tuple[str, QoS], zenoh.Publisher] = {}
        self._barrier: Barrier | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._watch = Watch()
        self._echo = Echo(self.counters)
        self._met = threading.Event()
        self._client_config = ""
        self._thread: threading.Thread | None = None

    # -- opening and closing

    def _open(self, timeout: float) -> None:
        self._reset()
        prepare_run_dir(self._settings.run_dir)
        self.problem = f"no hub answers in {self._settings.run_dir}"
        if self._settings.client:
            hub = [] if self._settings.connect else [self._settings.run_dir / HUB_SOCKET]
            self._client_config = session_config(self._settings, "client", listen=[], connect=hub)
        else:
            self._start_peer()
        self._thread = threading.Thread(target=self._run, name=f"pebble-zenoh {self.client_id}", daemon=True)
        self._thread.start()
        close_at_exit(self)
        self._met.wait(min(timeout, OPEN_MEET_S))

    def _start_peer(self) -> None:
        self._seat = self._roster.enter(self.client_id)
        try:
            hub = self._settings.run_dir / HUB_SOCKET
            siblings = self._roster.sockets(but=self._seat.name)
            config = session_config(self._settings, "peer", listen=[self._seat.socket], connect=[hub, *siblings])
            session = open_session(config)
        except (zenoh.ZError, TransportError) as error:
            self._seat.leave()
            raise TransportError(f"zenoh session of {self.client_id}: {error}") from None
        self._begin(session, self._seat.name)
        self._seat.ready()

    def _start_client(self) -> bool:
        """A client's session needs a hub to open at all, so it is tried until there is one."""
        while not self._watch.closed:
            try:
                session = open_session(self._client_config)
            except zenoh.ZError as error:
                log.debug("%s: %s", self.client_id, error)
                self.problem = f"no hub answers at {_places(self._settings)}"
                self._watch.wait_closed(_RETRY_S)
                continue
            if self._begin(session, new_name()):
                return True
        return False

    def _begin(self, session: zenoh.Session, name: str) -> bool:
        with self._turn:
            if self._watch.closed:
                session.close()  # type: ignore[no-untyped-call]
                return False
            self._name, self._session, self._publishers = name, session, {}
        self._barrier = Barrier(session, name, lambda: self._number)
        self._token = session.liveliness().declare_token(wire.LIVE + name)
        with self._linking:
            for subscription in list(self._subscriptions):
                self._start(session, subscription)
        self._watch.follow(session)
        return True

    def _close(self, will: Message | None) -> None:
        self._watch.close()
        with self._turn:
            session = self._session
        if session is not None and self._pid == os.getpid():
            self._leave(session, will)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(OPEN_MEET_S + HUB_ANSWER_S)
        self._echo.close()
        if self._seat is not None:
            self._seat.leave()
        self._subscribers.clear()
        self._publishers.clear()
        self._session = None

    def _leave(self, session: zenoh.Session, will: Message | None) -> None:
        try:
            if will is not None:
                self._send(will, False)
                self._ask_hub(session, wire.BYE, wire.encode(self._name), GOODBYE_S)
            self._meet(GOODBYE_S)  # what was published last has arrived when they answer
        except zenoh.ZError as error:
            log.warning("%s could not say goodbye: %s", self.client_id, error)
        finally:
            session.close()  # type: ignore[no-untyped-call]

    # -- the transport's thread: every appearance of the hub is a new connection

    def _run(self) -> None:
        if self._settings.client and not self._start_client():
            return
        seen = linked = 0
        self._first_meeting()
        while (view := self._watch.wait(seen, _RETRY_S if self._watch.hubs and not linked else None)) is not None:
            try:
                linked = self._follow(view, seen, linked)
            except Exception:  # the thread's last line of defence: a transport that is deaf for good is worse
                if self._watch.closed:
                    return
                log.exception("%s: talking to the hub failed in a way nobody thought of", self.client_id)
                linked = 0
                self._watch.wait_closed(HUB_ANSWER_S)
            seen = view.version

    def _first_meeting(self) -> None:
        try:
            self._meet(OPEN_MEET_S)
        except zenoh.ZError as error:  # closed meanwhile
            log.debug("%s could not meet its siblings: %s", self.client_id, error)
        self._met.set()

    def _follow(self, view: View, seen: int, linked: int) -> int:
        """Act on what has changed; returns the connection to a hub that is in order now, 0 for none."""
        if not view.hubs:
            self.problem = f"the hub of {self._settings.run_dir} is away"
            self._set_state(State.CONNECTING)
            return 0
        if view.connection != linked:
            return view.connection if self._link() else 0
        if view.version != seen:
            self._refresh()
        return linked

    def _link(self) -> bool:
        """Tell the hub what it must know, ask it for what is kept."""
        session = self._session
        self._set_state(State.CONNECTING)
        if session is None or not self._hello(session):
            self.problem = f"the hub of {self._settings.run_dir} does not answer"
            return False
        self._refresh()
        self._set_state(State.CONNECTED)
        self._bring_up_to_date(session, set())  # what was parked while we said hello
        return True

    def _hello(self, session: zenoh.Session) -> bool:
        """Park the will and send what the hub lacks, until it lacks nothing."""
        end = time.monotonic() + HUB_ANSWER_S
        while time.monotonic() < end:
            with self._publishing:
                hello = wire.Hello(self._name, self._number, self._parked_will(), self._digests())
            answers = self._ask_hub(session, wire.HELLO, wire.encode(hello), end - time.monotonic())
            if not answers:
                return False
            lacking = {key_to_topic(key) for answer in answers for key in wire.decode_keys(answer)}
            if not self._bring_up_to_date(session, lacking):
                return True
        return False

    def _parked_will(self) -> wire.Will | None:
        return None if self.will is None else wire.Will.of(self.will, self.client_id)

    def _digests(self) -> dict[str, int | None]:
        gone: dict[str, int | None] = {topic_to_key(topic): None for topic in self._removed}
        return gone | {topic_to_key(topic): wire.digest(own.payload) for topic, own in self._own.items() if own.payload}

    def _bring_up_to_date(self, session: zenoh.Session, lacking: set[str]) -> bool:
        """Tell the hub, and only the hub, what is parked and what it lacks; False if that is nothing.

        Living peers have heard these messages when they were fresh.
        """
        with self._publishing:
            owed = bool(self._parked or lacking)
            self._announcing = True
            try:
                self._announce(self._own.keys() - lacking)
                for topic in lacking & self._removed.keys():
                    self._put_kept(session, Message(topic, b"", QoS.DELIVERED, retain=True))
            finally:
                self._announcing = False
            return owed

    def _refresh(self) -> None:
        """Ask for all kept copies, as on a new connection: links have been down."""
        with self._linking:
            if self._session is None:
                return
            with self._turn:
                self._connection += 1
                self._renew()
            numbers = self._meet(MEET_S)  # after that: what is heard live meanwhile is newer than what they count
            self._fetch(self._session, list(self._subscribers), numbers)

    # -- sending

    def _send(self, message: Message, urgent: bool) -> bool:
        check_process(self._pid)
        session = self._session
        if session is None or (self._settings.client and not self._watch.hubs):
            return False
        try:
            if message.retain:
                self._count(message)
                self._put_kept(session, message)
            if not self._announcing:
                self._put_live(session, message, urgent)
        except zenoh.ZError as error:
            log.debug("%s could not send: %s", self.client_id, error)
            return False
        return True

    def _put_live(self, session: zenoh.Session, message: Message, urgent: bool) -> None:
        publisher = self._publishers.get((message.topic, message.qos)) or self._declare_publisher(
            session, message, urgent
        )
        stamp = wire.pack_live(message.qos, keep=message.retain)
        self._putting = threading.get_ident()
        try:
            publisher.put(message.payload, attachment=stamp)
        finally:
            self._putting = 0

    def _declare_publisher(self, session: zenoh.Session, message: Message, urgent: bool) -> zenoh.Publisher:
        """From then on what is put there goes to those who listen; without it the hub, too, gets a copy of everything.

        Measured with 1.10.2 on two cores at 200 Hz: the hub's 3 to 5 % of a core are gone, and the way from one process
        to another takes 0.85 of the time.
        """
        urgent = _note(self._urgent, message.topic, urgent)
        treatment = wire.TREATMENTS[message.qos, urgent]
        if len(self._publishers) >= _PUBLISHERS:
            del self._publishers[next(iter(self._publishers))]  # undeclared with its last reference
        publisher = session.declare_publisher(topic_to_key(message.topic), **treatment)
        self._publishers[message.topic, message.qos] = publisher
        return publisher

    def _count(self, message: Message) -> None:
        if not self._announcing:
            self._number += 1
        if message.payload:
            self._removed.pop(message.topic, None)
        else:
            _note(self._removed, message.topic, None)

    def _put_kept(self, session: zenoh.Session, message: Message) -> None:
        """First to the hub, then live: who subscribes in between gets one of the two at least."""
        stamp = wire.Stamp(message.qos, 0 if self._announcing else self._number, self._name)
        session.put(wire.KEPT + topic_to_key(message.topic), message.payload, attachment=stamp.pack(), **wire.BLOCK)

    # -- receiving

    def _declare(self, subscription: Subscription) -> None:
        check_process(self._pid)
        with self._linking:
            session = self._session
            if session is None:
                return  # declared when there is a session
            with contextlib.suppress(zenoh.ZError):  # closed meanwhile: then nothing is received any more
                self._start(session, subscription)
                numbers = self._meet(MEET_S)
                if self._state is State.CONNECTED:
                    self._fetch(session, [subscription], numbers)

    def _undeclare(self, subscription: Subscription) -> None:
        subscriber = self._subscribers.pop(subscription, None)
        if subscriber is not None:
            with contextlib.suppress(zenoh.ZError):  # closed meanwhile
                subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _start(self, session: zenoh.Session, subscription: Subscription) -> None:
        if subscription in self._subscribers:
            return
        origin = zenoh.Locality.ANY if subscription.echo else zenoh.Locality.REMOTE

        def take(sample: zenoh.Sample) -> None:
            self.counters.add("received")
            stamp = wire.read_live(sample.attachment)
            if self._is_late(sample, stamp):
                return
            message = _live(sample, stamp, subscription.qos)
            if subscription.direct and self._putting == threading.get_ident():
                self._echo.put(subscription, message)
            else:
                subscription.offer(message)

        self._subscribers[subscription] = session.declare_subscriber(
            filter_to_key(subscription.filter), _direct(take), allowed_origin=origin
        )

    def _is_late(self, sample: zenoh.Sample, stamp: wire.LiveStamp) -> bool:
        """It was waiting in a socket while this process stood still: by now its link counts as dead (T19).

        What is to be kept is heard all the same, for nobody says it again.
        """
        if not stamp.boot:
            return False
        age_s = self._ages.age_s(stamp.boot, stamp.sent_ns / 1e9, wire.since_boot_ns() / 1e9)
        if stamp.keep or age_s <= self._late_s:
            return False
        self.counters.add("late")
        log.debug("%s: a message of %s came %.1f s late and is dropped", self.client_id, sample.key_expr, age_s)
        return True

    def _fetch(self, session: zenoh.Session, subscriptions: list[Subscription], numbers: dict[str, int]) -> None:
        """Ask for kept copies and wait for them, so that none comes among messages published after we returned."""
        end = time.monotonic() + FETCH_S
        answered = [self._ask_kept(session, subscription, numbers) for subscription in subscriptions]
        for event in answered:
            event.wait(max(0.0, end - time.monotonic()))

    def _ask_kept(self, session: zenoh.Session, subscription: Subscription, numbers: dict[str, int]) -> threading.Event:
        """``numbers``: how many messages to be kept each sibling has sent; the answer waits until those are in."""
        connection, answered = self._connection, threading.Event()

        def take(reply: zenoh.Reply) -> None:
            sample = reply.ok
            if sample is None or sample.attachment is None:
                return
            stamp = wire.Stamp.unpack(sample.attachment.to_bytes())
            if stamp.origin == self._name and not subscription.echo:
                return
            self.counters.add("received")
            message = _kept(sample, stamp, subscription.qos)
            with self._turn:
                if connection == self._connection:
                    subscription.offer(message)

        session.get(
            wire.KEPT + filter_to_key(subscription.filter),
            zenoh.handlers.Callback(take, answered.set, indirect=False),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=KEPT_ANSWER_S,
            payload=wire.encode({name: number for name, number in numbers.items() if number}),
            **wire.BLOCK,
        )
        return answered

    # -- asking

    def _meet(self, timeout: float) -> dict[str, int]:
        return {} if self._barrier is None else self._barrier.meet(self._expected, timeout)

    def _expected(self) -> dict[str, str]:
        """Who must have answered before what we declare or publish is surely known: this run directory's living."""
        remote = self._settings.client and self._settings.connect
        siblings = {} if remote else self._roster.ready(but=self._name)
        return siblings | dict.fromkeys(self._watch.hubs, "the hub")

    def _ask_hub(self, session: zenoh.Session, what: str, payload: bytes, timeout: float) -> list[bytes]:
        """The hub's answers; none if there is no hub, or none that answers in time."""
        replies = session.get(
            what,
            zenoh.handlers.FifoChannel(16),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            payload=payload,
            **wire.BLOCK,
        )
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def _direct(function: Callable[[Any], None]) -> zenoh.handlers.Callback[Any]:
    """Run on Zenoh's receiving thread. Its default would queue, and then block that thread for everybody."""
    return zenoh.handlers.Callback(function, indirect=False)


def _live(sample: zenoh.Sample, stamp: wire.LiveStamp, qos: QoS) -> Message:
    topic = key_to_topic(str(sample.key_expr))
    return Message(topic, sample.payload.to_bytes(), min(stamp.qos, qos), keep=stamp.keep)


def _kept(sample: zenoh.Sample, stamp: wire.Stamp, qos: QoS) -> Message:
    topic = key_to_topic(str(sample.key_expr).removeprefix(wire.KEPT))
    return Message(topic, sample.payload.to_bytes(), min(stamp.qos, qos), retain=True, keep=True)


def _note(by_topic: dict[str, _V], topic: str, value: _V) -> _V:
    """What is noted for ``topic`` from now on: the first value ever given, as long as there is room."""
    if topic not in by_topic and len(by_topic) >= _TOPIC_LIMIT:
        by_topic.pop(next(iter(by_topic)))
    return by_topic.setdefault(topic, value)


def _places(settings: ZenohSettings) -> str:
    """Where a client looks for its hub."""
    return ", ".join(settings.connect) or str(settings.run_dir / HUB_SOCKET)
