"""What every robot on Wi-Fi does: be connected, obey drive commands, stop without them, tell how it is.

Whoever loses the broker stops at once: nobody could stop it otherwise. So what may take the processor for long (TLS,
a radio that starts) happens only while nothing moves.
"""

import random
import time
from binascii import hexlify

import machine
from micropython import const

from common import mqtt
from common.clock import Clock
from common.deadman import DeadMan
from common.link import Link
from common.payload import wanted
from common.settings import get
from common.sockets import Stream, ask_name
from common.ticks import add, diff
from common.topics import base
from common.wifi import Wifi

_DRIVE_LIMIT_MS = const(900)  # a slow turn of the loop still meets one second
_HEARTBEAT_MS = const(250)
_REPORT_EVERY = const(20)  # heartbeats: 5 s
_ALIVE_S = const(15)  # MQTT's keepalive: the will speaks after one and a half of it
_LONGEST_PAYLOAD = const(1024)
_OUTGOING = const(256)  # and three topics: behind a report there is room for the 20 answers that a broker waits for
_CHUNKS = const(3)  # of what waits, at most, are read in one turn
_PACE_MS = const(30)  # between two writes: acknowledgements travel together
# Writes under way, as far as pings tell. An ESP8266 takes eight; the ninth waits for up to ten seconds, non-blocking or
# not (micropython issue 19704), and a lost packet holds up all behind it.
_FLYING = const(7)

# Said at each connection, kept by the broker. What a robot does not offer is said too: readers assume it of one that is
# silent about it.
_CAPABILITIES = (
    b'{"schema":"pebble-capabilities/v1","t":%d,"value":{"identity":{"system":"%s","type":"%s","id":"%s"},'
    b'"transport":{"kind":"mqtt"},"drive":{"available":true,"controls":true,"topic":"%s/incoming/drive-values"},'
    b'"telemetry":{"touch_sensors":false,"charging_status":%s,"charging_topic":"%s/outgoing/charging-status",'
    b'"charging_level_topic":"%s/outgoing/charging-level"},"lights":{"solid":false,"flash":false},"video":%s,"audio":%s,'
    b'"soundboard":%s,"autonomy":%s,"system":{"reboot":%s,"service_restart":%s,"git_pull":%s}}}'
)


