"""A node of ROS 1 in the standard library: it registers at a master, publishes and subscribes over TCPROS."""

from __future__ import annotations

import logging
import queue
import selectors
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from pebble.runtime.rate_limit import RateLimitedLog
from pebble.services.ros1_bridge.messages import Form
from pebble.services.ros1_bridge.publication import MOST_PEERS, Publication, Subscriber
from pebble.services.ros1_bridge.wire import MOST_MESSAGE, Blocks, RosError, pack_header, parse_header
from pebble.services.ros1_bridge.xmlrpc_api import CALL_S, call, lives, serve
from pebble.transports.counters import Counters

log = logging.getLogger(__name__)

CHECK_S = 1.0  # how often the registration is checked
REVIVE_S = 2.0  # a subscriber that the master lists, and that is not connected, is told again so often
GREETING_S = 2.0  # so long a new connection may take to say what it wants
_MOST_GREETINGS = 32  # connections at once that have not said yet what they want; more are closed
_MOST_CALLS_WAITING = 256  # calls of other nodes that wait to be made; more are made at the next check
_QUIET_S, _PROBE_S, _PROBES = 10, 5, 3  # a publisher of whose machine nothing is heard is given up after 25 s


class Source:
    """A publisher to which the node subscribes; ``asked``: a connection to it is being made."""

    def __init__(self, uri: str) -> None:
        self.uri, self.asked = uri, False
        self.sock: socket.socket | None = None
        self.greeted = False
        self.blocks = Blocks(MOST_MESSAGE)


class Subscription:
    """A topic that the node reads; ``receive(body)`` is called on the node's thread of sockets."""

    def __init__(self, topic: str, form: Form, receive: Callable[[bytes], None]) -> None:
        self.topic, self.form, self.receive = topic, form, receive
        self.sources: dict[str, Source] = {}  # by address; changed on the thread of sockets


