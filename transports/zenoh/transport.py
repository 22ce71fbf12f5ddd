"""The Zenoh transport: processes exchange messages directly, and a hub stores retained messages and wills.

Every process is a peer connected to every sibling process, so that live messages do not need the hub. A *client* is one
ZenohTransport, of either mode: a peer, or with ``settings.client`` a session in Zenoh's client mode, which reaches
others only through the hub. *Siblings* are the other peers of the run directory.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Sequence

import zenoh

from pebble.errors import TransportError
from pebble.transports import clock
from pebble.transports.ages import MessageAges
from pebble.transports.base import QUEUE_BYTES, QUEUE_LIMIT, Message, State, Subscription, Transport
from pebble.transports.bounds import BoundedQueue
from pebble.transports.counters import Counters
from pebble.transports.peers import PeerRegistry, PresenceLock, new_name, prepare_run_dir
from pebble.transports.settings import ZenohSettings
from pebble.transports.topics import is_pattern
from pebble.transports.zenoh import session as sessions
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.hub_connection import GOODBYE_S, HUB_ANSWER_S, HubConnection
from pebble.transports.zenoh.keymap import filter_to_key, key_to_topic
from pebble.transports.zenoh.presence import Barrier, HubView, HubWatch
from pebble.transports.zenoh.publishers import Publishers

log = logging.getLogger(__name__)

OPEN_SYNC_S = 1.0  # the longest wait for siblings that do not answer, when opening,
SYNC_S = 0.5  # and when subscribing or reconnecting to the hub
_RETRY_S = 0.2
_START = "is the robot up? `pebble up CONFIG` starts it"


class LoopbackQueue:
    """A queue that hands a transport's own messages to its own direct handlers, on a thread of its own.

    The thread starts with the first message. Zenoh delivers to subscribers of the same session inside ``put()``. A
    direct handler called there would run under the publisher's lock, and two that publish to each other would deadlock.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._arrived = threading.Condition()
        self._queue = BoundedQueue[tuple[Subscription, Message]](QUEUE_LIMIT, QUEUE_BYTES)
        self._thread: threading.Thread | None = None
        self._closed = False

    def put(self, subscription: Subscription, message: Message) -> None:
        with self._arrived:
            if self._closed:
                return
            for _lost in self._queue.append((subscription, message), len(message.topic) + len(message.payload)):
                self._counters.add("dropped")
            self._arrived.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="pebble-echo", daemon=True)
                self._thread.start()

    def close(self) -> None:
        with self._arrived:
            self._closed = True
            self._queue.clear()
            self._arrived.notify()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)

    def _run(self) -> None:
        while True:
            with self._arrived:
                self._arrived.wait_for(lambda: self._queue or self._closed)
                if self._closed:
                    return
                subscription, message = self._queue.popleft()
            subscription.offer(message)


