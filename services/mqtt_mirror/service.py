"""The mirror as a process: it offers a Zenoh robot's topics on a broker on the robot.

docs/bridge.md explains when the mirror forwards, and when it refuses to.
"""

import time
from collections.abc import Iterable
from functools import partial
from typing import Any

from msgspec import UNSET

from pebble.config import Mqtt
from pebble.contract import BRIDGE_PROBE, ESTOP, ONLINE, codec
from pebble.contract.levels import silent_after
from pebble.errors import ConfigError, PayloadError
from pebble.forwarding.forwarder import barrier
from pebble.forwarding.probes import NO_PROBE, PROBE_REQUEST, Probes
from pebble.forwarding.routing import MIRROR, Side
from pebble.forwarding.service import CHECK_AGAIN_S, CHECK_SOON_S, ForwardingService
from pebble.forwarding.side import Gate
from pebble.runtime.connections import mirror_transport
from pebble.transports import Message, QoS, State, Transport

_FRESH = 1.5  # times what counts as silence: so old a heartbeat is current
CHECK_S = 1.0  # before anything is forwarded: by then the bridge's probe has arrived
_ARRIVAL_S = 0.25  # between two looks whether the bridge's probe has arrived at the remote broker
_REQUEST_PERIOD_S = 1.0  # at most one request so often, but for those of a new connection


