"""Finds out whether wheel odometry is being published, by a script or any other program on the robot."""

import time
from collections.abc import Callable

from pebble.contract import WHEEL_ODOMETRY, codec
from pebble.errors import PayloadError
from pebble.runtime.parent import ProvidedFeatures
from pebble.transports import Message, QoS, Transport

_GONE_S = 3.0  # a robot at rest publishes it twice a second


class OdometryWatch:
    """Call :meth:`poll` regularly: it adds ``wheel-odometry`` to ``features`` while messages arrive on ``topic``."""

    def __init__(self, topic: str, features: ProvidedFeatures, clock: Callable[[], float] = time.monotonic) -> None:
        self._topic, self._features, self._clock = topic, features, clock
        self.received_at = float("-inf")  # on the clock

    def start(self, transport: Transport) -> None:
        transport.subscribe(self._topic, self._receive, qos=QoS.LATEST, direct=True)

    def poll(self) -> None:
        """Report a change; again, if the launcher was too busy."""
        if self._present:
            self._features.names.add(WHEEL_ODOMETRY.metric)
        else:
            self._features.names.discard(WHEEL_ODOMETRY.metric)
        self._features.report()

    @property
    def _present(self) -> bool:
        return self._clock() - self.received_at < _GONE_S

    def _receive(self, message: Message) -> None:
        """On the transport's thread: only the first message is checked."""
        if message.retain or not (self._present or _is_odometry(message.payload)):
            return
        self.received_at = self._clock()


def _is_odometry(payload: bytes) -> bool:
    try:
        codec.decode(WHEEL_ODOMETRY, payload)
    except PayloadError:
        return False
    return True
