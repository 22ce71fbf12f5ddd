"""A message, as transports carry it."""

from enum import IntEnum

import msgspec

from pebble.transports import clock


class QoS(IntEnum):
    """The two delivery qualities (T3); the numbers are MQTT's."""

    LATEST = 0  # freshness first, may be dropped
    DELIVERED = 1  # arrives at least once while connected


class Message(msgspec.Struct, frozen=True):
    """A message, published or received.

    Published: ``retain`` asks the broker to retain it. Received: ``retain`` marks a retained message, an old value; on
    a connection opened ``as_published`` it means "retained, or published with retain". ``retain_requested`` says
    whether the publisher of a live message set ``retain``; None where the broker hides it (T5, T7).
    ``waiting_since``, by :func:`clock.since_boot`, is the earliest moment from which it may have waited for this
    process, in a socket or a queue (T19); None: published here, or unknown.
    """

    topic: str
    payload: bytes
    qos: QoS = QoS.LATEST
    retain: bool = False
    retain_requested: bool | None = None
    waiting_since: float | None = None

    @property
    def waited_s(self) -> float:
        """Longest time in seconds that the message can have waited until now; 0 if that is unknown."""
        return 0.0 if self.waiting_since is None else max(0.0, clock.since_boot() - self.waiting_since)
