"""Finds out whether the bridge's two sides meet in one broker, whatever names it goes by (paper A.5.1).

Then nothing may be mirrored: every message would come back and circulate for ever. What is published on the remote side
and seen on the local one gives it away.
"""

from __future__ import annotations

import secrets
from collections import deque

from pebble import codec
from pebble.contract import BRIDGE_PROBE
from pebble.forwarding.forwarder import barrier
from pebble.transports import Message, QoS, State, Transport

_REMEMBERED = 64  # probes that may still turn up


class OneBroker:
    """Sends probes that nobody else can have sent, and recognises them."""

    def __init__(self, base: str) -> None:
        self.topic = BRIDGE_PROBE.topic(base)
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)

    def probe(self, remote: Transport, now_ms: int) -> bool:
        """Send a new probe; False when it cannot go now."""
        payload = codec.encode(BRIDGE_PROBE, {"t": now_ms, "nonce": secrets.token_hex(8)})
        self._sent.append(payload)
        return remote.publish(self.topic, payload, qos=QoS.DELIVERED)

    def is_probe(self, message: Message) -> bool:
        """Anybody's: probes are never forwarded."""
        return message.topic == self.topic

    def gives_away(self, message: Message) -> bool:
        """Is this one of ours, seen on the local side?"""
        return message.topic == self.topic and message.payload in tuple(self._sent)

    def wait(self, remote: Transport, filter_: str, local: Transport) -> bool:
        """Wait, bounded, until the newest probe would have arrived; False when a connection was lost meanwhile.

        First on the side the probe went to, then on the side where it would show up.
        """
        barrier(remote, filter_)
        barrier(local, self.topic)
        return remote.state is State.CONNECTED and local.state is State.CONNECTED