class MqttMirror(ForwardingService):
    """The mirror: it forwards between the robot's own transport and a broker on the robot.

    Where retained messages differ at a reconnect, the local side is right. If a probe of the bridge arrives from the
    broker, that broker is the remote one: the bridge serves it already, and with a second path messages would
    circulate. A probe counts only if the bridge has announced it on the local side. A heartbeat from the broker is a
    reason to request a probe.
    """

    name = "mqtt_mirror"
    client_name = "mirror"
    rules = MIRROR
    winner = Side.LOCAL
    probed_sides = (Side.LOCAL, Side.REMOTE)

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        bridge = self.config.services.mqtt_bridge
        self._probe_topic = BRIDGE_PROBE.topic(self.config.base)
        self._watched = frozenset({self._probe_topic} if bridge.enabled else ())
        if bridge.enabled and bridge.heartbeat.enabled:
            self._watched |= {self.addresses[ONLINE].topic}
        self._heartbeat_fresh_s = _FRESH * silent_after(bridge.heartbeat.interval_seconds, bridge.link.slowest)
        self._probes = Probes()
        self._announced = False  # the bridge has announced a probe since the newest check began
        self._under_way = False  # a probe of the bridge may be under way
        # The longest time for which a probe is under way; 0.0: not known, for a remote side other than `remote_mqtt`.
        self._slowest_s = bridge.remote_mqtt.silence_seconds if bridge.remote is None else 0.0
        self._requested_at = float("-inf")
        self._is_operators = False  # by the newest check the broker is the operators', not one of the robot's
        self._refused = ""  # why nothing is mirrored, as logged

    def make_remote(self) -> Transport:
        return mirror_transport(self.config, self._broker, "mirror-broker")

    @property
    def _broker(self) -> Mqtt:
        mirror = self.config.transport.mqtt_mirror
        if mirror is None:
            raise ConfigError("transport.mqtt_mirror: name the broker that is to offer the robot's topics")
        return mirror

    # -- the service's thread

    def connected(self, side: Side, epoch: int) -> None:  # epoch: see ForwardingService
        if side is Side.LOCAL:
            self.forwarder.subscribed(Side.LOCAL)
            self.synchronize_later(Side.LOCAL)
            return
        if epoch != self.epoch:  # that connection is lost already
            return
        if not self.remote.exact_echo:  # its own messages come back in spite of echo=False
            self._refuse('sends our own messages back; use one with bridge mode (mosquitto), or protocol "5"')
        elif self.forwarder.gate is Gate.OPEN:  # its broker was checked before; a probe shows if it is another now
            self.subscribe_remote()
            self._request_probe()
        else:
            self._check_broker(epoch)

    def _check_broker(self, epoch: int) -> None:
        """Watch for probes of the bridge from the broker for some seconds, and forward nothing before that."""
        self.forwarder.rearm()  # if it was shut: from now on messages wait for the result
        self._announced, self._under_way = False, bool(self._watched)  # True with a bridge, until it says that none is
        self.unsubscribe(Side.REMOTE)
        self.subscriptions[Side.REMOTE] = [
            self.remote.subscribe(topic, self._from_broker_watched, echo=False, direct=True)
            for topic in sorted(self._watched)
        ]
        self._request_probe()
        begins = self.clock() + (CHECK_S if self._watched else 0.0)
        latest = begins + self._slowest_s
        self.call_at(begins, partial(self._begin, epoch, latest))

    def _begin(self, epoch: int, latest: float) -> None:
        """Start forwarding on connection ``epoch``, once no probe is under way, at the latest at ``latest``."""
        if self._under_way and self.clock() < latest:
            self._request_again()
            self.call_at(self.clock() + _ARRIVAL_S, partial(self._begin, epoch, latest))
            return
        barrier(self.remote, self._probe_topic)  # receives what the broker has sent by now; a probe shuts the gate
        if epoch != self.epoch or self.forwarder.gate is not Gate.WAITING:
            return
        if self._is_operators and not self._announced:  # without a probe nothing shows another broker
            self._refuse(self._refused)
            return
        self._is_operators, self._refused = False, ""
        self.log.info("offering the robot's topics on its MQTT broker")
        self.forwarder.open()
        self.subscribe_remote()

    def await_retained(self) -> None:
        barrier(self.remote, self._probe_topic)

    def _request_probe(self) -> None:
        """Request a probe from the bridge, if the robot has one."""
        if self._watched:
            self._requested_at = self.clock()
            self.transport.publish(self._probe_topic, PROBE_REQUEST, qos=QoS.DELIVERED)

    def _request_again(self) -> None:
        """Request a probe, at most one per second."""
        if self.clock() - self._requested_at >= _REQUEST_PERIOD_S:
            self._request_probe()

    def found_one_broker(self) -> None:
        seconds = CHECK_AGAIN_S if self._is_operators else CHECK_SOON_S
        self._is_operators = True
        self._refuse("is the remote one, which the bridge serves already", seconds)

    def _refuse(self, why: str, seconds: float = CHECK_AGAIN_S) -> None:
        """Forward nothing for ``seconds``, then check the broker again; ``why`` completes "the broker … "."""
        self.forward_nothing(seconds)
        if why != self._refused:
            self._refused = why
            address = f"{self._broker.host}:{self._broker.port}"
            self.log.error("transport.mqtt_mirror: nothing is mirrored, the broker %s %s", address, why)

    def check_again(self, epoch: int) -> None:
        if self.remote.state is State.CONNECTED:
            self.connected(Side.REMOTE, epoch)

    # -- the transports' threads

    def pass_stop(self, side: Side, payload: bytes) -> Iterable[bytes]:
        """Return the payloads to pass: a stop that the bridge repeats for one motor owner stays on the local side."""
        addressed = side is Side.LOCAL and bool(payload) and codec.decode(ESTOP, payload).owner is not UNSET
        return () if addressed else (payload,)

    def receive_local(self, message: Message) -> None:
        """Forward a message; notice probes of the bridge. Its heartbeats stay here: it alone publishes them."""
        if message.topic not in self._watched:
            self.forwarder.receive(Side.LOCAL, message)
        elif message.topic == self._probe_topic:
            self._under_way = message.payload != NO_PROBE
            if self._under_way:
                self._announced = True
                if self._probes.announce(message.payload):  # the broker has sent it already: so it is the remote one
                    self.shut()

    def receive_remote(self, epoch: int, message: Message) -> None:
        if message.topic in self._watched:
            self._from_broker_watched(message)
        elif epoch == self.epoch:
            self.forwarder.receive(Side.REMOTE, message)

    def _from_broker_watched(self, message: Message) -> None:
        if message.topic == self._probe_topic:
            if self._probes.see(message.payload):
                self.shut()
        elif self._is_fresh(message):
            self.post_message(ONLINE, self._request_again, newest_of="suspect")

    def _is_fresh(self, message: Message) -> bool:
        """True if a heartbeat is recent, and not an old retained one. Its sender, the robot, uses the same clock."""
        try:
            heartbeat = codec.decode(ONLINE, message.payload)
        except PayloadError:
            return False
        return heartbeat.online is not False and abs(time.time() - heartbeat.t / 1000) < self._heartbeat_fresh_s
