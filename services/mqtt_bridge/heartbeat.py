"""The robot's sign of life towards operators, and the will that says it is gone."""

from __future__ import annotations

from collections import deque

from pebble import codec
from pebble.addresses import Address
from pebble.contract import ONLINE
from pebble.payloads import Heartbeat as Beat
from pebble.transports import Message, QoS, State, Transport

_REMEMBERED = 64  # own heartbeats that may still be on their way back to us


class Heartbeat:
    """Says ``{"t": ms}`` on the heartbeat's effective topic (paper A.8.5)."""

    def __init__(self, address: Address) -> None:
        self.topic = address.topic
        self._qos, self._retain = QoS(address.qos), address.retain
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)

    def will(self, now_ms: int) -> Message:
        """What the broker says when we are gone. ``t`` is from before we lived: a will cannot know better."""
        return Message(self.topic, codec.encode(ONLINE, Beat(t=now_ms, online=False)), QoS.DELIVERED, retain=True)

    def beat(self, transport: Transport, now_ms: int) -> None:
        """Publish, if there is a connection; a heartbeat is never worth sending later."""
        if transport.state is not State.CONNECTED:
            return
        payload = codec.encode(ONLINE, Beat(t=now_ms))
        self._sent.append(payload)
        transport.publish(self.topic, payload, qos=self._qos, retain=self._retain)

    def is_ours(self, message: Message) -> bool:
        """Have we sent exactly this? Somebody else's may be equal by chance."""
        return message.topic == self.topic and message.payload in tuple(self._sent)
