"""The common part of all robots on Wi-Fi: commands, stops, dead-man's switch, heartbeat and reports.

A robot that loses the broker stops at once, because no operator could stop it. Work that blocks the processor for long
(TLS, starting the radio) is done only while the motors are off.
"""

import time

from micropython import const

from common.arbiter import PERSON, REFUSED
from common.capabilities import describe
from common.deadman import DeadMan
from common.estop import EmergencyStop
from common.payload import parse
from common.settings import base, get
from common.ticks import add, diff
from wifi.clock import Clock
from wifi.session import Session
from wifi.wifi import Wifi

_DRIVE_LIMIT_MS = const(900)  # one second, including a slow turn of the loop
# Places of the topics, stops first.
_ESTOP = const(0)
_DRIVE = const(1)
_CONTROL = const(2)
_TAKE = const(3)
_RESET = const(4)
_GROUP = const(5)
_HEARTBEAT_MS = const(250)
_REPORT_EVERY = const(20)  # heartbeats: 5 s


class NetworkRobot:
    """A robot; call ``step`` forever. Status: ``session.connection``, ``stops``, ``deadman.trips``, ``refused``."""

    def __init__(self, settings: dict, body, charging: bytes, wrap) -> None:
        """Store the arguments. ``wrap`` wraps a socket in TLS; None: no TLS.

        ``body`` has ``drive(x, z, y)``, True if anything moves; ``stop()``; ``report(publish)``; ``refresh()``. It has
        ``axes`` if it has more than x and z (see `describe`), and ``groups`` if its board has room for groups of
        commands. ``charging``: whether it reports a charging status, in JSON.
        """
        now = time.ticks_ms()
        name = get(settings, "robot", "id")
        root = base(get(settings, "robot", "system", "pebble"), get(settings, "robot", "type", "robots"), name)
        self.name = get(settings, "robot", "name", "")
        self.charging = charging
        self._wifi = Wifi(get(settings, "wifi", "ssid"), get(settings, "wifi", "password", ""))
        self._clock = Clock(settings.get("ntp", "pool.ntp.org"), now)
        names = None
        if ("open", "login", "named").index(get(settings, "security", "level", "open")) == 2:  # any other: ValueError
            from common import names  # type: ignore[assignment]
        words = "drive", "free", "refuse"  # numbered as in `Lease`; without a setting refuse at level named, else free
        strangers = words.index(get(settings, "security", "strangers", words[2 if names else 1]))
        topics = b"estop", b"drive-values", b"control", b"control/take", b"estop-reset"
        if hasattr(body, "groups"):
            topics += (b"group",)
        plain = len(topics)  # how many of them, from the first on, are subscribed to without an account
        if names:  # without an account: stops and zeros; control, too, if strangers may drive
            plain = _DRIVE + 1 if strangers == 2 else _CONTROL + 1  # 2: strangers may not drive
        self.session = Session(settings, root, topics, plain, names, wrap, self._take)
        self.stops = EmergencyStop(now, _DRIVE_LIMIT_MS, strangers, names)
        self.deadman = DeadMan(_DRIVE_LIMIT_MS)
        self.body = body
        self.refused = 0  # commands that were retained, and drive commands that were invalid or not admitted
        self._next: tuple | None = None  # the newest drive command admitted in this turn, as by `parse`: x, z, y, ...
        self._limit_ms = 0  # how long it moves the motors
        self._void = False  # a stop was received in this turn
        self._due = now  # the next heartbeat
        self._heartbeats = 0  # since the broker granted the topics; before the first one capabilities are published
        self.groups = b""  # the members of groups that it takes; none if the broker refuses their topic

    def step(self) -> None:
        now = time.ticks_ms()
        self._guard(now)
        try:
            self._turn(now)
        except (OSError, ValueError, MemoryError) as error:
            self._halt()
            self.stops.save()
            self.session.drop(now, str(error))
        self._guard(time.ticks_ms())  # again: the turn itself may have taken long

    def stop(self) -> None:
        self.body.stop()

    def _guard(self, now: int) -> None:
        """Stop the motors if control has passed on or no command came in time; let the body send again what failed."""
        stops = self.stops
        stops.tick(now)
        if stops.lease.halts:  # each new driver begins with wheels at rest
            stops.lease.halts = False
            self._halt()
        if self.deadman.expired(now):
            self.body.stop()
        self.body.refresh()

    def _turn(self, now: int) -> None:
        server = self._wifi.step(now)
        self._clock.step(now, server)
        session = self.session
        if session.step(now, server, self._clock):
            self._read()
            session.write(now, session.connection.state == "online" and self._report(now))

    def _halt(self) -> None:
        self.body.stop()
        self.deadman.rest()
        self._next = None

    # -- in

    def _read(self) -> None:
        """Judge all received commands in order. Execute only the newest admitted one, and none beside a stop."""
        self._next = None
        self._void = False
        now = time.ticks_ms()
        self.session.read(now)
        self.stops.save()  # takes a while, but writes only after a stop or a reset: then the motors are off
        if self._next and not self._void and not self.stops.lease.halts:
            if self.body.drive(*self._next[:3]):  # x, z, y
                self.deadman.limit_ms = self._limit_ms
                self.deadman.feed(now)
            else:
                self.deadman.rest()

    def _take(self, kind: str, now: int) -> None:
        """Handle the answer to a subscription, or a publication."""
        client = self.session.client
        raw = client.data[client.first : client.last]
        if kind == "subscribed":
            results = bytes(raw)  # in the order of Client.subscribe: topics without an account come first
            granted = results[-len(client.topics) :]  # of all topics, with an account if names are checked
            if granted[_DRIVE] > 127:  # 128 is a refusal (3.9.3)
                raise ValueError("subscription refused")
            # A stop counts without an account, too: the result for its topic without one is the first of all.
            self.stops.stoppable = results[_ESTOP] <= 127 and granted[_RESET] <= 127
            self.stops.controllable = granted[_CONTROL] <= 127
            # The last one is the topic of groups, unless the body takes none: then it has no ``groups`` either.
            self.groups = getattr(self.body, "groups", b"") if granted[-1] <= 127 else b""
            self._heartbeats = 0
            self._due = now
        elif client.retained:  # stale
            self.refused += 1
        else:
            self._obey(raw if kind == "publication" else None, now)  # None: it is "too long"

    def _obey(self, raw: memoryview | None, now: int) -> None:
        """Obey a command. ``raw`` None: the payload is too long."""
        topic = self.session.client.topic
        stops = self.stops
        by = self.session.client.by
        sender = by or ("-" if stops.names else "")  # as Linux robots show a sender without a name
        if topic == _DRIVE or topic == _GROUP:  # noqa: SIM109 - a tuple would need memory
            self._judge(raw, sender, now, topic == _GROUP)
        elif raw is not None and not len(raw):  # it removes a retained message
            pass
        elif topic == _CONTROL or topic == _TAKE:  # noqa: SIM109 - a tuple would need memory
            if raw is not None:
                stops.request(raw, sender, topic == _TAKE, now)
        elif not stops.stoppable:  # without a way to reset it, a stop is only a zero
            if topic == _ESTOP:
                stops.arbiter.judge(False, PERSON, 0, now)  # as a zero of a person
                self._halt()
        elif topic == _ESTOP:
            if stops.stop(raw, by, self._clock.read(now)):
                self._halt()
                self._void = True
        elif topic == _RESET and raw is not None:
            stops.reset(raw, now)

    def _judge(self, raw: memoryview | None, by: str, now: int, grouped: bool) -> None:
        """Note a drive command of ``by`` if it is admitted, else count it. ``raw``, ``grouped``: see _obey, `parse`."""
        command = None if raw is None else parse(raw, grouped)
        if command:
            x, z, y, run, valid_ms, key = command
            moves = x != 0.0 or z != 0.0 or y != 0.0
            limit_ms = self.stops.arbiter.judge(moves, run, valid_ms, now, key, by)
            if limit_ms != REFUSED:
                self._next = command
                self._limit_ms = limit_ms
                return
        self.refused += 1

    # -- out

    def _report(self, now: int) -> bool:
        """Publish what is due: capabilities once, then states, heartbeats and reports. True: write it at once.

        Nothing while data is unsent: it would be stale.
        """
        session = self.session
        if session.stuck:
            return False
        stops = self.stops
        if stops.due and self._heartbeats and session.publish(stops.due, stops.state(), 1):
            stops.published(now)
            return True  # written at once it leaves room for the rest, in the next turn
        if diff(now, self._due) < 0:
            return False
        if not self._heartbeats:
            now_ms = self._clock.read(now)
            axes = getattr(self.body, "axes", b"")
            text = describe(now_ms, session.root, self.name, stops, self.charging, axes, self.groups)
            session.publish(b"capabilities", text, 1)
            stops.changed = stops.lease.changed = True  # on a new connection the states follow, changed or not
            self._due = now  # the first heartbeat
        else:
            self._due = add(self._due, _HEARTBEAT_MS)
            if diff(now, self._due) >= 0:  # missed heartbeats are skipped
                self._due = add(now, _HEARTBEAT_MS)
            session.publish(b"online", b'{"t": %d, "online": true}' % self._clock.read(now), 1)
            if self._heartbeats % _REPORT_EVERY == 1:  # with the first heartbeat, then with every few
                self.body.report(session.publish)
        self._heartbeats += 1
        return False