class Node:
    """A node of ROS 1. Call :meth:`advertise` and :meth:`subscribe`, then :meth:`start`.

    One thread has the sockets, one serves the API of the node, one calls the master and publishers, one calls
    lost subscribers (listed by the master, not connected). None waits for another, so a long call delays no message.
    ``on_evicted(why)`` is called, on some thread, when another node has the name: nothing may move from then on.
    """

    def __init__(self, name: str, master: str, host: str, on_evicted: Callable[[str], object]) -> None:
        self.name, self.master = "/" + name.strip("/"), master
        self.registered, self.problem = False, "the ROS master has not answered yet"
        self.others: dict[str, list[str]] = {}  # nodes that publish what this one does, by topic
        self.counters = Counters()
        self._log = RateLimitedLog(log)
        self._on_evicted = on_evicted
        self._evicted = False
        self._publications: dict[str, Publication] = {}
        self._subscriptions: dict[str, Subscription] = {}
        #: Lost subscribers by topic and node: the master lists them, but they are not connected. Since when, or when
        #: they were last told again that this node publishes the topic.
        self._missing: dict[tuple[str, str], float] = {}
        self._lost: dict[tuple[str, str], list[str]] = {}  # those to tell now, and the topic's publishers
        self._wake_lost = threading.Event()  # wakes the thread that tells lost subscribers
        self._revived = 0  # how often a lost subscriber was told
        self._ends = threading.Event()
        self._threads: list[threading.Thread] = []
        self._calls: queue.Queue[Callable[[], None]] = queue.Queue(_MOST_CALLS_WAITING)
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()  # of the thread of sockets
        self._greetings: dict[Subscriber, float] = {}  # connections without a request yet, and when they were made
        self._select = selectors.DefaultSelector()
        self._waker, self._wakes = socket.socketpair()  # a byte into the first ends the wait for the second, in _select
        self._waker.setblocking(False)
        self._wakes.setblocking(False)
        self._listener = socket.create_server((host, 0), backlog=16)
        self._listener.setblocking(False)
        self._api = serve(self, host, lambda: self._refuse("calls", "calls of its API by other nodes"))
        self.uri = f"http://{host}:{self._api.server_address[1]}/"
        self._address = host, self._listener.getsockname()[1]

    def advertise(self, topic: str, form: Form, definition: str) -> Publication:
        topic = "/" + topic.strip("/")
        self._publications[topic] = publication = Publication(topic, form, definition, self._close)
        return publication

    def subscribe(self, topic: str, form: Form, receive: Callable[[bytes], None]) -> None:
        topic = "/" + topic.strip("/")
        self._subscriptions[topic] = Subscription(topic, form, receive)

    def start(self) -> None:
        self._select.register(self._listener, selectors.EVENT_READ, self._accept)
        self._select.register(self._wakes, selectors.EVENT_READ, lambda: self._wakes.recv(4096))
        for run in (self._run_sockets, self._run_calls, self._run_lost, self._run_api):
            thread = threading.Thread(target=run, name=f"ros{run.__name__}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def close(self) -> None:
        """Let messages on their way arrive, then sign off at the master; takes no longer than one call."""
        for publication in self._publications.values():
            publication.finish()
        self._ends.set()
        self._wake_lost.set()
        self._wake()
        with suppress(RosError):  # if one call fails, the others wait in vain, too
            for topic in self._publications:
                call(self.master, "unregisterPublisher", self.name, topic, self.uri)
            for topic in self._subscriptions:
                call(self.master, "unregisterSubscriber", self.name, topic, self.uri)
        self._api.shutdown()
        self._api.server_close()

    @property
    def alive(self) -> bool:
        """True until a thread of the node has failed."""
        return all(thread.is_alive() for thread in self._threads)

    def dropped(self) -> dict[str, int]:
        """Return how many messages were dropped since the start because of a limit, by kind."""
        messages = sum(publication.dropped for publication in self._publications.values())
        return {**self.counters.snapshot(), **({"ros_messages": messages} if messages else {})}

    # -- what its API asks, on threads of its own

    def publishers_are(self, topic: str, uris: list[str]) -> None:
        """Note the publishers of a topic. Connected ones stay: a restarted master lists no publishers at first."""
        subscription = self._subscriptions.get(topic)
        if subscription is not None:
            self._in_sockets(lambda: self._update(subscription, uris))

    def address_of(self, topic: str) -> tuple[str, int] | None:
        """Return the address at which a topic is published; None if it is not published now."""
        return self._address if topic in self._publications and not self._evicted else None

    def evict(self, why: str) -> None:
        """Handle another node that has taken this name: move nothing, and wait until it has gone."""
        self.problem = f"the ROS master has ended this node: {why}"
        log.error("%s", self.problem)
        self._stop_publishing()

    def _stop_publishing(self) -> None:
        """Stop publishing because another node has this name: disconnect all subscribers, and call ``on_evicted``."""
        self._evicted, self.registered = True, False
        self._on_evicted(self.problem)
        for publication in self._publications.values():
            publication.remove_all("another node has this name")

    def published(self) -> list[list[str]]:
        return [[topic, publication.form.kind] for topic, publication in self._publications.items()]

    def subscribed(self) -> list[list[str]]:
        return [[topic, subscription.form.kind] for topic, subscription in self._subscriptions.items()]

    def _run_api(self) -> None:
        self._api.serve_forever(poll_interval=0.1)

    # -- the master and other nodes, on the thread of calls

    def _run_calls(self) -> None:
        due = 0.0
        while not self._ends.is_set():
            if time.monotonic() >= due:
                self._check()
                due = time.monotonic() + CHECK_S
            with suppress(queue.Empty):
                self._attempt_call(self._calls.get(timeout=max(0.0, due - time.monotonic())))

    def _check(self) -> None:
        """Register the node if the master does not know it, as after a restart; connect to lost publishers."""
        try:
            self._keep_registered()
            self.registered = not self._evicted
            self.problem = "" if self.registered else self.problem
        except RosError as error:
            if str(error) != self.problem:
                log.warning("the ROS master: %s", error)
            self.registered, self.problem = False, str(error)
        except Exception as error:  # noqa: BLE001 - an answer that is none of a master: this thread must not end
            self._log.exception("answer", "the ROS master answers what is not understood")
            self.registered, self.problem = False, f"the ROS master's answer is not understood: {error!r:.80}"
        for subscription in self._subscriptions.values():
            for source in list(subscription.sources.values()):
                if source.sock is None and not source.asked:
                    self._connect_soon(subscription, source)

    def _keep_registered(self) -> None:
        """Register what the master does not know of this node; tell lost subscribers of this node. Raises RosError."""
        publishers, subscribers, _ = call(self.master, "getSystemState", self.name)
        uri = self._uri_of(self.name)
        if uri not in ("", self.uri) and lives(uri):  # "": the master names none
            if not self._evicted:
                self._stop_publishing()
            raise RosError(f"another node is called {self.name}: {uri}")  # to register would end it
        published = {topic for topic, nodes in publishers if self.name in nodes}
        subscribed = {topic for topic, nodes in subscribers if self.name in nodes}
        is_complete = self._publications.keys() <= published and self._subscriptions.keys() <= subscribed
        # The name alone may be that of an earlier life of this node, which was killed.
        if self._evicted or uri != self.uri or not is_complete:
            self._register()
        self.others = {topic: sorted({*nodes} - {self.name}) for topic, nodes in publishers}
        self._revive(dict(publishers), dict(subscribers))

    def _register(self) -> None:
        self._evicted = False
        for topic, publication in self._publications.items():
            self._register_as("registerPublisher", topic, publication.form)
        for topic, subscription in self._subscriptions.items():
            self.publishers_are(topic, self._register_as("registerSubscriber", topic, subscription.form))
        log.info("registered at the ROS master %s", self.master)

    def _register_as(self, method: str, topic: str, form: Form) -> Any:
        if self._evicted:  # by another one that registers at the same time: to go on would end it
            raise RosError(self.problem)
        return call(self.master, method, self.name, topic, form.kind, self.uri)

    def _uri_of(self, node: str) -> str:
        try:
            return str(call(self.master, "lookupNode", self.name, node))
        except RosError:
            return ""

    def _revive(self, publishers: Mapping[str, list[str]], subscribers: Mapping[str, list[str]]) -> None:
        """Find lost subscribers: those that the master lists, and that are not connected. Queue them to be told again.

        Each is told of this node every REVIVE_S: by itself it would wait for minutes after the network was cut.
        """
        now = time.monotonic()
        missing: dict[tuple[str, str], float] = {}
        for topic, publication in self._publications.items():
            connected = publication.names
            for node in subscribers.get(topic, [])[:MOST_PEERS]:
                if node not in connected and node != self.name:
                    missing[topic, node] = self._missing.get((topic, node), now)
        for (topic, node), since in missing.items():
            if now - since >= REVIVE_S:
                missing[topic, node] = now
                self._lost[topic, node] = publishers.get(topic, [])
        self._missing = missing
        self._wake_lost.set()

    def _run_lost(self) -> None:
        while not self._ends.is_set():
            self._wake_lost.wait()
            self._wake_lost.clear()
            while self._lost and not self._ends.is_set():
                topic, node = next(iter(tuple(self._lost)))  # the oldest; a copy, as another thread adds to it
                publishers = self._lost.pop((topic, node))
                self._attempt_call(partial(self._tell, topic, node, publishers))

    def _tell(self, topic: str, node: str, publishers: list[str]) -> None:
        uri = self._uri_of(node)
        others = filter(None, [self._uri_of(name) for name in publishers if name != self.name])
        self._revived += 1  # rospy ignores an address that it believes to be connected to, and any path is ours
        call(uri, "publisherUpdate", "/master", topic, [*others, f"{self.uri}{self._revived}/"])
        log.info("%s: told %s again that this node publishes it", topic, node)

    def _connect_soon(self, subscription: Subscription, source: Source) -> None:
        source.asked = True
        try:
            self._calls.put_nowait(lambda: self._connect(subscription, source))
        except queue.Full:
            source.asked = False
            self._refuse("waiting calls", "calls of other nodes that waited")

    def _attempt_call(self, job: Callable[[], None]) -> None:
        try:
            job()
        except Exception as error:  # noqa: BLE001 - answers of others may be anything, and this thread must not end
            log.debug("%s: %s", type(error).__name__, error)

    def _connect(self, subscription: Subscription, source: Source) -> None:
        """Ask a publisher for the address of its topic, and connect to it."""
        sock = None
        try:
            _, host, port = call(source.uri, "requestTopic", self.name, subscription.topic, [["TCPROS"]])
            sock = socket.create_connection((host, int(port)), timeout=CALL_S)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _QUIET_S)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _PROBE_S)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _PROBES)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            form, topic = subscription.form, subscription.topic
            sock.sendall(pack_header(callerid=self.name, topic=topic, md5sum=form.md5, type=form.kind, tcp_nodelay="1"))
            sock.setblocking(False)
        except BaseException:
            if sock is not None:
                sock.close()
            source.asked = False
            raise
        source.sock, source.greeted, source.blocks = sock, False, Blocks(MOST_MESSAGE)
        register = self._select.register
        self._in_sockets(lambda: register(sock, selectors.EVENT_READ, lambda: self._read(subscription, source, sock)))

    # -- the thread of sockets

    def _in_sockets(self, job: Callable[[], Any]) -> None:
        self._jobs.put(job)
        self._wake()

    def _wake(self) -> None:
        with suppress(OSError):  # it is full: the thread is awake
            self._waker.send(b"x")

    def _close(self, sock: socket.socket) -> None:
        def close() -> None:
            with suppress(KeyError, ValueError):
                self._select.unregister(sock)
            sock.close()

        self._in_sockets(close)

    def _run_sockets(self) -> None:
        """Serve the sockets until the node ends; close connections that have said nothing for GREETING_S."""
        while not self._ends.is_set():
            for key, _ in self._select.select(0.25 if self._greetings else 1.0):
                self._attempt(key.data)
            while not self._jobs.empty():
                self._attempt(self._jobs.get())
            now = time.monotonic()
            silent = [subscriber for subscriber, began in self._greetings.items() if now - began > GREETING_S]
            for subscriber in silent:
                self._end_greeting(subscriber)
                self._refuse("greetings", "connections that said nothing")
        for key in list(self._select.get_map().values()):
            key.fileobj.close()  # type: ignore[union-attr]  # all of them are sockets

    def _attempt(self, job: Callable[[], None]) -> None:
        """Call a job. An exception ends at most one connection."""
        try:
            job()
        except Exception:  # noqa: BLE001 - of any connection
            self._log.exception("sockets", "a connection of ROS failed")
            time.sleep(0.05)  # what fails at once may fail again at once

    def _refuse(self, reason: str, what: str) -> None:
        self.counters.add(f"ros_{reason.replace(' ', '_')}")
        self._log.warning(reason, "dropped %s", what)

    def _accept(self) -> None:
        sock, _ = self._listener.accept()
        subscriber = Subscriber(sock)
        if len(self._greetings) >= _MOST_GREETINGS:
            self._refuse("greetings", "connections, since too many said nothing")
            sock.close()
            return
        self._greetings[subscriber] = time.monotonic()
        self._select.register(sock, selectors.EVENT_READ, lambda: self._hear(subscriber))

    def _end_greeting(self, subscriber: Subscriber) -> None:
        del self._greetings[subscriber]
        self._close(subscriber.sock)

    def _hear(self, subscriber: Subscriber) -> None:
        """Read what a subscriber has sent: first its request, later only its end."""
        publication = subscriber.publication
        try:
            chunk = subscriber.sock.recv(4096)
            if not chunk:
                raise RosError("it has closed the connection")
            if publication is not None:
                raise RosError("it sends what is not expected")
            blocks = subscriber.blocks.feed(chunk)
            if blocks:  # none while the request is incomplete; what follows it is ignored
                self._greet(subscriber, parse_header(blocks[0]))
        except BlockingIOError:
            return
        except (OSError, RosError) as error:
            if publication is not None:
                publication.remove(subscriber, str(error))
            elif subscriber in self._greetings:  # else it was added, or ended, already
                self._end_greeting(subscriber)

    def _greet(self, subscriber: Subscriber, fields: Mapping[str, str]) -> None:
        """Answer the request of a subscriber, and add it to its publication. Raises RosError if it is refused."""
        topic, md5 = fields.get("topic", ""), fields.get("md5sum", "")
        subscriber.name = fields.get("callerid", "?")[:100]
        publication = None if self._evicted else self._publications.get(topic)
        if publication is None or md5 not in ("*", publication.form.md5):
            self._log.warning("refused", "refused %s: it wants %.100s of type %.100s", subscriber.name, topic,
                              fields.get("type", "?"))  # fmt: skip
            subscriber.sock.send(pack_header(error=f"{topic} is not published here, or of another type"))
            raise RosError("refused")
        form = publication.form
        subscriber.sock.send(
            pack_header(
                callerid=self.name, topic=topic, md5sum=form.md5, type=form.kind, latching="0",
                message_definition=publication.definition,
            )
        )  # fmt: skip
        if not publication.add(subscriber):
            self._refuse("subscribers", f"a subscriber of {topic}: it has {MOST_PEERS} already")
            raise RosError("there are too many subscribers")
        del self._greetings[subscriber]
        if self._evicted:  # meanwhile, on another thread
            publication.remove(subscriber, "this node was ended")

    def _update(self, subscription: Subscription, uris: list[str]) -> None:
        """Connect to new publishers of a topic; forget those that are neither listed nor connected."""
        sources = subscription.sources
        for uri in [uri for uri, source in sources.items() if uri not in uris and source.sock is None]:
            del sources[uri]
        for uri in uris:
            if uri == self.uri or uri in sources:
                continue
            if len(sources) >= MOST_PEERS:
                self._refuse("publishers", f"a publisher of {subscription.topic}: it has {MOST_PEERS} already")
                return
            sources[uri] = source = Source(uri)
            self._connect_soon(subscription, source)

    def _read(self, subscription: Subscription, source: Source, sock: socket.socket) -> None:
        """Take what a publisher has sent: first the answer to our header, then messages. Close a lost connection."""
        try:
            chunk = sock.recv(65_536)
            if not chunk:
                raise RosError("it has closed the connection")
            for body in source.blocks.feed(chunk):
                if source.greeted:
                    subscription.receive(body)
                else:
                    self._take_greeting(source, parse_header(body))
        except BlockingIOError:
            return
        except (OSError, RosError) as error:
            self._log.log(subscription.topic, logging.INFO, "%s: %s is gone: %s", subscription.topic, source.uri, error)
            self._close(sock)
            source.sock, source.asked = None, False  # it is asked again at the next check, if it is still listed

    def _take_greeting(self, source: Source, fields: Mapping[str, str]) -> None:
        if "error" in fields:
            raise RosError(fields["error"][:200])
        source.greeted = True
