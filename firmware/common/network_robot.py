"""The common part of all robots on Wi-Fi: connection, commands, stops, dead-man's switch, heartbeat and reports.

A robot that loses the broker stops at once, because no operator could stop it. So whatever blocks the processor for
long (TLS, starting the radio) happens only while the motors are off.
"""

import gc
import os
import random
import time
from binascii import hexlify

from micropython import const

from common import mqtt
from common.arbiter import PERSON, REFUSED
from common.capabilities import describe
from common.clock import Clock
from common.connection import Connection
from common.deadman import DeadMan
from common.estop import EmergencyStop
from common.payload import parse
from common.settings import base, get, host
from common.sockets import Stream, query_name
from common.ticks import add, diff
from common.wifi import Wifi

_DRIVE_LIMIT_MS = const(900)  # one second, including a slow turn of the loop
_ESTOP = const(0)  # places of the topics in the subscription: stops come first
_RESET = const(1)
_DRIVE = const(2)
_HEARTBEAT_MS = const(250)
_REPORT_EVERY = const(20)  # heartbeats: 5 s
_ALIVE_S = const(15)  # MQTT's keepalive: the broker publishes the will after 1.5 times of it
_LONGEST_PAYLOAD = const(512)
_OUTGOING = const(420)  # plus three topics: room for a state and the 20 PUBACKs that a broker waits for
_CHUNKS = const(4)  # reads per turn, at most
_PACE_MS = const(30)  # between two writes, so that acknowledgements share packets
# Writes in flight, as far as pings tell. An ESP8266 queues eight; the ninth blocks for up to ten seconds, even if the
# socket is non-blocking (micropython issue 19704), and a lost packet delays all later ones.
_IN_FLIGHT = const(7)