class NetworkRobot:
    """``step`` it forever. Look at ``link.state``, ``link.reason``, ``refused`` and ``trips`` to see how it fares."""

    def __init__(self, settings: dict, body, charging: bytes, wrap) -> None:
        """``body``: ``drive(x, z, y)`` moves and tells whether anything does, ``stop()``, ``report(say)``, ``keep()``.

        ``charging`` is true or false in JSON: does it report a charging status? ``wrap`` puts TLS around a socket, None
        does not.
        """
        now = time.ticks_ms()
        name = get(settings, "robot", "id")
        self._root = base(get(settings, "robot", "system", "pebble"), get(settings, "robot", "type", "robots"), name)
        self._online = self._root + b"/outgoing/online"
        self._topic = self._root + b"/incoming/drive-values"
        self._settings = settings
        self._charging = charging
        self._wrap = wrap
        self._wifi = Wifi(get(settings, "wifi", "ssid"), get(settings, "wifi", "password", ""))
        self._clock = Clock(settings.get("ntp", "pool.ntp.org"), now)
        self._host = get(settings, "mqtt", "host")
        self._mqtt = mqtt.Client(_LONGEST_PAYLOAD + len(self._topic) + 7, _OUTGOING + 3 * len(self._root))
        self._deadman = DeadMan(_DRIVE_LIMIT_MS)
        self._body = body
        self.link = Link()
        self.refused = 0  # drive commands that were kept by the broker, too long or no good
        self.trips = 0  # how often the motors ran until the dead-man stopped them
        self._open: Stream | None = None  # to the broker; before that, the question for its address
        self._flying = 0  # writes that may not have arrived yet
        self._behind = 0  # those behind the ping that was asked last
        self._asked = False  # is its answer still to come?
        self._stuck = False  # does something wait that could not be written?
        self._wrote = self._due = now  # the last write; the next heartbeat
        self._beats = 0

    def step(self) -> None:
        now = time.ticks_ms()
        self._guard(now)
        try:
            self._turn(now)
        except (OSError, ValueError, MemoryError) as error:
            self.link.reason = str(error)
            self._drop(now)
        self._guard(time.ticks_ms())

    def stop(self) -> None:
        self._body.stop()

    def _guard(self, now: int) -> None:
        if self._deadman.expired(now):
            self._body.stop()
            self.trips += 1
        self._body.keep()

    def _turn(self, now: int) -> None:
        server = self._wifi.step(now)
        self._clock.step(now, server)
        due = self.link.step(now, server != "")  # judges a silence before anything is read: what waited is stale
        if due == "drop":
            self._drop(now)
        elif due == "resolve":
            self._open = ask_name(self._host, server, now)  # type: ignore[assignment]
        if self.link.state == "resolving":
            self._connect(now)
        elif self._open and self._open.ready():
            self._read()
            if self.link.state == "online":
                self._tell(now)
            self._write(now)

    def _connect(self, now: int) -> None:
        """As soon as the address is known."""
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
            self._wrap.tell(self._clock.read(now))
        self._open = Stream(address, get(settings, "mqtt", "port", 8883 if self._wrap else 1883), self._wrap)
        self._mqtt.restart()
        packet = mqtt.login(
            settings["robot"]["id"].encode() + b"-" + hexlify(machine.unique_id()),
            get(settings, "mqtt", "username", "").encode(),
            get(settings, "mqtt", "password", "").encode(),
            self._online,
            b'{"t": 0, "online": false}',
            _ALIVE_S,
        )
        self._mqtt.send(*packet)
        self._wrote = now  # the last one may be longer ago than ticks can tell
        self._flying = 0
        self._asked = self._stuck = False
        self.link.move("connecting", now)

    def _drop(self, now: int) -> None:
        self._body.stop()
        self._deadman.rest()
        if self._open:
            self._open.socket.close()
            self._open = None
        self.link.lost(now, random.getrandbits(8))

    # -- in

    def _read(self) -> None:
        """Only the newest good command acts: what came before it is history already."""
        client = self._mqtt
        assert self._open
        axes = None
        now = time.ticks_ms()
        for _ in range(_CHUNKS):
            space = client.space()
            count = self._open.read(space) if len(space) else 0
            if not count and len(space) == len(client.data):  # nothing is left of the last time either
                break
            axes = self._take(count, now) or axes
            if count < len(space):
                break
        if axes:
            if self._body.drive(*axes):
                self._deadman.feed(now)
            else:
                self._deadman.rest()

    def _take(self, count: int, now: int) -> tuple[float, float, float] | None:
        """What the newest of the commands wants that is good."""
        client = self._mqtt
        commands = []  # where their payloads begin and end
        kind = client.take(count)
        while kind:
            if kind == "welcome":
                client.send(*mqtt.subscription(self._topic))
                self.link.move("subscribing", now)
            elif kind == "pong":
                self._flying = self._behind
                self._asked = False
                self.link.heard(now)
            elif kind == "subscribed":
                self._flying = 0
                self.link.move("online", now)
                self._beats = 0
                self._due = now
            elif client.retained:  # kept by the broker: nobody means it now
                self.refused += 1
            else:
                commands.append(client.first)
                commands.append(client.last)
            kind = client.take()
        self.refused += client.skipped
        client.skipped = 0
        axes = None
        while commands and not axes:
            last = commands.pop()
            axes = wanted(client.data[commands.pop() : last])
            if not axes:
                self.refused += 1
        return axes

    # -- out

    def say(self, metric: bytes, payload: bytes) -> None:
        """Publish it, or drop it if there is no room: late news is no news."""
        self._mqtt.publish(0, b"%s/outgoing/%s" % (self._root, metric), payload)

    def _describe(self, now: int) -> None:
        values = [self._clock.read(now)] + self._root.split(b"/") + [self._root, self._charging, self._root, self._root]
        what = _CAPABILITIES % tuple(values + [b'{"available":false,"controls":false}'] * 7)
        self._mqtt.publish(1, self._root + b"/outgoing/capabilities", what)

    def _tell(self, now: int) -> None:
        """Who we are, once; then the heartbeat, and now and then the rest. Nothing waits in a row: it would get old."""
        if self._stuck or diff(now, self._due) < 0:
            return
        if not self._beats:
            self._describe(now)
            self._due = now
        else:
            self._due = add(self._due, _HEARTBEAT_MS)
            if diff(now, self._due) >= 0:  # what a pause missed is not made up for
                self._due = add(now, _HEARTBEAT_MS)
            self._mqtt.publish(1, self._online, b'{"t": %d, "online": true}' % self._clock.read(now))
            if self._beats % _REPORT_EVERY == 1:
                self._body.report(self.say)
        self._beats += 1

    def _write(self, now: int) -> None:
        client = self._mqtt
        if diff(now, self._wrote) < _PACE_MS and client.waiting < len(client.out) // 2:
            return
        if client.waiting and not self._asked and self.link.state == "online":
            self._asked = client.send(0xC0)
            self._behind = -1  # the write with the ping is not behind it
        self._wrote = now
        assert self._open
        while client.waiting and self._flying < _FLYING:
            count = self._open.write(client.out, client.waiting)
            if not count:
                break
            client.sent(count)
            self._flying += 1
            self._behind += 1
        self._stuck = client.waiting > 0
