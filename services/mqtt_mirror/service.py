"""The compatibility layer as a process: the robot's own topics on an MQTT broker too (docs/bridge.md)."""

from __future__ import annotations

import time
from functools import partial

from pebble import codec
from pebble.contract import BRIDGE_PROBE, INCOMING, ONLINE, OUTGOING
from pebble.errors import ConfigError, PayloadError
from pebble.forwarding.forwarder import SETTLE_S, Forwarder, Gate, barrier
from pebble.forwarding.routing import Side
from pebble.forwarding.subjects import Subjects
from pebble.links import mirror_transport
from pebble.service import Service
from pebble.services.mqtt_mirror.routing import MIRROR
from pebble.transports import Message, State, Subscription

_FRESH_BEATS = 3.0  # a heartbeat is alive for so many of its intervals
_LOOK_MAX_S = 1.0  # before anything is forwarded; a slow heart is told by its kept beat, which comes at once


class MqttMirror(Service):
    """Forwards between the robot's fabric (the local side) and a broker on the robot (the remote side).

    At a meeting the fabric is right. If the bridge's heartbeat shows up on the broker, that broker is the remote one:
    the bridge serves it already, and a second way to it would make messages circulate.
    """

    name = "mqtt_mirror"
    client_name = "mirror"
    as_published = True

    def start(self) -> None:
        mirror = self.config.transport.mqtt_mirror
        if mirror is None:
            raise ConfigError("transport.mqtt_mirror: name the broker that is to offer the robot's topics")
        bridge = self.config.services.mqtt_bridge
        self._probe_topic = BRIDGE_PROBE.topic(self.config.base)
        self._watched = frozenset({self._probe_topic} if bridge.enabled else ())
        if bridge.enabled and bridge.heartbeat.enabled:
            self._watched |= {self.addresses[ONLINE].topic}
        self._fresh_s = _FRESH_BEATS * bridge.heartbeat.interval_seconds
        self._subjects = Subjects(self.config)
        self._epoch = 0
        self._subscriptions: list[Subscription] = []
        self._broker = mirror_transport(self.config, mirror, "mirror-broker")
        self._forwarder = Forwarder(
            self._subjects,
            MIRROR,
            {Side.LOCAL: self.transport, Side.REMOTE: self._broker},
            winner=Side.LOCAL,
        )
        self.transport.on_state(self._on_fabric)
        self._broker.on_state(self._on_broker)
        self._broker.open(timeout=0.0)
        self.post(self._listen_to_fabric)

    def stop(self) -> None:
        if hasattr(self, "_broker"):
            self.log.info("forwarded and dropped: %s", self._forwarder.counters.snapshot())
            self._broker.close()

    # -- the service's thread

    def _listen_to_fabric(self) -> None:
        for filter_ in self._subjects.filters(INCOMING, OUTGOING):
            self.transport.subscribe(filter_, self._from_fabric, echo=False, direct=True)

    def _fabric_joined(self) -> None:
        self._forwarder.subscribed(Side.LOCAL)
        self.call_at(time.monotonic() + SETTLE_S, partial(self._forwarder.settle, Side.LOCAL))

    def _broker_joined(self, epoch: int) -> None:
        if epoch != self._epoch or self._forwarder.gate is Gate.SHUT:
            return
        if not self._broker.exact_echo:
            self._stand_down('sends our own messages back; use one with bridge mode (mosquitto), or protocol "5"')
        elif self._forwarder.gate is Gate.OPEN:
            self._listen_to_broker()
        else:
            self._look_first(epoch)

    def _look_first(self, epoch: int) -> None:
        """Is the heart of this robot beating on that broker?"""
        self._close_subscriptions()
        self._subscriptions = [
            self._broker.subscribe(topic, self._from_broker_watched, echo=False, direct=True)
            for topic in sorted(self._watched)
        ]
        look_s = min(self._fresh_s, _LOOK_MAX_S) if self._watched else 0.0
        self.call_at(time.monotonic() + look_s, partial(self._begin, epoch))

    def _begin(self, epoch: int) -> None:
        if epoch != self._epoch or self._forwarder.gate is not Gate.WAITING:
            return
        self.log.info("offering the robot's topics on its MQTT broker")
        self._forwarder.open()
        self._listen_to_broker()

    def _listen_to_broker(self) -> None:
        """Anew for each connection, once the transport has sent what changed meanwhile: what comes back is older."""
        self._close_subscriptions()
        epoch = self._epoch
        receive = partial(self._from_broker, epoch)
        self._subscriptions = [
            self._broker.subscribe(filter_, receive, echo=False, direct=True)
            for filter_ in self._subjects.filters(INCOMING, OUTGOING)
        ]
        barrier(self._broker, self._probe_topic)
        self._forwarder.subscribed(Side.REMOTE)
        self.call_at(time.monotonic() + SETTLE_S, partial(self._settle_broker, epoch))

    def _settle_broker(self, epoch: int) -> None:
        if epoch == self._epoch:
            self._forwarder.settle(Side.REMOTE)

    def _stand_down(self, why: str) -> None:
        self._forwarder.shut()
        self._close_subscriptions()
        mirror = self.config.transport.mqtt_mirror
        where = f"{mirror.host}:{mirror.port}" if mirror is not None else ""
        self.log.error("transport.mqtt_mirror: nothing is mirrored, the broker %s %s", where, why)

    def _close_subscriptions(self) -> None:
        subscriptions, self._subscriptions = self._subscriptions, []
        for subscription in subscriptions:
            subscription.close()

    # -- the transports' threads

    def _on_fabric(self, state: State) -> None:
        self._forwarder.watch(Side.LOCAL, state)
        if state is State.CONNECTED:
            self.post(self._fabric_joined)

    def _on_broker(self, state: State) -> None:
        self._forwarder.watch(Side.REMOTE, state)
        if state is State.CONNECTED:
            self.post(partial(self._broker_joined, self._epoch))
        else:
            self._epoch += 1
            self.post(self._close_subscriptions)

    def _from_fabric(self, message: Message) -> None:
        if message.topic not in self._watched:
            self._forwarder.receive(Side.LOCAL, message)

    def _from_broker(self, epoch: int, message: Message) -> None:
        if message.topic in self._watched:
            self._from_broker_watched(message)
        elif epoch == self._epoch:
            self._forwarder.receive(Side.REMOTE, message)

    def _from_broker_watched(self, message: Message) -> None:
        if self._forwarder.gate is not Gate.SHUT and self._is_alive(message):
            self._forwarder.shut()
            self.post(partial(self._stand_down, "is the remote one, which the bridge serves already"))

    def _is_alive(self, message: Message) -> bool:
        """Is it said by our bridge, just now? A kept heartbeat may be a left-over; both run by the same clock."""
        if message.topic == self._probe_topic:
            return True
        try:
            beat = codec.decode(ONLINE, message.payload)
        except PayloadError:
            return False
        return beat.online is not False and abs(time.time() - beat.t / 1000) < self._fresh_s