class ZenohTransport(Transport):
    """A client of a robot's Zenoh network. In CONNECTING the hub is away; running peers still receive each other."""

    def __init__(self, client_id: str, settings: ZenohSettings, *, will: Message | None = None) -> None:
        super().__init__(client_id, will=will)
        self.settings = settings
        self._elsewhere = bool(settings.client and settings.connect)  # its hub and siblings are on other machines
        self._connecting = threading.RLock()  # held while subscribing, and while a connection is made
        self._subscribers: dict[Subscription, zenoh.Subscriber[None]] = {}
        self._publishers = Publishers(lambda topic: self.policy.is_invented(topic))  # its owner sets policy later
        self._hub = HubConnection(client_id, will, self._own, self.count_received, settings.account)
        self._reset()

    def _reset(self) -> None:
        """Make what belongs to one opening: a closed transport may be opened again."""
        self._hub.open()
        self._pid = os.getpid()
        self._ages = MessageAges(wire.BOOT, self.settings.lease_ms / 1000)
        self._siblings = PeerRegistry(self.settings.run_dir)
        self._barrier: Barrier | None = None  # of the newest session
        self._presence: PresenceLock | None = None
        self.session: zenoh.Session | None = None
        self._publishers.declared.clear()
        self._loopback = LoopbackQueue(self.counters)
        self._opened = threading.Event()  # set after the first wait for siblings
        self._thread: threading.Thread | None = None

    # -- opening and closing

    def _open(self, timeout: float) -> None:
        self._reset()
        prepare_run_dir(self.settings.run_dir)
        self.problem = f"no hub answers in {self.settings.run_dir}: {_START}"
        if not self.settings.client:
            self._start_peer()
        name = f"pebble-zenoh {self.client_id}"
        self._thread = threading.Thread(target=self._run, args=(self._hub.watch,), name=name, daemon=True)
        self._thread.start()
        sessions.close_at_exit(self)
        self._opened.wait(min(timeout, OPEN_SYNC_S))  # for the siblings; the caller waits for the hub

    def _start_peer(self) -> None:
        presence = self._presence = self._siblings.register(self.client_id)
        try:
            hub = self.settings.run_dir / sessions.HUB_SOCKET
            siblings = self._siblings.sockets(but=presence.name)
            config = sessions.session_config(self.settings, "peer", listen=[presence.socket], connect=[hub, *siblings])
            session = sessions.open_session(config)
        except (zenoh.ZError, TransportError) as error:
            presence.release()
            raise TransportError(f"zenoh session of {self.client_id}: {error}") from None
        if self._begin(self._hub.watch, session, presence.name):  # False: closed meanwhile
            presence.ready()

    def _start_client(self, watch: HubWatch) -> bool:
        """Try until a hub answers, without which a session in client mode cannot open; True if it has opened."""
        account = self.settings.account
        hub = [] if self.settings.connect else [self.settings.run_dir / sessions.HUB_SOCKET]
        config = sessions.session_config(self.settings, "client", listen=[], connect=hub)
        while not watch.closed:
            try:
                session = sessions.open_session(config)
            except zenoh.ZError as error:
                log.debug("%s: %s", self.client_id, error)
                hubs = ", ".join(self.settings.connect) or self.settings.run_dir / sessions.HUB_SOCKET
                self.problem = f"no hub answers at {hubs}: {_START}"
                watch.wait_closed(_RETRY_S)
                continue
            if self._begin(watch, session, f"{account}{wire.OF}{new_name()}" if account else new_name()):
                return True
        return False

    def _begin(self, watch: HubWatch, session: zenoh.Session, name: str) -> bool:
        """Use ``session`` from now on: subscribe, and watch its hubs. False if this transport was closed meanwhile."""
        with self._hub.lock:
            if watch.closed:
                sessions.close_session(session)
                return False
            self._hub.name, self.session = name, session
            self._publishers.declared.clear()
        self._barrier = Barrier(session, name, lambda: self._hub.retained_count, by_name=self._elsewhere)
        with self._connecting:
            for subscription in self._subscriptions:
                self._make_subscriber(session, subscription)
        watch.follow(session)
        return True

    def _close(self, will: Message | None) -> None:
        self._hub.watch.close()
        with self._hub.lock:
            session = self.session
        if session is not None and self._pid == os.getpid():  # a fork cannot use the session
            self._publish_will_and_leave(session, will)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(OPEN_SYNC_S + HUB_ANSWER_S)
        self._loopback.close()
        if self._presence is not None:
            self._presence.release()
        self._subscribers.clear()
        self._publishers.declared.clear()
        self.session = None

    def _publish_will_and_leave(self, session: zenoh.Session, will: Message | None) -> None:
        try:
            if will is not None:
                self._send(will, False)  # not urgent
                self._hub.leave(session)  # or else it would publish the will once more
            self._synchronize(GOODBYE_S)  # siblings and hub have received our last messages when they answer
        except zenoh.ZError as error:
            log.warning("%s could not close in order: %s", self.client_id, error)
        finally:
            sessions.close_session(session)

    # -- the transport's thread: every time a hub appears a new connection begins

    def _run(self, watch: HubWatch) -> None:
        """Follow ``watch``, which is closed at the end of this run, and replaced when the transport opens again."""
        if self.settings.client and not self._start_client(watch):
            return
        version = 0  # of the newest HubView (which hubs are present) that was handled
        linked = 0  # the number of the hub connection that works; 0: none does, and with a hub it is tried again
        self._wait_for_siblings_once()
        while (view := watch.wait(version, _RETRY_S if watch.hubs and not linked else None)) is not None:
            try:
                linked = self._follow(view, version, linked)
            except Exception:  # any error must lead to a reconnect, never end the thread
                if watch.closed:  # the transport is being closed, which may be why
                    return
                log.exception("%s: unexpected failure of the connection to the hub", self.client_id)
                linked = 0
                watch.wait_closed(HUB_ANSWER_S)
            version = view.version

    def _synchronize(self, timeout: float) -> dict[str, int]:
        """Wait until siblings and hub know our declarations; return how many retained messages each sibling has sent.

        Each sibling sends its own retained messages to the hub, and some may still be on their way there: with the
        counts, `HubConnection.fetch` lets the hub answer only after these. Siblings on other machines (`_elsewhere`)
        are in no run directory here, so only the hub is waited for.
        """
        if self._barrier is None:  # no session has begun
            return {}

        def expected() -> dict[str, str]:  # by name: what each is, for logs
            siblings = {} if self._elsewhere else self._siblings.ready(but=self._hub.name)
            return siblings | dict.fromkeys(self._hub.watch.hubs, "the hub")

        return self._barrier.synchronize(expected, timeout)

    def _wait_for_siblings_once(self) -> None:
        try:
            self._synchronize(OPEN_SYNC_S)
        except zenoh.ZError as error:  # closed meanwhile
            log.debug("%s could not synchronize with its siblings: %s", self.client_id, error)
        self._opened.set()

    def _follow(self, view: HubView, seen: int, linked: int) -> int:
        """Process a change of hubs or connections; return the serial number of the working hub connection, 0 for none.

        The number grows with each hub that appears. ``linked``: the result of the last call, or 0 after an error;
        ``seen``: the version of that call's view. With the same version nothing has changed: a failed try is repeated.
        """
        if not view.hubs:
            self.problem = f"the hub of {self.settings.run_dir} is away"
            self._set_state(State.CONNECTING)
            return 0
        if view.connection != linked:
            return view.connection if self._connect_hub() else 0
        if view.version != seen:  # the same hub, but a connection was interrupted, or a hub ended
            self._refresh()
        return linked

    def _connect_hub(self) -> bool:
        """Send our will and missing messages to the hub, and ask for its retained messages."""
        session = self.session
        self._set_state(State.CONNECTING)
        if session is None or not self._send_hello(session):
            self.problem = f"the hub of {self.settings.run_dir} does not answer"
            return False
        self._refresh()
        self._set_state(State.CONNECTED)
        self._send_lacking(session, set())  # set(): only what became pending since _send_hello has sent the rest
        return True

    def _send_hello(self, session: zenoh.Session) -> bool:
        """Store our will at the hub, and send our retained messages until the hub has all, or no room for the rest."""
        end = time.monotonic() + HUB_ANSWER_S
        sent: set[str] = set()
        while (remaining_s := end - time.monotonic()) > 0:  # Zenoh refuses a time limit that is not positive
            with self._publishing:
                hello = self._hub.hello()
            lacking = self._hub.greet(session, hello, remaining_s)
            if lacking is None:
                return False
            if not self._send_lacking(session, lacking - sent):  # nothing left: the hub has all, or no room for `sent`
                return True
            sent |= lacking
        return False

    def _send_lacking(self, session: zenoh.Session, lacking: set[str]) -> bool:
        """Send the hub the messages that are pending and those that it lacks; False if there are none.

        Other clients receive the messages that are new to them.
        """
        with self._publishing:
            owed = bool(self._own.pending or lacking)
            self._sync_retained(self._own.keys() - lacking)  # sends all but these
            self._hub.put_removals(session, lacking)  # what the hub lacks may also be the removal of a message
            return owed

    def _refresh(self) -> None:
        """Ask for all retained messages, as on a new connection, because connections were interrupted."""
        with self._connecting:
            if self.session is None:
                return
            with self._hub.lock:
                self._hub.renew()  # answers to earlier queries are dropped
                self._renew()  # all subscriptions: retained messages are delivered again
            counts = self._synchronize(SYNC_S)  # after _renew: a retained one is dropped if a live one comes first
            self._hub.fetch(self.session, list(self._subscribers), counts)

    # -- sending

    def _send(self, message: Message, urgent: bool) -> bool:
        if self._pid != os.getpid():
            sessions.check_process(self._pid)
        session = self.session
        if session is None or (self.settings.client and not self._hub.watch.hubs):
            return False
        try:
            if message.retain:
                self._hub.put(session, message, again=self._own.syncing)
            # While `syncing`, siblings have received these messages before: only the hub gets them again. But what a
            # client has pending is new to all, as it reaches others through the hub alone.
            if not self._own.syncing:
                self._publishers.put(session, message, urgent)
            elif self.settings.client and message.topic in self._own.pending:
                self._publishers.put_late(session, message)
        except zenoh.ZError as error:
            log.debug("%s could not send: %s", self.client_id, error)
            return False
        return True

    # -- receiving

    def _declare(self, subscription: Subscription) -> None:
        self._declare_all([subscription])

    def _declare_all(self, subscriptions: Sequence[Subscription]) -> None:
        sessions.check_process(self._pid)
        with self._connecting:
            session = self.session
            if session is None:
                return  # they are declared when there is a session
            with contextlib.suppress(zenoh.ZError):  # closed meanwhile: then nothing is received any more
                for subscription in subscriptions:
                    self._make_subscriber(session, subscription)
                counts = self._synchronize(SYNC_S)
                if self._state is State.CONNECTED:
                    self._hub.fetch(session, subscriptions, counts)

    def _undeclare(self, subscription: Subscription) -> None:
        subscriber = self._subscribers.pop(subscription, None)
        if subscriber is not None:
            with contextlib.suppress(zenoh.ZError):  # closed meanwhile
                subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _make_subscriber(self, session: zenoh.Session, subscription: Subscription) -> None:  # unless it has one
        if subscription in self._subscribers:
            return
        origin = zenoh.Locality.ANY if subscription.echo else zenoh.Locality.REMOTE
        only_topic = None if is_pattern(subscription.filter) else subscription.filter  # None: it matches many
        may_be_ours = subscription.direct and subscription.echo  # then the handler must not run inside our put()
        late_s, publishers = self._ages.late_s, self._publishers

        def take(sample: zenoh.Sample) -> None:
            self.count_received()
            read_at = clock.since_boot()
            stamp = wire.read_live(sample.attachment)
            # since: when it was sent; None if its sender does not share our clock. If long ago or None, ask `_is_late`.
            since = stamp.sent_ns / 1e9 if stamp.boot == wire.BOOT else None
            if (since is None or read_at - since > late_s) and self._is_late(sample, stamp, read_at):
                return
            topic, payload = only_topic or key_to_topic(str(sample.key_expr)), sample.payload.to_bytes()
            qos = min(stamp.qos, subscription.qos)
            message = Message(topic, payload, qos, False, stamp.retain_requested, read_at if since is None else since)
            if may_be_ours and publishers.thread == threading.get_ident():  # this thread is inside put()
                self._loopback.put(subscription, message)
            else:
                subscription.offer(message)

        self._subscribers[subscription] = session.declare_subscriber(
            filter_to_key(subscription.filter), direct(take), allowed_origin=origin
        )

    def _is_late(self, sample: zenoh.Sample, stamp: wire.LiveStamp, now: float) -> bool:
        """True if ``sample`` waited in a socket while this process was stopped, longer than a connection's lease (T19).

        Retained messages are not sent again, and stops must take effect: they are never late, nor is what has no stamp.
        """
        topic = key_to_topic(str(sample.key_expr))
        if not stamp.boot or self.policy.is_stop(topic):
            return False
        age_s = self._ages.age_s(stamp.boot, topic, stamp.sent_ns / 1e9, now)  # and learn the sender's clock
        if stamp.retain_requested or age_s <= self._ages.late_s:
            return False
        self.counters.add("late")
        log.debug("%s: a message of %s was %.1f s late and is dropped", self.client_id, sample.key_expr, age_s)
        return True


TRANSPORT = ZenohTransport
