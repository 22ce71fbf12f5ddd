"""The pings of one MQTT connection. Answers show that the broker lives, how far it has read, and how late it is."""

import random
from math import inf

from pebble.transports import clock
from pebble.transports.mqtt.client import Client
from pebble.transports.mqtt.outgoing import InFlightTable, PendingAck, unconfirmed_bytes
from pebble.transports.mqtt.read_age import ReadAge
from pebble.transports.settings import MqttSettings

_CLEAR = 8 * 1024  # bytes ahead of a ping that do not delay it much
_LEAST_S = 0.05  # between two pings, however short the allowed silence
_THIN_S, _THIN_TRIPS, _THIN_INTERVAL_S = 5.0, 8, 1.5  # over a thin link: the limit, and between two pings
_LEAST_SHARE = 0.75  # of the interval between pings: answers to regular ones could not be told apart


class Pings:
    """The schedule of pings. Call it with the connection's lock held."""

    def __init__(self, settings: MqttSettings, in_flight: InFlightTable, age: ReadAge) -> None:
        self._in_flight, self._age = in_flight, age
        self._silence_s = max(settings.silence_s, 4 * _LEAST_S)  # time for four pings
        keepalive_s = settings.keepalive_s or inf  # 0: the broker sets no limit
        self._interval_s = max(_LEAST_S, min(settings.silence_s, keepalive_s) / 4)
        self._thin_interval_s = min(_THIN_INTERVAL_S, keepalive_s / 2)
        self.is_thin = False  # see `Transport.is_thin`
        self.due_at = inf  # until `begin`; then regularly, as without pings only what we publish is answered
        #: When the stall began for which :meth:`send_after_stall` sent its last ping: it sends one for each stall.
        self._stalled_since = age.waiting.checked_at

    def begin(self, now: float) -> None:
        """Note that the broker has accepted us."""
        self.due_at = now + self._interval_s

    def send(self, client: Client, ack: PendingAck | None = None) -> None:
        """Send a ping, and set when the next one is due. If much data is ahead of it, its answer tells no delay."""
        sock = client.socket
        bytes_ahead = client.unwritten + (0 if sock is None else unconfirmed_bytes(sock))
        now = clock.since_boot()
        interval_s = self._thin_interval_s if self.is_thin else self._interval_s
        self.due_at = now + interval_s * random.uniform(_LEAST_SHARE, 1.0)  # noqa: S311  (no secret)
        self._in_flight.ping(now, ack)
        self._age.delay.asked(now, clear=bytes_ahead <= _CLEAR)
        client.ping()

    def send_after_stall(self, client: Client, now: float) -> None:
        """Send one ping after a time without reading: its answer comes after everything that waited at the broker."""
        since = self._age.waiting.checked_at  # nothing was read since then
        if since != self._stalled_since:
            self._stalled_since = since
            self._in_flight.ping(now, None)  # None: no caller waits for its answer
            self._age.delay.stalled(since, now)
            client.ping()

    @property
    def silence_limit_s(self) -> float:
        """Seconds without an answer after which the broker counts as silent."""
        if self.is_thin:
            return max(self._silence_s, _THIN_S, _THIN_TRIPS * self._in_flight.round_trip_s)
        return max(self._silence_s, 4 * self._in_flight.round_trip_s)
