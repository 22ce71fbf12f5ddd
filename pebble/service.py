"""What every service shares: one thread, an inbox, timers, a lifecycle, and channels instead of topics."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

from pebble import codec
from pebble.addresses import Addresses
from pebble.config import Config
from pebble.contract import Channel, Kind
from pebble.errors import PayloadError
from pebble.inbox import Inbox
from pebble.rate_limit import RateLimitedLog
from pebble.timers import Timer, Timers
from pebble.transports import Message, QoS, State, Subscription, Transport
from pebble.transports.counters import Counters

_ONE_SHOT = (Kind.COMMAND, Kind.ACTION, Kind.FEED)
_WAIT_LIMIT_S = 0.5  # of a steering command in the inbox; after a transport's silence of 2 s, none acts after 2.5 s

Method = TypeVar("Method", bound=Callable[..., None])


def on(channel: Channel) -> Callable[[Method], Method]:
    """Mark a method as the handler of ``channel``; it is called with the decoded payload.

    That of a pattern is also told by name what filled its levels: ``def hear(self, report, program)``.
    """

    def mark(method: Method) -> Method:
        method.__dict__["channel"] = channel
        return method

    return mark


def every(seconds: float) -> Callable[[Method], Method]:
    """Mark a method to be called every ``seconds``."""

    def mark(method: Method) -> Method:
        method.__dict__["period"] = seconds
        return method

    return mark


def _marked(cls: type, mark: str) -> list[str]:
    """Names of the methods that carry ``mark``, base classes included."""
    return [name for name in dir(cls) if mark in getattr(getattr(cls, name), "__dict__", ())]


class Service:
    """One process of a robot. Handlers and timers all run on the thread that called :meth:`run`: no locks needed.

    A subclass gives ``name`` and ``publishes``, marks methods with ``@on`` and ``@every``, opens its device in
    ``start`` and leaves it safe in ``stop``. A reader thread of a blocking device only ever calls ``post``.
    """

    name: ClassVar[str]
    publishes: ClassVar[tuple[Channel, ...]] = ()
    client_name: ClassVar[str] = ""  # of its transport, after the robot's base; empty: the service's name
    as_published: ClassVar[bool] = False  # how its transport is opened, where there is a choice (T7)

    def __init__(self, config: Config, transport: Transport, *, instance: str = "") -> None:
        self.config, self.transport, self.instance = config, transport, instance
        self.addresses = Addresses(config)
        self.log = logging.getLogger(f"pebble.{self.name}")
        self.counters = Counters()
        self.timers = Timers()
        self._quiet_log = RateLimitedLog(self.log)
        self._inbox = Inbox()
        self._states: dict[str, tuple[Channel, bytes]] = {}
        self._running = True

    # -- to override

    def start(self) -> None:
        """Open hardware; the transport is not open yet. Raise to exit, the launcher starts us again."""

    def stop(self) -> None:
        """Leave hardware safe. Runs however the service ends."""

    # -- to use

    def publish(self, channel: Channel, value: Any, **names: str) -> bool:
        """Send ``value`` on ``channel`` as its address says; ``names`` fill a pattern channel's levels."""
        topic = self._topic(channel, names)
        raw = codec.encode(channel, value)
        if channel.kind is Kind.STATE:
            self._states[topic] = (channel, raw)
        return self._send(channel, topic, raw)

    def retract(self, channel: Channel, **names: str) -> None:
        """Take back what is kept on a STATE ``channel``, here and in its kept copy."""
        topic = self._topic(channel, names)
        if self._states.pop(topic, None) is not None:
            self._send(channel, topic, b"")

    def listen(self, channel: Channel, method: Callable[..., None]) -> Subscription:
        """Handle ``channel`` from now on, as ``@on`` does from the start; until the subscription is closed."""

        def receive(message: Message) -> None:
            self._receive(channel, method, message)

        topic = self.addresses[channel].topic
        return self.transport.subscribe(topic, receive, qos=QoS(channel.default_qos), direct=True)

    def post(self, job: Callable[[], None], *, newest_of: str | None = None) -> None:
        """Run ``job`` on the service's thread. With ``newest_of``, a waiting job of that name is replaced."""
        self._inbox.post(job, newest_of=newest_of)

    def call_at(self, due: float, job: Callable[[], None]) -> Timer:
        """Run ``job`` at ``due`` on ``time.monotonic()``, on the service's thread (call from there)."""
        return self.timers.add(due, job)

    def quit(self) -> None:
        """End :meth:`run` soon. Safe from any thread and from signal handlers."""
        self._running = False
        self._inbox.post_internal(lambda: None)

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Live until :meth:`quit`. ``ready`` is called once the service listens."""
        try:
            self.start()
            self.transport.on_state(self._on_state)
            self.transport.open(timeout=0.0)
            for name in _marked(type(self), "channel"):
                method = getattr(self, name)
                self.listen(method.channel, method)
            self._set_timers()
            ready()
            self._loop()
        finally:
            try:
                self.stop()
            finally:
                self._say_totals()
                self.transport.close()

    @classmethod
    def handles(cls) -> tuple[Channel, ...]:
        """The channels this service listens to."""
        return tuple(getattr(cls, name).channel for name in _marked(cls, "channel"))

    # -- the service's thread

    def _loop(self) -> None:
        while self._running:
            job = self._inbox.take(self.timers.wait(time.monotonic()))
            if job is not None:
                job()
            self.timers.run_due(time.monotonic())

    def _set_timers(self) -> None:
        now = time.monotonic()
        for name in _marked(type(self), "period"):
            method = getattr(self, name)
            self.timers.add(now, method, period=method.period)
        interval = self.republish_interval_s
        if interval > 0:
            self.timers.add(now + interval, self._republish, period=interval)

    @property
    def republish_interval_s(self) -> float:
        """How often kept state is said again; 0 for never."""
        return self.config.services.defaults.retained_publish_interval_seconds

    def _republish(self) -> None:
        for topic, (channel, raw) in self._states.items():
            self._send(channel, topic, raw)

    def _topic(self, channel: Channel, names: dict[str, str]) -> str:
        return self.addresses[channel].topic if not names else channel.topic(self.config.base, **names)

    def _send(self, channel: Channel, topic: str, raw: bytes) -> bool:
        address = self.addresses[channel]
        return self.transport.publish(topic, raw, qos=QoS(address.qos), retain=address.retain)

    def _say_totals(self) -> None:
        totals = self._quiet_log.totals()
        if totals or self._inbox.dropped:
            self.log.info("refused in all: %s; dropped from the inbox: %d", totals or "nothing", self._inbox.dropped)

    def _handle(self, channel: Channel, method: Callable[[], None], arrived: float) -> None:
        """Call the handler, unless we hung or stood still for so long that nobody means this command any more.

        Only where newer ones follow: of others none may be missed.
        """
        if channel.kind is Kind.COMMAND and channel.newest and time.monotonic() - arrived > _WAIT_LIMIT_S:
            self.counters.add("late")
            self._quiet_log.warning(f"{channel.metric} late", "dropped a late %s", channel.metric)
            return
        method()

    # -- the transport's threads: decode and post, nothing else

    def _receive(self, channel: Channel, method: Callable[..., None], message: Message) -> None:
        """Refuse what is stale or malformed *before* it may take a newer message's place in the inbox."""
        if message.retain and channel.kind in _ONE_SHOT:
            self.counters.add("stale")
            self._quiet_log.warning(f"{channel.metric} kept", "refused a kept copy of %s", channel.metric)
            return
        try:
            value = codec.decode(channel, message.payload)
        except PayloadError as error:
            self.counters.add("refused")
            self._quiet_log.warning(channel.metric, "refused a message: %s", error)
            return
        arrived = time.monotonic()
        names = channel.names(message.topic) if channel.is_pattern else {}
        self._inbox.post(
            lambda: self._handle(channel, lambda: method(value, **names), arrived),
            newest_of=message.topic if channel.newest else None,
        )

    def _on_state(self, state: State) -> None:
        if state is State.CONNECTED:
            self._inbox.post_internal(self._republish)
