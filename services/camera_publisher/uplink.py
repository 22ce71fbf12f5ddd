"""The publisher's own connection to the remote side: what it takes, and how much of a picture it can take."""

from __future__ import annotations

from pebble.services.camera_publisher.adapting import Adapter, Step
from pebble.services.camera_publisher.send_queue import SendQueue
from pebble.transports import QoS, Transport

#: Bytes beside payload and topic that a message takes on its way: MQTT's header, and TLS's for each record of 16 KiB.
#: Too many do no harm: what is under way seems to have arrived by that much earlier.
_HEADER, _PER_RECORD, _RECORD = 8, 30, 16 << 10


class Uplink:
    """Gives ``transport`` one picture after the other, each only once those before it are out of the way."""

    def __init__(self, transport: Transport, topic: str, fps: float, now: float) -> None:
        self._transport, self._topic = transport, topic
        self._queue, self._adapter = SendQueue(), Adapter(fps, now)

    @property
    def step(self) -> Step:
        """What is to be sent from now on."""
        return self._adapter.step

    @property
    def busy(self) -> bool:
        """Is a picture under way?"""
        return len(self._queue) > 0

    def full(self, now: float) -> bool:
        """Would another picture have to wait?"""
        return self._queue.full(self._transport.outgoing.round_trip_s, now)

    def late(self, now: float) -> bool:
        """Is a picture under way for longer than the way is long?"""
        return self._queue.age_s(self._transport.outgoing.round_trip_s, now) > 0

    def send(self, payload: bytes, now: float) -> bool:
        if not self._transport.publish(self._topic, payload, qos=QoS.LATEST):
            return False
        size = _HEADER + len(self._topic) + len(payload)
        self._queue.sent(size + _PER_RECORD * (1 + size // _RECORD), now)
        return True

    def lose(self, turns: float, now: float) -> None:
        """So many pictures were not sent because those before them were `late`."""
        self._adapter.lose(turns, now)

    def look(self, now: float) -> bool:
        """What has become of the pictures under way? True: there is another `step` now."""
        outgoing = self._transport.outgoing
        passed = self._queue.look(outgoing.waiting, outgoing.round_trip_s, now)
        return self._adapter.look(passed, self._queue.age_s(outgoing.round_trip_s, now), now)

    def forget(self) -> None:
        """The connection was lost, with the pictures in it."""
        self._queue.clear()
