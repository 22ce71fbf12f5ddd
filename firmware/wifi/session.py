"""Sessions with the broker, one after another: they connect, read and write, and limit the bytes in flight."""

import gc
import os
import random
from binascii import hexlify

from micropython import const

from common.settings import get, host
from common.ticks import diff
from wifi import mqtt
from wifi.connection import Connection
from wifi.sockets import Stream, query_name

_ALIVE_S = const(15)  # MQTT's keepalive: the broker publishes the will after 1.5 times of it
_LONGEST_PAYLOAD = const(512)
_LONGEST_TOPIC = const(58)  # below the base: /incoming/by/{account}/drive-values
_OUTGOING = const(420)  # plus three topics: room for a state and the 20 PUBACKs that a broker waits for
_CHUNKS = const(4)  # reads per turn, at most
_CALM_MS = const(3000)  # with the flood's last two seconds five: the next attempt is soon
_PACE_MS = const(30)  # between two writes, so that acknowledgements share packets
# Writes in flight, as far as pings tell. An ESP8266 queues eight; the ninth blocks for up to ten seconds, even if the
# socket is non-blocking (micropython issue 19704), and a lost packet delays all later ones.
_IN_FLIGHT = const(7)


class Session:
    """A session: ``step`` each turn, then ``read`` and ``write`` if it is True; ``drop`` after OSError, ValueError."""

    def __init__(self, settings: dict, root: bytes, topics: tuple, plain: int, names, wrap, take) -> None:
        """Store the arguments. ``wrap`` wraps a socket in TLS; None: no TLS.

        ``topics``, ``plain``, ``names``: see `mqtt.Client`. ``take(kind, now)`` is called for the SUBACK and for each
        publication, see `mqtt.Client.take`; it may raise ValueError.
        """
        self.settings = settings
        self.host = host(settings)
        self.root = root
        # A broker disconnects a client when another one uses the same id: so it cannot be guessed, and is the same
        # until the next boot. A broker must accept 23 bytes of it, and may refuse more (3.1.3.1).
        self._name = b"pebble-" + hexlify(os.urandom(8))
        size = _LONGEST_PAYLOAD + len(root) + _LONGEST_TOPIC + 7
        self.client = mqtt.Client(size, _OUTGOING + 3 * len(root), root + b"/incoming/", topics, plain, names)
        self.wrap = wrap
        self._take = take
        self.connection = Connection()
        self._open: Stream | None = None  # to the broker; before that, the query for its address
        self._in_flight = 0  # writes that may not have arrived yet
        self._behind = 0  # those after the last ping
        self._asked = False  # whether the answer to that ping is outstanding
        self.stuck = False  # whether data waits that could not be written
        self._wrote = 0  # the last write
        self._received = 0  # the last bytes
        # The last session ended because the answer to a ping waited behind a flood of commands. Until the flood is over
        # only stops are subscribed to, so that they get through, and nothing moves.
        self._paused = False
        self._since = 0  # when this session came online

    def step(self, now: int, server: str, clock) -> bool:
        """Return True if packets can be exchanged; ``server`` is the DNS server, "": there is no network.

        Raises OSError with the reason if the session is over. Silence ends it before anything is read: queued commands
        are stale.
        """
        connection = self.connection
        due = connection.step(now, server != "")
        if due == "drop":
            # silence, although bytes came: the answer to the ping is behind a flood
            self._paused = connection.reason == "silence" and diff(now, self._received) < 500
            raise OSError(connection.reason)
        if due == "resolve":
            self._open = query_name(self.host, server, now, connection.failures)  # type: ignore[assignment]
        if connection.state == "resolving":
            self._connect(now, clock)
            return False
        return self._open is not None and self._open.ready()

    def _connect(self, now: int, clock) -> None:
        """Connect once the address is known."""
        assert self._open
        address = self._open.address(now)  # type: ignore[attr-defined]  # a Query until here
        if address is None:
            return
        self._open.socket.close()
        self._open = None
        settings = self.settings
        if not address:
            raise OSError("no address for " + self.host)
        if self.wrap:
            self.wrap.host = self.host
            self.wrap.set_time(clock.read(now))
        self._open = Stream(address, get(settings, "mqtt", "port", 8883 if self.wrap else 1883), self.wrap)
        self.client.restart()
        packet = mqtt.login(
            self._name,
            get(settings, "mqtt", "username", "").encode(),
            get(settings, "mqtt", "password", "").encode(),
            self.root + b"/outgoing/online",
            b'{"t": 0, "online": false}',
            _ALIVE_S,
        )
        self.client.send(*packet)
        self._wrote = now  # the last write may be longer ago than ticks can measure
        self._in_flight = 0
        self._asked = self.stuck = False
        self.connection.move("connecting", now)

    def drop(self, now: int, reason: str) -> None:
        if self._open:
            self._open.socket.close()
            self._open = None
        self.connection.reason = reason
        self.connection.lost(now, random.getrandbits(8))

    def read(self, now: int) -> None:
        """Read what has come, at most some kilobytes, and pass on all publications in order."""
        client = self.client
        assert self._open
        for chunk in range(_CHUNKS):
            if chunk:
                gc.collect()  # each command leaves some 200 bytes of garbage
            space = client.space()
            count = self._open.read(space) if len(space) else 0
            if count:
                self._received = now
            elif len(space) == len(client.data):  # nothing has come, and the buffer is empty: no packet waits in it
                break
            kind = client.take(count)
            while kind:
                if kind == "welcome":
                    client.subscribe(1 if self._paused else len(client.topics))
                    self.connection.move("subscribing", now)
                elif kind == "pong":
                    self._in_flight = self._behind  # all writes before the ping have arrived
                    self._asked = False
                    self.connection.received(now)
                elif kind == "subscribed":
                    if not self._paused:  # else it is for stops alone, and lists no other topic
                        self._take(kind, now)
                    if self.connection.state != "online":
                        self._in_flight = 0
                        self._since = now
                        self.connection.move("online", now)
                else:
                    self._take(kind, now)
                kind = client.take()  # another packet of the same bytes
            if count < len(space):
                break

    def publish(self, topic: bytes, payload: bytes, retain: int = 0) -> bool:
        """Publish on outgoing/``topic``. False: there is no room, and the message is dropped, as it would be stale."""
        return self.client.publish(retain, b"%s/outgoing/%s" % (self.root, topic), payload)

    def write(self, now: int, urgent: bool) -> None:
        """Write waiting bytes if that is ``urgent``, the last write was long enough ago, or half the buffer is full."""
        client = self.client
        if self._paused and self.connection.state == "online" and diff(now, self._since) >= _CALM_MS:
            self._paused = False  # the flood is over
            client.subscribe(len(client.topics))  # to all: during the flood only stops were
        if not urgent and diff(now, self._wrote) < _PACE_MS and client.waiting < len(client.out) // 2:
            return
        if client.waiting and not self._asked and self.connection.state == "online":
            self._asked = client.send(0xC0)  # a ping: its answer shows that all writes before it have arrived
            self._behind = -1  # the write with the ping itself does not count
        self._wrote = now
        assert self._open
        while client.waiting and self._in_flight < _IN_FLIGHT:
            count = self._open.write(client.out, client.waiting)
            if not count:
                break
            client.sent(count)
            self._in_flight += 1
            self._behind += 1
        self.stuck = client.waiting > 0