class NetworkRobot:
    """One robot; call ``step`` forever. Status: ``connection.state``, ``.reason``, ``refused``, ``deadman.trips``."""

    def __init__(self, settings: dict, body, charging: bytes, wrap) -> None:
        """``body`` has ``drive(x, z, y)``, True if anything moves; ``stop()``; ``report(publish)``; ``refresh()``.

        ``charging``: whether it reports a charging status, in JSON. ``wrap`` wraps a socket in TLS; None: no TLS.
        """
        now = time.ticks_ms()
        name = get(settings, "robot", "id")
        # A broker disconnects a client when another one uses the same id: so it cannot be guessed, and is the same
        # until the next boot. A broker must accept 23 bytes of it, and may refuse more (3.1.3.1).
        self._name = b"pebble-" + hexlify(os.urandom(8))
        self._root = base(get(settings, "robot", "system", "pebble"), get(settings, "robot", "type", "robots"), name)
        self._online = self._root + b"/outgoing/online"
        self._settings = settings
        self._charging = charging
        self._wrap = wrap
        self._wifi = Wifi(get(settings, "wifi", "ssid"), get(settings, "wifi", "password", ""))
        self._clock = Clock(settings.get("ntp", "pool.ntp.org"), now)
        self._host = host(settings)
        incoming = self._root + b"/incoming/"
        topics = incoming + b"estop", incoming + b"estop-reset", incoming + b"drive-values"
        longest = _LONGEST_PAYLOAD + len(topics[_DRIVE]) + 7
        self._mqtt = mqtt.Client(longest, _OUTGOING + 3 * len(self._root), topics)
        self.stops = EmergencyStop(now, _DRIVE_LIMIT_MS)
        self._stoppable = True  # the broker granted both topics of stops
        self.deadman = DeadMan(_DRIVE_LIMIT_MS)
        self._body = body
        self.connection = Connection()
        self.refused = 0  # commands that were retained, and drive commands that were invalid or not admitted
        self._next: tuple | None = None  # the newest drive command that was admitted in this turn
        self._limit_ms = 0  # how long it moves the motors
        self._void = False  # a stop was received in this turn
        self._open: Stream | None = None  # to the broker; before that, the query for its address
        self._in_flight = 0  # writes that may not have arrived yet
        self._behind = 0  # those after the last ping
        self._asked = False  # whether the answer to that ping is outstanding
        self._stuck = False  # whether data waits that could not be written
        self._wrote = self._due = now  # the last write; the next heartbeat
        self._heartbeats = 0

    def step(self) -> None:
        now = time.ticks_ms()
        self._guard(now)
        try:
            self._turn(now)
        except (OSError, ValueError, MemoryError) as error:
            self.connection.reason = str(error)
            self._drop(now)
        self._guard(time.ticks_ms())

    def stop(self) -> None:
        self._body.stop()

    def _guard(self, now: int) -> None:
        self.stops.tick(now)
        if self.deadman.expired(now):
            self._body.stop()
        self._body.refresh()

    def _turn(self, now: int) -> None:
        server = self._wifi.step(now)
        self._clock.step(now, server)
        due = self.connection.step(now, server != "")  # checks for silence before reading: queued commands are stale
        if due == "drop":
            self._drop(now)
        elif due == "resolve":
            self._open = query_name(self._host, server, now, self.connection.failures)  # type: ignore[assignment]
        if self.connection.state == "resolving":
            self._connect(now)
        elif self._open and self._open.ready():
            self._read()
            if self.connection.state == "online":
                self._report(now)
            self._write(now)

    def _connect(self, now: int) -> None:
        """Connect once the address is known."""
        assert self._open
        address = self._open.address(now)  # type: ignore[attr-defined]  # it is a Question
        if address is None:
            return
        self._open.socket.close()
        self._open = None
        if not address:
            raise OSError("no address for " + self._host)
        settings = self._settings
        if self._wrap:
            self._wrap.set_time(self._clock.read(now))
        self._open = Stream(address, get(settings, "mqtt", "port", 8883 if self._wrap else 1883), self._wrap)
        self._mqtt.restart()
        packet = mqtt.login(
            self._name,
            get(settings, "mqtt", "username", "").encode(),
            get(settings, "mqtt", "password", "").encode(),
            self._online,
            b'{"t": 0, "online": false}',
            _ALIVE_S,
        )
        self._mqtt.send(*packet)
        self._wrote = now  # the last write may be longer ago than ticks can measure
        self._in_flight = 0
        self._asked = self._stuck = False
        self.connection.move("connecting", now)

    def _drop(self, now: int) -> None:
        self._halt()
        self.stops.save()
        if self._open:
            self._open.socket.close()
            self._open = None
        self.connection.lost(now, random.getrandbits(8))

    def _halt(self) -> None:
        self._body.stop()
        self.deadman.rest()
        self._next = None

    # -- in

    def _read(self) -> None:
        """Judge all commands in their order and execute only the newest admitted one; none beside a stop."""
        client = self._mqtt
        assert self._open
        self._next = None
        self._void = False
        now = time.ticks_ms()
        for chunk in range(_CHUNKS):
            if chunk:
                gc.collect()  # each command leaves some 200 bytes of garbage
            space = client.space()
            count = self._open.read(space) if len(space) else 0
            if not count and len(space) == len(client.data):  # nothing is left from the last turn either
                break
            self._take(count, now)
            if count < len(space):
                break
        self.stops.save()
        if self._next and not self._void:
            if self._body.drive(*self._next[:3]):
                self.deadman.limit_ms = self._limit_ms
                self.deadman.feed(now)
            else:
                self.deadman.rest()

    def _take(self, count: int, now: int) -> None:
        client = self._mqtt
        kind = client.take(count)
        while kind:
            if kind == "welcome":
                client.send(*mqtt.subscription(client.topics))
                self.connection.move("subscribing", now)
            elif kind == "pong":
                self._in_flight = self._behind
                self._asked = False
                self.connection.received(now)
            elif kind == "subscribed":
                granted = bytes(client.data[client.first : client.last])
                if granted[_DRIVE] > 127:
                    raise ValueError("subscription refused")
                self._stoppable = granted[_ESTOP] <= 127 and granted[_RESET] <= 127
                self._in_flight = 0
                self.connection.move("online", now)
                self._heartbeats = 0
                self._due = now
            elif client.retained:  # stale
                self.refused += 1
            else:
                self._obey(client.data[client.first : client.last] if kind == "publication" else None, now)
            kind = client.take()

    def _obey(self, raw: memoryview | None, now: int) -> None:
        """``raw`` None: the payload is too long."""
        topic = self._mqtt.topic
        stops = self.stops
        if topic == _DRIVE:
            self._judge(raw, now)
        elif raw is not None and not len(raw):  # it removes a retained message
            pass
        elif not self._stoppable:  # without a way to reset it, a stop is only a zero
            if topic == _ESTOP:
                stops.arbiter.judge(False, PERSON, 0, now)
                self._halt()
        elif topic == _ESTOP:
            if stops.stop(raw, self._clock.read(now)):
                self._halt()
                self._void = True
        elif topic == _RESET and raw is not None:
            stops.reset(raw, now)

    def _judge(self, raw: memoryview | None, now: int) -> None:
        command = None if raw is None else parse(raw)
        if command:
            x, z, y, run, valid_ms = command
            moves = x != 0.0 or z != 0.0 or y != 0.0
            limit_ms = self.stops.arbiter.judge(moves, run, valid_ms, now)
            if limit_ms != REFUSED:
                self._next = command
                self._limit_ms = limit_ms
                return
        self.refused += 1

    # -- out

    def publish(self, metric: bytes, payload: bytes) -> None:
        """Publish a report, or drop it if there is no room: it would be stale."""
        self._mqtt.publish(0, b"%s/outgoing/%s" % (self._root, metric), payload)

    def _describe(self, now: int) -> None:
        what = describe(self._clock.read(now), self._root, self._stoppable, self._charging)
        self._mqtt.publish(1, self._root + b"/outgoing/capabilities", what)
        self.stops.changed = True

    def _report(self, now: int) -> None:
        """Publish capabilities once, then states of the emergency stop, heartbeats and reports.

        Nothing while data is unsent: it would be stale.
        """
        if self._stuck:
            return
        stops = self.stops
        due = stops.due and self._heartbeats and self._stoppable
        if due and self._mqtt.publish(1, self._root + b"/outgoing/estop/mcu", stops.state()):
            stops.published(now)
            self._wrote = add(now, -_PACE_MS)  # it is sent at once, so the rest has room in the next turn
            return
        if diff(now, self._due) < 0:
            return
        if not self._heartbeats:
            self._describe(now)
            self._due = now
        else:
            self._due = add(self._due, _HEARTBEAT_MS)
            if diff(now, self._due) >= 0:  # missed heartbeats are skipped
                self._due = add(now, _HEARTBEAT_MS)
            self._mqtt.publish(1, self._online, b'{"t": %d, "online": true}' % self._clock.read(now))
            if self._heartbeats % _REPORT_EVERY == 1:
                self._body.report(self.publish)
        self._heartbeats += 1

    def _write(self, now: int) -> None:
        client = self._mqtt
        if diff(now, self._wrote) < _PACE_MS and client.waiting < len(client.out) // 2:
            return
        if client.waiting and not self._asked and self.connection.state == "online":
            self._asked = client.send(0xC0)
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
        self._stuck = client.waiting > 0
