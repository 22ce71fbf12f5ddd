"""An operator's connection to several brokers that know nothing of each other: all are heard, each robot at its own.

A robot uses one host at a time. Where its newest live heartbeat came from, it is; what other hosts send of it is older:
the will that one speaks after the robot has left, and what it retained before. No clock is compared.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable
from typing import Any

from pebble.contract import CHANNELS, ESTOP, ONLINE, channel_of, codec
from pebble.contract.identity import Direction, ParsedTopic, parse_topic
from pebble.errors import PayloadError
from pebble.transports import Message, MqttSettings, Outgoing, QoS, State, Subscription, Transport, create

log = logging.getLogger(__name__)

CHANGE_S = 0.5  # a host counts as the robot's own for so long after its newest heartbeat there,
_SLOWEST_S = 2.0  # and on a slow link for half as long again as these are apart, or this
MAX_ROBOTS = 2000  # whose host is known; of others what all hosts send is shown, and all receive what is meant for them
_MAX_TOPICS = 64  # of one of them, which are asked for when it changes its host
_SILENT_S = 10.0  # such robots make room for others, so often at most
_READY_S = 0.5  # after the first host is connected: until then all others should be, and heartbeats have come
_OWN_S = 3.0  # longer no host takes to deliver what it lets pass: a connection that is silent ends earlier
_LATE_S = 0.25  # some brokers send what they retain so long after they have answered
_HEARTBEATS = {one.metric: one for one in CHANNELS if ONLINE.metric in (one.metric, one.synonym_of)}


class Home:
    """Where one robot is: a number of a host."""

    __slots__ = ("at", "host", "interval_s", "topics")

    def __init__(self) -> None:
        self.host: int | None = None  # not known: it ended there, the connection is lost, or no heartbeat has come
        self.at = float("-inf")  # of its newest heartbeat there
        self.interval_s = 0.0  # between that and the one before
        self.topics: dict[str, set[int]] = {}  # of its states: the hosts that have sent one


class Homes:
    """At which host each robot is. Pure; the owner's lock guards it.

    Anybody can invent robots: those that are silent make room for one that is not.
    """

    def __init__(self) -> None:
        self._robots: dict[str, Home] = {}
        self._swept_at = float("-inf")

    def get(self, base: str) -> Home | None:
        """None: it has no place."""
        home = self._robots.get(base)
        if home is None and len(self._robots) < MAX_ROBOTS:
            home = self._robots[base] = Home()
        return home

    def of(self, base: str) -> int | None:
        home = self._robots.get(base)
        return None if home is None else home.host

    def heartbeat(self, base: str, host: int, now: float) -> bool:
        """A live heartbeat has come from ``host``; whether the robot is there only since now."""
        if len(self._robots) >= MAX_ROBOTS and base not in self._robots and now - self._swept_at > _SILENT_S:
            self._swept_at = now
            self._robots = {name: one for name, one in self._robots.items() if now - one.at < _SILENT_S}
        home = self.get(base)
        if home is None:
            return False
        is_new = home.host != host
        if is_new and home.host is not None and now - home.at < max(CHANGE_S, 1.5 * home.interval_s):
            return False  # one that was on its way for long
        home.interval_s = 0.0 if is_new else min(now - home.at, _SLOWEST_S)
        home.host, home.at = host, now
        return is_new

    def ended(self, base: str, host: int) -> None:
        """Its will was published there: the next heartbeat may come from anywhere."""
        if (home := self._robots.get(base)) is not None and home.host == host:
            home.host = None

    def lost(self, host: int) -> None:
        """That connection is lost."""
        for home in self._robots.values():
            if home.host == host:
                home.host = None


class EveryHost(Transport):
    """Behaves as one connection. Commands go to the host where their robot is, stops and what is retained to all.

    A robot whose host is not known receives commands at all of them: it is at one. ``moved`` is called, on a thread of
    the transport, with the base of a robot that has changed its host.
    """

    moved: Callable[[str], None] = staticmethod(lambda _base: None)
    delivers_late = True  # what is asked for is delivered, whatever came before
    #: What is published on it every second, and subscribed to: a host that lets us in and does not deliver it, though
    #: another one does, lets us publish or receive nothing. Empty: that is not noticed.
    proof_topic = ""

    def __init__(self, client_id: str, settings: MqttSettings) -> None:
        self._hosts: tuple[Transport, ...] = ()  # super() sets `problem`
        super().__init__(client_id)
        self._places = [f"{one.host}:{one.port}" for one in settings.each()]
        self._hosts = tuple(create("mqtt", client_id, one) for one in settings.each())
        self._homes = Homes()
        self._delivering: set[int] = set()  # hosts that have delivered what was published
        self._owing: dict[int, float] = {}  # since when a host has not
        self._lock = threading.Condition(threading.RLock())
        self._asked: dict[str, int] = {}  # robots whose states are to be asked for, and where
        self._expected: dict[str, int] = {}  # topics that are asked for now, and where
        self._ready_at, self._was_connected = float("inf"), False
        self._inner: dict[Subscription, list[Subscription]] = {}
        self._thread: threading.Thread | None = None
        for number, one in enumerate(self._hosts):
            one.judge_topics(delivers_late=True)
            one.on_state(lambda state, number=number: self._on_state(number, state))  # type: ignore[misc]

    # -- where robots are

    def host_of(self, base: str) -> str:
        """Host and port of the broker where that robot is; empty if it is not known."""
        host = self._homes.of(base)
        return "" if host is None else self._places[host]

    def is_first(self, base: str) -> bool:
        """Whether the robot is at the preferred host, as far as is known."""
        return self._homes.of(base) in (0, None)

    def find(self, base: str, timeout_s: float) -> bool:
        """Wait until it is known where that robot is; whether it is."""
        end = time.monotonic() + timeout_s
        with self._lock:
            while self._homes.of(base) is None:
                left = end - time.monotonic()
                if left <= 0:
                    return False
                self._lock.wait(left)
        return True

    # -- what a transport does

    @property
    def problem(self) -> str:
        """Why hosts have no connection; those that have one are left out."""
        return "; ".join(one.problem for one in self._hosts if one.problem)

    @problem.setter
    def problem(self, text: str) -> None:
        """That of each host counts."""

    @property
    def not_received(self) -> str:
        """Which hosts are not heard, or not all that is asked for there, and why, while some host has a connection."""
        if not self._is_connected:
            return ""
        count, missing = len(self._hosts), [why for number in range(len(self._hosts)) if (why := self._why(number))]
        received = count - len(missing)
        return f"messages come from only {received} of {count} brokers: {'; '.join(missing)}" if missing else ""

    def _why(self, number: int) -> str:
        """Why that host is not heard; empty if it is."""
        one, place = self._hosts[number], f"broker {self._places[number]}"
        if one.state is not State.CONNECTED:
            return one.problem or f"{place} has not answered yet"
        if not_received := one.not_received:
            return f"{place}: {not_received}"
        silent = time.monotonic() - self._owing.get(number, float("inf")) > _OWN_S and self._delivering - {number}
        return f"{place} delivers nothing of what this account publishes: may it do both there?" if silent else ""

    @property
    def untried(self) -> bool:
        return any(one.untried for one in self._hosts)

    @property
    def outgoing(self) -> Outgoing:
        """What waits at the worst of those that are connected."""
        each = [one.outgoing for one in self._hosts if one.state is State.CONNECTED]
        return max(each, key=lambda one: one.stalled_s, default=Outgoing())

    def judge_topics(self, **judged: Any) -> None:
        super().judge_topics(**{key: value for key, value in judged.items() if key != "delivers_late"})
        for one in self._hosts:
            one.judge_topics(**{key: value for key, value in judged.items() if key not in ("delivers_late", "forms")})

    def suit_link(self, *, slow: bool) -> None:
        super().suit_link(slow=slow)
        for one in self._hosts:
            one.suit_link(slow=slow)

    def renew_connection(self, why: str) -> None:
        for one in self._hosts:
            one.renew_connection(why)

    def ask(self, topics: Collection[str]) -> None:
        for number, one in enumerate(self._hosts):
            own = [topic for topic in topics if self._home_of(topic) in (None, number)]
            if own and one.state is State.CONNECTED:
                one.ask(own)

    def _home_of(self, topic: str) -> int | None:
        parsed = parse_topic(topic)
        return None if parsed is None else self._homes.of(parsed.identity.base)

    def _open(self, timeout: float) -> None:  # noqa: ARG002  (base waits)
        self._ready_at, self._was_connected = float("inf"), False
        for number, one in enumerate(self._hosts):
            one.open(timeout=0.0)
            for metric in _HEARTBEATS:
                one.subscribe(
                    f"+/+/+/{Direction.OUTGOING}/{metric}",
                    lambda message, number=number: self._on_heartbeat(number, message),  # type: ignore[misc]
                    qos=QoS.LATEST,
                    direct=True,
                )
        self._thread = threading.Thread(target=self._run, name=f"pebble-hosts {self.client_id}", daemon=True)
        self._thread.start()

    def _close(self, will: Message | None) -> None:  # noqa: ARG002  (operators have none)
        with self._lock:
            self._inner.clear()
            self._lock.notify_all()
        for one in self._hosts:
            one.close()

    def _publish(self, message: Message, *, urgent: bool, remember: bool, shared: bool) -> bool:
        if self._state is State.CLOSED:
            self.counters.add("refused")
            return False
        if message.topic == self.proof_topic:
            self._expect_own()
        accepted = [
            one.publish(
                message.topic,
                message.payload,
                qos=message.qos,
                retain=message.retain,
                urgent=urgent,
                remember=remember,
                shared=shared,
            )
            for one in self._receivers(message)
        ]
        if not any(accepted):
            self.counters.add("refused")
            return False
        self._count_sent()
        return True

    def _expect_own(self) -> None:
        now = time.monotonic()
        for number, one in enumerate(self._hosts):
            if one.state is State.CONNECTED:
                self._owing.setdefault(number, now)

    def _receivers(self, message: Message) -> Iterable[Transport]:
        parsed = parse_topic(message.topic)
        if message.retain or parsed is None or parsed.direction is not Direction.INCOMING or _is_stop(parsed):
            return self._hosts
        host = self._homes.of(parsed.identity.base)
        return self._hosts if host is None else (self._hosts[host],)

    def _send(self, message: Message, urgent: bool) -> bool:
        return self._publish(message, urgent=urgent, remember=False, shared=False)

    def _declare(self, subscription: Subscription) -> None:
        made = [
            one.subscribe(
                subscription.filter,
                lambda message, number=number: self._take(number, subscription, message),  # type: ignore[misc]
                qos=subscription.qos,
                echo=subscription.echo,
                direct=True,
            )
            for number, one in enumerate(self._hosts)
        ]
        with self._lock:
            self._inner[subscription] = made

    def _undeclare(self, subscription: Subscription) -> None:
        with self._lock:
            made = self._inner.pop(subscription, [])
        for one in made:
            one.close()

    # -- the threads of the hosts

    def _on_state(self, number: int, state: State) -> None:
        self._owing.pop(number, None)
        with self._lock:
            if state is not State.CONNECTED:
                self._homes.lost(number)
            elif self._ready_at == float("inf"):
                self._ready_at = time.monotonic() + (0.0 if self._was_connected else _READY_S)
            self._lock.notify_all()
        if state is not State.CONNECTED and not self._is_connected:
            self._ready_at = float("inf")
            if self._state is State.CONNECTED:
                self._set_state(State.CONNECTING)

    @property
    def _is_connected(self) -> bool:
        return any(one.state is State.CONNECTED for one in self._hosts)

    def _on_heartbeat(self, number: int, message: Message) -> None:
        parsed = parse_topic(message.topic)
        if message.retain or parsed is None:
            return
        base, before = parsed.identity.base, self._homes.of(parsed.identity.base)
        with self._lock:
            if not _is_online(parsed.metric, message.payload):
                self._homes.ended(base, number)
                return
            if not self._homes.heartbeat(base, number, time.monotonic()):
                return
            if any(hosts != {number} for hosts in self._topics(base).values()):
                self._asked[base] = number
            self._lock.notify_all()
        if before is not None:
            log.info("%s is at %s now", base, self._places[number])
        self.moved(base)

    def _take(self, number: int, subscription: Subscription, message: Message) -> None:
        if message.topic == self.proof_topic:
            self._delivering.add(number)
            self._owing.pop(number, None)
        parsed = parse_topic(message.topic)
        if parsed is not None:
            with self._lock:
                self._note(number, parsed, message)
            if self._homes.of(parsed.identity.base) not in (None, number):
                self.counters.add("elsewhere")
                return
        self.count_received()
        subscription.offer(message)

    def _topics(self, base: str) -> dict[str, set[int]]:
        home = self._homes.get(base)
        return {} if home is None else home.topics

    def _note(self, number: int, parsed: ParsedTopic, message: Message) -> None:
        """Remember which topics of a robot hold its state."""
        if self._expected and self._expected.get(message.topic) == number:
            self._expected.pop(message.topic, None)
            if not self._expected:
                self._lock.notify_all()
        if parsed.direction is not Direction.OUTGOING:
            return
        channel = None if message.retain else channel_of(f"{parsed.direction}/{parsed.metric}")
        if not message.retain and (channel is None or not channel.default_retain):
            return
        if parsed.metric in _HEARTBEATS:
            return
        topics = self._topics(parsed.identity.base)
        hosts = topics.get(message.topic)
        if hosts is not None:
            hosts.add(number)
        elif len(topics) < _MAX_TOPICS:
            topics[message.topic] = {number}

    # -- its own thread

    def _run(self) -> None:
        while self._state is not State.CLOSED:
            with self._lock:
                now = time.monotonic()
                if self._state is State.CONNECTING and now >= self._ready_at and self._is_connected:
                    base = ""
                elif self._asked:
                    base = next(iter(self._asked))
                    number = self._asked.pop(base)
                    topics = list(self._topics(base))
                else:
                    waits = self._ready_at - now if self._state is State.CONNECTING else float("inf")
                    self._lock.wait(min(max(waits, 0.01), 1.0))
                    continue
            if base:
                self._refresh(number, topics)
            else:
                self._was_connected = True
                self._set_state(State.CONNECTED)

    def _refresh(self, number: int, topics: list[str]) -> None:
        """Have what the robot's own host retains delivered again, and remove what it does not have."""
        host = self._hosts[number]
        self._expected = dict.fromkeys(topics, number)
        host.ask(topics)
        with self._lock:
            self._lock.wait_for(lambda: not self._expected or self._state is State.CLOSED, _LATE_S)
            missing, self._expected = list(self._expected), {}
            if host.state is not State.CONNECTED or (missing and self._home_of(missing[0]) != number):
                return
            each = list(self._inner)
        for topic in missing:
            for subscription in self._subscriptions.matching(topic):
                if subscription in each:
                    subscription.offer(Message(topic, b"", QoS.DELIVERED, True))


def _is_stop(parsed: ParsedTopic) -> bool:
    return parsed.metric.rpartition("/")[2] == ESTOP.metric


def _is_online(metric: str, payload: bytes) -> bool:
    try:
        return getattr(codec.decode(_HEARTBEATS[metric], payload), "online", True) is not False
    except PayloadError:
        return True


def operators(client_id: str, kind: str, settings: Any) -> Transport:
    """An operator's transport, not yet opened: to all hosts, where there are several."""
    if isinstance(settings, MqttSettings) and settings.hosts:
        return EveryHost(client_id, settings)
    return create(kind, client_id, settings)
