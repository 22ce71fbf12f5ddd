"""The base of bridge and mirror: a connection on each side, and a forwarder between them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, ClassVar

from pebble.contract import BRIDGE_PROBE, INCOMING, OUTGOING
from pebble.forwarding.cycles import PROBE_PERIOD_S
from pebble.forwarding.forwarder import Forwarder
from pebble.forwarding.names import Names
from pebble.forwarding.observer import Step
from pebble.forwarding.retained_window import INITIAL_SYNC_S, QUIET_S
from pebble.forwarding.routing import Rules, Side
from pebble.forwarding.side import Gate
from pebble.forwarding.subjects import Subject, Subjects
from pebble.runtime.service import Service, every
from pebble.transports import Message, State, Subscription, Transport
from pebble.transports.counters import in_words

CHECK_AGAIN_S = 30.0  # while nothing is forwarded
CHECK_SOON_S = 1.0  # after the first sign that two sides are one: it may have been a copy


class ForwardingService(Service, ABC):
    """A service that forwards between the robot's own transport (the local side) and another one (the remote side).

    Messages are forwarded on the transports' receiving threads (see pebble.forwarding.forwarder); everything else
    happens on the service's own thread, so a burst of messages delays neither a heartbeat nor a probe.
    """

    as_published = True
    rules: ClassVar[Rules]
    probed_sides: ClassVar[tuple[Side, ...]]  # whose commands could circulate
    arriving_s: ClassVar[float] = 0.0  # longest wait for retained messages that still come after the subscription

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.remote = self.make_remote()
        self.subjects = Subjects(self.config)
        self.names = self.make_names()
        self.forwarder = Forwarder(
            self.subjects,
            self.rules,
            {Side.LOCAL: self.transport, Side.REMOTE: self.remote},
            winner=self.winner,
            names=self.names,
            on_value=self.on_value,
            pass_stop=self.pass_stop,
            steps=self.make_steps(),
            clock=self.clock,
        )
        self.epoch = 0  # grows whenever the remote side is not connected: what carries an older one is dropped
        self.subscriptions: dict[Side, list[Subscription]] = {side: [] for side in Side}

    # -- to implement

    @abstractmethod
    def make_remote(self) -> Transport:
        """Return the remote side's transport, not yet open; called while the service is made."""

    @property
    @abstractmethod
    def winner(self) -> Side:
        """Side whose retained messages count where the two sides differ."""

    def make_names(self) -> Names | None:
        """Return the finder of senders for the remote side; None if names are not checked."""
        return None

    def make_steps(self) -> Mapping[str, Step]:
        """Return the functions of extensions that may refuse a message, by extension."""
        return {}

    def on_value(self, subject: Subject, payload: bytes) -> None:
        """React to a value on which both sides agree. Called on any thread, with a lock held."""

    def pass_stop(self, side: Side, payload: bytes) -> Iterable[bytes]:  # noqa: ARG002
        """Return the payloads to forward for a stop received on ``side``. Called on any thread."""
        return (payload,)

    @abstractmethod
    def connected(self, side: Side, epoch: int) -> None:
        """React to a new connection of ``side``; ``epoch`` counts the outages of the remote side."""

    def disconnected(self, side: Side) -> None:
        """React to a lost connection."""
        if side is Side.REMOTE:
            self.unsubscribe(Side.REMOTE)

    @abstractmethod
    def await_retained(self) -> None:
        """Wait, for a limited time, until the retained messages of the remote side have arrived."""

    @abstractmethod
    def check_again(self, epoch: int) -> None:
        """Check whether forwarding may start again without a reconnect; ``epoch`` as in :meth:`connected`."""

    @abstractmethod
    def receive_local(self, message: Message) -> None:
        """Handle a message of the local side, on its thread."""

    @abstractmethod
    def receive_remote(self, epoch: int, message: Message) -> None:
        """Handle a message of the remote side, on its thread; ``epoch`` is the number of its connection."""

    # -- the life of the service

    def start(self) -> None:
        self.transport.on_state(partial(self.on_side_state, Side.LOCAL))
        self.remote.on_state(partial(self.on_side_state, Side.REMOTE))
        self.remote.open(timeout=0.0)
        self.on_stop(self.remote.close)
        self.post(self.subscribe_local)

    def dropped(self) -> dict[str, int]:
        return self.forwarder.dropped()

    def stop(self) -> None:
        self.log.info("messages: %s", in_words(self.forwarder.counters.snapshot()))

    # -- the service's thread

    def subscribe_local(self) -> None:
        self.subscriptions[Side.LOCAL] = [
            self.transport.subscribe(filter_, self.receive_local, echo=False, direct=True)
            for filter_ in self.subjects.filters(INCOMING, OUTGOING)
        ]

    def subscribe_remote(self) -> None:
        """Subscribe on a new connection, after the transport has sent what the robot changed during the outage.

        Because of this order, no retained message of the remote side is older than a change by the robot.
        """
        self.unsubscribe(Side.REMOTE)
        self.forwarder.sides[Side.REMOTE].subscribing()
        receive = partial(self.receive_remote, self.epoch)
        directions = (INCOMING,) if self.rules.leaves_robot else (INCOMING, OUTGOING)  # outside only we send OUTGOING
        self.subscriptions[Side.REMOTE] = [
            self.remote.subscribe(filter_, receive, echo=False, direct=True)
            for filter_ in self.subjects.filters(*directions)
        ]
        self.await_retained()
        self.forwarder.subscribed(Side.REMOTE)
        self.synchronize_later(Side.REMOTE)

    def unsubscribe(self, side: Side) -> None:
        while self.subscriptions[side]:
            self.subscriptions[side].pop().close()

    def synchronize_later(self, side: Side) -> None:
        """Exchange the values in which the sides differ, once the retained messages of ``side`` have arrived."""
        epoch, end = self.epoch, self.clock() + self.arriving_s  # end: when the wait for late ones ends

        def synchronize() -> None:
            if side is Side.REMOTE and self.forwarder.sides[side].window.is_arriving and self.clock() < end:
                self.call_at(self.clock() + QUIET_S, synchronize)  # some brokers send them late
            elif side is Side.LOCAL or epoch == self.epoch:  # the remote side has not been lost meanwhile
                self.forwarder.retained.synchronize(side)
                # Not before: a mirror at a wrong broker has stopped by now. After a loss of LOCAL only bridges probe.
                if side is Side.REMOTE or self.rules.leaves_robot:  # leaves_robot: this is the bridge
                    self.forwarder.publisher.probe_commands(*self.probed_sides)

        self.call_at(self.clock() + INITIAL_SYNC_S, synchronize)

    @every(PROBE_PERIOD_S)
    def _probe_again(self) -> None:
        self.forwarder.publisher.probe_again(self.probed_sides, self.forwarder.retained.value)

    @abstractmethod
    def found_one_broker(self) -> None:
        """React to a probe which shows that the two sides are, or may be, one broker; forwarding is stopped."""

    def forward_nothing(self, seconds: float) -> None:
        """Forward nothing until the next check, which comes at a reconnect or after ``seconds``."""
        self.forwarder.shut()  # again: it may just have been opened
        self.unsubscribe(Side.REMOTE)
        self.check_later(seconds)

    def check_later(self, seconds: float = CHECK_AGAIN_S) -> None:
        self.call_at(self.clock() + seconds, partial(self._check_if_shut, self.epoch))

    def _check_if_shut(self, epoch: int) -> None:
        if self.forwarder.gate is Gate.SHUT:
            self.check_again(epoch)

    # -- the transports' threads

    def on_side_state(self, side: Side, state: State) -> None:
        self.forwarder.sides[side].watch(state)
        if state is State.CONNECTED:
            self.post(partial(self.connected, side, self.epoch))
            return
        if side is Side.REMOTE:
            self.epoch += 1
        self.post(partial(self.disconnected, side))

    def shut(self) -> None:
        """Stop forwarding: both sides may be one broker. Call it on any thread; it posts `found_one_broker`."""
        if self.forwarder.gate is not Gate.SHUT:
            self.forwarder.shut()
            self.post_message(BRIDGE_PROBE, self.found_one_broker)
