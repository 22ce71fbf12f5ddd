"""Offers a Zenoh robot's topics on a broker on the robot: ``python -m pebble.services.mqtt_mirror CONFIG``.

docs/bridge.md explains when it forwards, and when it refuses to.
"""

from __future__ import annotations

import sys
import time
from functools import partial
from typing import Any

from pebble.contract import BRIDGE_PROBE, INCOMING, ONLINE, OUTGOING, codec
from pebble.errors import ConfigError, PayloadError
from pebble.forwarding.cycles import PROBE_PERIOD_S
from pebble.forwarding.forwarder import Forwarder, barrier
from pebble.forwarding.probes import PROBE_REQUEST, Probes
from pebble.forwarding.retained_window import INITIAL_SYNC_S
from pebble.forwarding.routing import MIRROR, Side
from pebble.forwarding.side import Gate
from pebble.forwarding.subjects import Subjects
from pebble.runtime.connections import mirror_transport
from pebble.runtime.process import run
from pebble.runtime.service import Service, every
from pebble.transports import Message, QoS, State, Subscription

_FRESH_HEARTBEATS = 3.0  # a heartbeat is current for so many of its intervals
_CHECK_S = 1.0  # before anything is forwarded: by then the bridge's probe has arrived
_REQUEST_PERIOD_S = 1.0  # at most one request so often, when heartbeats on the broker are the reason
_CHECK_AGAIN_S = 30.0  # after the broker was found to be the wrong one


