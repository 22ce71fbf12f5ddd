"""The robot's heartbeat towards operators, and the will that marks it as offline."""

from collections import deque

from pebble.contract import ONLINE, codec
from pebble.contract.payloads import Heartbeat as HeartbeatPayload
from pebble.runtime.addresses import Address
from pebble.transports import Message, QoS, State, Transport

_REMEMBERED = 64  # own heartbeats that a broker may still send back


class Heartbeat:
    """The publisher of ``{"t": ms}`` on the heartbeat's effective topic (paper A.8.5)."""

    def __init__(self, address: Address) -> None:
        self.topic = address.topic
        self._qos, self._retain = QoS(address.qos), address.retain
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)

    def will(self, now_ms: int) -> Message:
        """Return the will that the broker publishes when the connection is lost. ``t`` is the start of the process."""
        return Message(
            self.topic, codec.encode(ONLINE, HeartbeatPayload(t=now_ms, online=False)), QoS.DELIVERED, retain=True
        )

    def publish(self, transport: Transport, now_ms: int, qos: int | None = None) -> None:
        """Publish, if connected; a heartbeat is never sent later. ``qos`` None: as configured."""
        if transport.state is not State.CONNECTED:
            return
        payload = codec.encode(ONLINE, HeartbeatPayload(t=now_ms))
        self._sent.append(payload)
        transport.publish(self.topic, payload, qos=self._qos if qos is None else QoS(qos), retain=self._retain)

    def is_ours(self, message: Message) -> bool:
        """True if we have sent an equal payload: ours has come back, or another program has sent the same."""
        return message.topic == self.topic and message.payload in tuple(self._sent)
