"""Detects that the bridge's two sides are one broker, by whatever addresses (paper A.5.1).

Then the bridge must not forward: every message would come back and circulate for ever. A probe that is published on the
remote side and received on the local side proves it.
"""

import time
from collections import deque
from collections.abc import Callable

from pebble.config import Config
from pebble.contract import BRIDGE_PROBE
from pebble.forwarding.forwarder import barrier
from pebble.forwarding.probes import NO_PROBE, PROBE_REQUEST, new_probe
from pebble.transports import Message, QoS, State, Transport

_REMEMBERED = 64  # probes that may still arrive
_PERIOD_S = 1.0


class SameBrokerProbe:
    """A sender of probes, in rounds; it knows the newest round in which one was received on the local side.

    On a robot with a mirror each probe is also announced on the robot's own transport. The mirror compares it with its
    broker's messages, until the bridge announces that no probe is under way.
    """

    def __init__(self, config: Config, local: Transport, remote: Transport, clock: Callable[[], float]) -> None:
        section = config.services.mqtt_bridge.remote
        self.topic = BRIDGE_PROBE.topic(config.base)
        remote_kind = "mqtt" if section is None else section.kind
        self.possible = config.transport.kind == remote_kind  # the two sides may be one broker
        self.announces = config.transport.mqtt_mirror is not None
        self._local, self._remote, self._clock = local, remote, clock
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._sent_at = float("-inf")
        self._under_way = False  # a probe was announced, and may still be on its way to the remote broker
        self._round = 0
        self._same_in_round = -1  # the newest round in which both sides were one broker

    @property
    def both_connected(self) -> bool:
        return self._local.state is State.CONNECTED and self._remote.state is State.CONNECTED

    def send(self) -> bool:
        """Send a new probe; False if the remote transport does not accept it."""
        self._sent_at = self._clock()
        payload = new_probe(now_ms())
        self._sent.append(payload)
        if self.announces and self._remote.state is State.CONNECTED:
            self._under_way = True
            self._announce(payload)
        return self._remote.publish(self.topic, payload, qos=QoS.DELIVERED)

    def send_again(self) -> None:
        """Send a new probe, at most one per second."""
        if self._clock() - self._sent_at >= _PERIOD_S:
            self.send()

    def report_arrival(self) -> None:
        """Announce that the remote broker has the newest probe, as its answer to a later message shows."""
        answer = self._remote.answer
        if self._under_way and answer is not None and answer.delivered_s < self._clock() - self._sent_at:
            self.report_none()

    def report_none(self) -> None:
        """Announce that no probe is under way."""
        self._under_way = False
        if self.announces:
            self._announce(NO_PROBE)

    def _announce(self, payload: bytes) -> None:
        self._local.publish(self.topic, payload, qos=QoS.DELIVERED)

    def answer_request(self) -> None:
        if self._remote.state is State.CONNECTED:
            self.send()
        else:
            self.report_none()

    def begin_round(self, remote_topic: str) -> int | None:
        """Send a probe, wait (bounded) until it would have arrived, and return the round; None without a connection."""
        self._round += 1
        if not self.send():
            return None
        barrier(self._remote, remote_topic)  # until the broker has the probe, whose topic we may not subscribe to there
        barrier(self._local, self.topic)  # until the local side has received all that came before that
        return self._round if self.both_connected else None

    def proves_two_brokers(self, round_: int) -> bool:
        """True if no probe came back in this round, and no newer round has begun."""
        is_newest = round_ == self._round
        return is_newest and self._same_in_round != round_ and self.both_connected

    # -- the transports' threads

    def proves_same_broker(self, message: Message) -> bool:
        """True, once for each of our probes, if ``message`` is that probe, received on the local side.

        A copy that a client keeps sending, or has retained, proves nothing.
        """
        try:
            self._sent.remove(message.payload)
        except ValueError:
            return False
        self._same_in_round = self._round
        return True

    def is_request(self, message: Message) -> bool:
        return self.announces and message.payload == PROBE_REQUEST


def now_ms() -> int:
    return time.time_ns() // 1_000_000