class MqttMirror(Service):
    """Forwards between the robot's own transport (the local side) and a broker on the robot (the remote side).

    Where retained messages differ at a reconnect, the local side is right. If a probe of the bridge arrives from the
    broker, that broker is the remote one: the bridge serves it already, and with a second path messages would
    circulate. A probe counts only if the bridge has announced it on the local side; a heartbeat from the broker is a
    reason to request one.
    """

    name = "mqtt_mirror"
    client_name = "mirror"
    as_published = True

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        mirror, bridge = self.config.transport.mqtt_mirror, self.config.services.mqtt_bridge
        if mirror is None:
            raise ConfigError("transport.mqtt_mirror: name the broker that is to offer the robot's topics")
        self._address = f"{mirror.host}:{mirror.port}"
        self._probe_topic = BRIDGE_PROBE.topic(self.config.base)
        self._watched = frozenset({self._probe_topic} if bridge.enabled else ())
        if bridge.enabled and bridge.heartbeat.enabled:
            self._watched |= {self.addresses[ONLINE].topic}
        self._fresh_s = _FRESH_HEARTBEATS * bridge.heartbeat.interval_seconds
        self._subjects = Subjects(self.config)
        self._probes = Probes()
        self._announced = False  # the bridge has sent a probe since the newest check began
        self._requested_at = float("-inf")
        self._is_remote = False  # the newest result about the broker
        self._refused = ""  # why nothing is mirrored, as logged
        self._epoch = 0  # counts lost connections to the broker
        self._subscriptions: list[Subscription] = []
        self._broker = mirror_transport(self.config, mirror, "mirror-broker")
        self._forwarder = Forwarder(
            self._subjects,
            MIRROR,
            {Side.LOCAL: self.transport, Side.REMOTE: self._broker},
            winner=Side.LOCAL,
            clock=self.clock,
        )

    def start(self) -> None:
        self.transport.on_state(self._on_local_state)
        self._broker.on_state(self._on_broker_state)
        self._broker.open(timeout=0.0)
        self.on_stop(self._broker.close)
        self.post(self._subscribe_local)

    def dropped(self) -> dict[str, int]:
        return self._forwarder.dropped()

    def stop(self) -> None:
        self.log.info("forwarded and dropped: %s", self._forwarder.counters.snapshot())

    # -- the service's thread

    def _subscribe_local(self) -> None:
        for filter_ in self._subjects.filters(INCOMING, OUTGOING):
            self.transport.subscribe(filter_, self._from_local, echo=False, direct=True)

    def _local_connected(self) -> None:
        self._forwarder.subscribed(Side.LOCAL)
        self.call_at(self.clock() + INITIAL_SYNC_S, partial(self._forwarder.synchronize, Side.LOCAL))

    def _broker_connected(self, epoch: int) -> None:
        if epoch != self._epoch:
            return
        if not self._broker.exact_echo:
            self._disable('sends our own messages back; use one with bridge mode (mosquitto), or protocol "5"')
        elif self._forwarder.gate is Gate.OPEN:
            self._subscribe_broker()
            self._request_probe()
        else:
            self._check_broker(epoch)

    def _check_broker(self, epoch: int) -> None:
        """Wait for probes of the bridge from that broker, before anything is forwarded."""
        self._forwarder.rearm()
        self._announced = False
        self._close_subscriptions()
        self._subscriptions = [
            self._broker.subscribe(topic, self._from_broker_watched, echo=False, direct=True)
            for topic in sorted(self._watched)
        ]
        self._request_probe()
        self.call_at(self.clock() + (_CHECK_S if self._watched else 0.0), partial(self._begin, epoch))

    def _begin(self, epoch: int) -> None:
        if epoch != self._epoch or self._forwarder.gate is not Gate.WAITING:
            return
        if self._is_remote and not self._announced:  # the bridge is away: nothing has disproven it
            self._disable(self._refused)
            return
        self._is_remote, self._refused = False, ""
        self.log.info("offering the robot's topics on its MQTT broker")
        self._forwarder.open()
        self._subscribe_broker()

    def _subscribe_broker(self) -> None:
        """Subscribe anew for each connection, after the transport has sent what changed during the outage."""
        self._close_subscriptions()
        self._forwarder.subscribing(Side.REMOTE)
        epoch = self._epoch
        receive = partial(self._from_broker, epoch)
        self._subscriptions = [
            self._broker.subscribe(filter_, receive, echo=False, direct=True)
            for filter_ in self._subjects.filters(INCOMING, OUTGOING)
        ]
        barrier(self._broker, self._probe_topic)
        self._forwarder.subscribed(Side.REMOTE)
        self.call_at(self.clock() + INITIAL_SYNC_S, partial(self._synchronize_broker, epoch))

    def _synchronize_broker(self, epoch: int) -> None:
        if epoch == self._epoch:
            self._forwarder.synchronize(Side.REMOTE)
            self._forwarder.probe_commands(*Side)

    @every(PROBE_PERIOD_S)
    def _probe_again(self) -> None:
        self._forwarder.probe_again(*Side)

    def _request_probe(self) -> None:
        """Request a probe from the bridge, if the robot has one."""
        if self._watched:
            self._requested_at = self.clock()
            self.transport.publish(self._probe_topic, PROBE_REQUEST, qos=QoS.DELIVERED)

    def _suspect(self) -> None:
        """A heartbeat like the robot's came from the broker: it is the remote one, or a client there sent it."""
        if self.clock() - self._requested_at >= _REQUEST_PERIOD_S:
            self._request_probe()

    def _broker_is_remote(self) -> None:
        self._is_remote = True
        self._disable("is the remote one, which the bridge serves already")

    def _disable(self, why: str) -> None:
        """Mirror nothing until the next check: the address may lead to another broker by then."""
        self._forwarder.shut()
        self._close_subscriptions()
        self.call_at(self.clock() + _CHECK_AGAIN_S, partial(self._check_again, self._epoch))
        if why != self._refused:
            self._refused = why
            self.log.error("transport.mqtt_mirror: nothing is mirrored, the broker %s %s", self._address, why)

    def _check_again(self, epoch: int) -> None:
        if self._forwarder.gate is Gate.SHUT and self._broker.state is State.CONNECTED:
            self._broker_connected(epoch)

    def _close_subscriptions(self) -> None:
        subscriptions, self._subscriptions = self._subscriptions, []
        for subscription in subscriptions:
            subscription.close()

    # -- the transports' threads

    def _on_local_state(self, state: State) -> None:
        self._forwarder.watch(Side.LOCAL, state)
        if state is State.CONNECTED:
            self.post(self._local_connected)

    def _on_broker_state(self, state: State) -> None:
        self._forwarder.watch(Side.REMOTE, state)
        if state is State.CONNECTED:
            self.post(partial(self._broker_connected, self._epoch))
        else:
            self._epoch += 1
            self.post(self._close_subscriptions)

    def _from_local(self, message: Message) -> None:
        if message.topic not in self._watched:
            self._forwarder.receive(Side.LOCAL, message)
        elif message.topic == self._probe_topic:
            self._announced = True
            if self._probes.announce(message.payload):
                self._shut()

    def _from_broker(self, epoch: int, message: Message) -> None:
        if message.topic in self._watched:
            self._from_broker_watched(message)
        elif epoch == self._epoch:
            self._forwarder.receive(Side.REMOTE, message)

    def _from_broker_watched(self, message: Message) -> None:
        if message.topic == self._probe_topic:
            if self._probes.see(message.payload):
                self._shut()
        elif self._is_fresh(message):
            self.post_message(ONLINE, self._suspect, newest_of="suspect")

    def _shut(self) -> None:
        if self._forwarder.gate is not Gate.SHUT:
            self._forwarder.shut()
            self.post_message(BRIDGE_PROBE, self._broker_is_remote)

    def _is_fresh(self, message: Message) -> bool:
        """Whether a heartbeat is current: a retained one may be old. Its sender uses the same clock."""
        try:
            heartbeat = codec.decode(ONLINE, message.payload)
        except PayloadError:
            return False
        return heartbeat.online is not False and abs(time.time() - heartbeat.t / 1000) < self._fresh_s


if __name__ == "__main__":
    sys.exit(run(MqttMirror))
