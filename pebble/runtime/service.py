"""The base class of services: one thread, an inbox, timers, a lifecycle, and channels instead of topics."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from math import inf
from typing import Any, ClassVar, TypeVar

from pebble.config import Config
from pebble.contract import ESTOP, Channel, Kind, codec
from pebble.runtime.addresses import Addresses
from pebble.runtime.inbox import Inbox
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.runtime.receive import Refusals
from pebble.runtime.timers import Timer, Timers
from pebble.runtime.work_lock import WorkLock
from pebble.transports import Message, QoS, State, Subscription, Transport
from pebble.transports.counters import Counters, bounds_reached

_QOS = {int(qos): qos for qos in QoS}  # a lookup costs a third of a call of the class
_SENDERS = 16  # of commands, each with remarks of its own
_SENDER_SHOWN = 40  # characters
WAIT_LIMIT_S = 0.5  # of a drive command in the inbox; with a transport's silence limit of 2 s, none acts after 2.5 s

Method = TypeVar("Method", bound=Callable[..., None])


def on(channel: Channel, *, direct: bool = False) -> Callable[[Method], Method]:
    """Mark a method as the handler of ``channel``; it is called with the decoded payload.

    For a pattern channel, the names in the topic are further arguments: ``def report(self, report, program)``.
    ``direct`` is for a handler with its own inbox: it runs on the transport's thread and must return at once. It gets
    the time of arrival on ``clock`` as well: ``def drive(self, drive, arrived)``. Channels are subscribed to in the
    order of their methods.
    """

    def mark(method: Method) -> Method:
        method.__dict__["channel"] = channel
        method.__dict__["direct"] = direct
        return method

    return mark


def every(seconds: float) -> Callable[[Method], Method]:
    """Mark a method so that it is called every ``seconds``."""

    def mark(method: Method) -> Method:
        method.__dict__["period"] = seconds
        return method

    return mark


def _fail(failure: Exception) -> None:
    raise failure


def _marked(cls: type, mark: str) -> list[str]:
    """Return the names of the methods with this mark, in the order of their definition, base classes first."""
    names = dict.fromkeys(name for base in reversed(cls.__mro__) for name in vars(base))
    return [name for name in names if mark in getattr(getattr(cls, name), "__dict__", ())]


class Service:
    """A process of a robot. Handlers and timers run one at a time, on the thread that called :meth:`run`: no locks.

    Only two things run on other threads: jobs for :meth:`run_if_idle`, while the service is idle, and handlers marked
    ``direct``, at any time.

    A subclass gives ``name``, marks methods with ``@on`` and ``@every``, opens its device in ``start`` and leaves it
    safe in ``stop``. A reader thread of a blocking device only ever calls ``post`` or ``run_if_idle``.
    Every attribute is set in ``__init__``. ``start`` opens, and registers with :meth:`on_stop` what closes::

        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self._remote = remote_transport(self.config, "lamp")

        def start(self) -> None:
            self._remote.open(timeout=0.0)
            self.on_stop(self._remote.close)

    Times come from ``clock``, which tests may replace.
    """

    name: ClassVar[str]
    client_name: ClassVar[str] = ""  # of its transport, after the robot's base; empty: the service's name
    as_published: ClassVar[bool] = False  # its transport shows retain flags as they were published (T7)

    def __init__(
        self, config: Config, transport: Transport, *, instance: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.config, self.transport, self.instance, self.clock = config, transport, instance, clock
        self.addresses = Addresses(config)
        transport.policy.is_stop = self.addresses[ESTOP].topic.__eq__  # stops pass even if too many messages wait
        self.log = logging.getLogger(f"pebble.{self.name}")
        self.counters = Counters()
        self.timers = Timers()
        self.log_limited = RateLimitedLog(self.log)
        self.refusals = Refusals(self.log_limited, self.counters)
        self._remarks = RateLimitedLog(self.log, period_s=60.0, most=_SENDERS)  # on commands that are carried out
        self._inbox = Inbox()
        self._work = WorkLock()
        self._states: dict[str, tuple[Channel, bytes]] = {}  # the newest ones, by topic, to be published again
        self._handled: dict[Channel, Subscription] = {}  # of methods marked with @on
        self._on_stop = ExitStack()
        self.running = True

    # -- to override

    def start(self) -> None:
        """Open the hardware, before the transport is open. An exception ends the process; the launcher restarts it."""

    def stop(self) -> None:
        """Leave the hardware safe. Called however :meth:`run` ends, before :meth:`on_stop` callbacks; not if killed."""

    def on_connected(self) -> None:
        """React to a new connection. The states are published afterwards."""

    # -- to use

    def on_stop(self, callback: Callable[[], object]) -> None:
        """Call ``callback`` after :meth:`stop`, however :meth:`run` ends; the last one added is called first.

        All are called even if one raises.
        """
        self._on_stop.callback(callback)

    def dropped(self) -> dict[str, int]:
        """Return how many messages were dropped since the start because of a limit, by reason, for the log."""
        return bounds_reached(self.transport.counters) | {"late": self.counters["late"]}

    def publish(self, channel: Channel, value: Any, **names: str) -> bool:
        """Send ``value`` on ``channel`` to its effective topic; ``names`` fill a pattern channel's levels."""
        topic = self._topic(channel, names)
        raw = codec.encode(channel, value)
        if channel.kind is Kind.STATE:
            self._states[topic] = (channel, raw)
        return self._send(channel, topic, raw)

    def retract(self, channel: Channel, **names: str) -> None:
        """Clear the retained message of a STATE ``channel``, and publish that state no more."""
        topic = self._topic(channel, names)
        if self._states.pop(topic, None) is not None:
            self._send(channel, topic, b"")

    def clear(self, channel: Channel, **names: str) -> None:
        """Clear the retained message on ``channel``, whichever process published it."""
        self._send(channel, self._topic(channel, names), b"")

    def republish(self) -> None:
        """Publish all states again."""
        for topic, (channel, raw) in self._states.items():
            self._send(channel, topic, raw)

    def listen(self, channel: Channel, method: Callable[..., None], *, direct: bool = False) -> Subscription:
        """Handle ``channel`` as ``@on`` does, also with its ``direct``, but only until the subscription is closed."""

        def deliver_direct(message: Message, value: Any, names: dict[str, str]) -> None:
            method(value, self.clock() - message.waited_s, **names)

        deliver = deliver_direct if direct else partial(self._deliver, channel, method)
        receive = self.refusals.reader(channel, deliver, self._remark)
        topic = self.addresses[channel].topic
        return self.transport.subscribe(topic, receive, qos=QoS(channel.default_qos), direct=True)  # `receive` is quick

    def refused(self, channel: Channel) -> bool:
        """True if the other end refuses to deliver ``channel`` to its ``@on`` method (T21 in docs/transports.md)."""
        return channel in self._handled and self._handled[channel].refused

    def post(self, job: Callable[[], None], *, newest_of: str | None = None) -> None:
        """Run ``job`` on the service's thread. With ``newest_of``, it replaces a waiting job of that name.

        A failure ends the service: this is for jobs of its device and its connections.
        """
        self._inbox.post(job, newest_of=newest_of)

    def post_message(self, channel: Channel, job: Callable[[], None], *, newest_of: str | None = None) -> None:
        """Run ``job``, for a message on ``channel``, as :meth:`post` does. A failure counts as one of a handler."""
        self._inbox.post(lambda: self._attempt(channel, job), newest_of=newest_of)

    def post_first(self, job: Callable[[], None]) -> None:
        """Run ``job`` before all waiting jobs. It is never dropped, so only one job of a kind may wait."""
        self._inbox.post_internal(job)

    def run_if_idle(self, job: Callable[[], None]) -> bool:
        """Run ``job`` now, on the calling thread, if the service is idle. False: it was not run, so post it.

        This saves a switch of threads, which costs more than most jobs. A service is idle if it does nothing and no job
        waits; a service that hangs is not idle. ``job`` must neither block nor take long. A failure ends the service.
        """
        work = self._work
        if not work.try_enter():
            return False
        try:
            if self._inbox:
                return False
            job()
            if self.timers.next_due < work.wakes_at:  # ``job`` has set an earlier timer than the service's thread knows
                self._inbox.wake()
        except Exception as failure:  # noqa: BLE001 - raised again on the service's thread, which it ends
            self.post_first(partial(_fail, failure))
        finally:
            work.leave()
        return True

    def call_at(self, due: float, job: Callable[[], None]) -> Timer:
        """Run ``job`` at ``due`` on ``clock``, on the service's thread. Call it there, or from `run_if_idle`."""
        return self.timers.add(due, job)

    def quit(self) -> None:
        """End :meth:`run` soon. Safe from any thread and from signal handlers."""
        self.running = False
        self._inbox.post_internal(lambda: None)

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Run until :meth:`quit`. ``ready`` is called once the service has subscribed."""
        try:
            with self._work:
                self.set_up()
            ready()
            while self.running:
                wakes_at = self._work.wakes_at
                self.turn(None if wakes_at == inf else max(0.0, wakes_at - self.clock()))
        finally:
            self._tear_down()

    # -- the service's thread

    def set_up(self) -> None:
        """Start and subscribe; :meth:`run` does it first."""
        self.start()
        self.transport.on_state(self._on_state)
        self.transport.open(timeout=0.0)
        for name in _marked(type(self), "channel"):
            method = getattr(self, name)
            self._handled[method.channel] = self.listen(method.channel, method, direct=method.direct)
        self._set_timers()

    def turn(self, timeout: float | None) -> bool:
        """Run the next job, if one comes within ``timeout`` seconds, and due timers. True if there was a job."""
        self._inbox.wait(timeout)
        with self._work:
            job = self._inbox.take()
            if job is not None:
                job()
            self.timers.run_due(self.clock())
            self._work.wakes_at = self.timers.next_due  # for `run_if_idle` on other threads
        return job is not None

    def _tear_down(self) -> None:
        self._work.shut()
        try:
            with self._on_stop:
                self.stop()
        finally:
            counts = {**self.dropped(), "inbox": self._inbox.dropped}
            dropped = {reason: count for reason, count in counts.items() if count}
            for words, numbers in (("refused in all", self.log_limited.totals()), ("dropped in all", dropped)):
                if numbers:
                    self.log.info("%s: %s", words, numbers)
            self.transport.close()

    def _set_timers(self) -> None:
        now = self.clock()
        for name in _marked(type(self), "period"):
            method = getattr(self, name)
            self.timers.add(now, method, period=method.period)
        interval = self.config.services.defaults.retained_publish_interval_seconds
        if interval > 0:
            self.timers.add(now + interval, self.republish, period=interval)

    def _begin_connection(self) -> None:
        self.on_connected()
        self.republish()

    def _topic(self, channel: Channel, names: dict[str, str]) -> str:
        return self.addresses[channel].topic if not names else channel.topic(self.config.base, **names)

    def _send(self, channel: Channel, topic: str, raw: bytes) -> bool:
        address = self.addresses[channel]
        return self.transport.publish(topic, raw, qos=_QOS[address.qos], retain=address.retain)

    def _handle(self, channel: Channel, method: Callable[[], None], arrived: float) -> None:
        """Call the handler, unless the message has waited too long in a hung or suspended process.

        Only commands of which a newer one replaces a waiting one (``Channel.newest``) are dropped.
        """
        if channel.kind is Kind.COMMAND and channel.newest and self.clock() - arrived > WAIT_LIMIT_S:
            self.count_late(channel)
            return
        self._attempt(channel, method)

    def _attempt(self, channel: Channel, method: Callable[[], None]) -> None:
        """Call a handler, and count an exception: a retained message would otherwise end the service repeatedly."""
        try:
            method()
        except Exception:  # a message of another process must not end this one
            self.counters.add("handler_errors")
            self.log_limited.exception(f"{channel.metric} failed", "failed on a message on %s", channel.metric)

    def count_late(self, channel: Channel) -> None:
        """Count and log a command that the caller drops because it has waited longer than WAIT_LIMIT_S."""
        self.counters.add("late")
        self.log_limited.warning(f"{channel.metric} late", "dropped a late %s", channel.metric)

    # -- the transport's threads: decode and post, nothing else

    def _deliver(self, channel: Channel, method: Callable[..., None], message: Message, value: Any, names: Any) -> None:
        """Post a valid message to the inbox, where it may replace a waiting one."""
        arrived = self.clock() - message.waited_s

        def handle() -> None:
            # While the machine is suspended, the service's clock may stand still, but the message's goes on.
            self._handle(channel, lambda: method(value, **names), min(arrived, self.clock() - message.waited_s))

        if channel.newest:
            self._inbox.post(handle, newest_of=message.topic)
        else:  # what ends something is named, so that it is dropped last, and waits behind earlier commands
            self._inbox.post(handle, last_of=message.topic if channel.ends(value) else None)

    def _remark(self, channel: Channel, sender: str, text: str) -> None:
        """Log a remark about a command that its sender may not have meant, once a minute for each sender."""
        origin = f", from {sender[:_SENDER_SHOWN]!a}" if sender else ""
        self._remarks.warning(channel.metric + origin, "%s%s: %s", channel.metric, origin, text)

    def _on_state(self, state: State) -> None:
        if state is State.CONNECTED:
            self._inbox.post_internal(self._begin_connection)
