"""Who drives a robot, among servers of operator pages and terminals: each announces whom it lets drive. Pure.

The newest of several wins, so that a take-over ends what was before it. Robots do not know of it: those that keep
control themselves (control.py) need none of it.
"""

from typing import NamedTuple

from pebble.client.control import IDLE_S
from pebble.contract import DRIVING, codec
from pebble.contract.identity import SERVERS, Identity, parse_topic
from pebble.contract.payloads import Driver, Driving
from pebble.errors import PayloadError
from pebble.transports import Message, QoS

EVERY_S = 1.0
VALID_S = 3.0  # so long an announcement counts
LISTEN_S = 1.5  # before it is known that there is no other driver
ANSWER_S = 0.25  # a broker that acknowledges nothing for longer would deliver commands late, all at once
FILTER = DRIVING.filter(f"+/{SERVERS}/+")

_MAX_SERVERS = 100  # whose announcements are remembered
_UNANSWERED = 8  # own announcements that wait for their way back


class OtherDriver(NamedTuple):
    """A driver at another server or terminal."""

    by: str
    device: str
    server: str
    since_ms: int
    at: float

    def __str__(self) -> str:
        """``ann (phone) at fair-1``."""
        device = f" ({self.device})" if self.device else ""
        return f"{self.by or 'unknown'}{device} at {self.server}"


class DriverLease:
    """The lease of one robot, ``base``, held here or elsewhere. ``server`` is a new id of this process."""

    def __init__(self, base: str, server: str, *, by: str, device: str) -> None:
        self.held = False
        self.round_trip_s: float | None = None  # of the newest own announcement, through the broker and back
        self.device = device[:64]
        self._base, self._server, self._by = base, server, by[:64]
        self._topic = DRIVING.topic(Identity(base.partition("/")[0], SERVERS, server).base)
        self._since_ms = 0
        self._announces = True
        self._used_at = self._announced_at = float("-inf")
        self._others: dict[str, OtherDriver] = {}
        self._unanswered: dict[int, float] = {}  # by stamp: when it was sent

    def receive(self, message: Message, now: float) -> None:
        """Update from any message. Retained announcements are old, and ignored."""
        address = parse_topic(message.topic)
        if address is None or not address.identity.is_server or address.metric != DRIVING.metric or message.retain:
            return
        try:
            payload: Driving = codec.decode(DRIVING, message.payload)
        except PayloadError:
            return
        if address.identity.id == self._server:
            self._answered(payload.t, now)
            return
        driver = payload.robots.get(self._base)
        if driver is None:
            self._others.pop(address.identity.id, None)
        elif address.identity.id in self._others or len(self._others) < _MAX_SERVERS:
            self._update(OtherDriver(driver.by, driver.device, address.identity.id, driver.since, now))

    def other(self, now: float) -> OtherDriver | None:
        """Who drives the robot elsewhere; None: it is free, or the lease is held here."""
        self._others = {server: one for server, one in self._others.items() if now - one.at <= VALID_S}
        if self.held:
            return None
        return max(self._others.values(), key=lambda one: (one.since_ms, one.server), default=None)

    def take(self, now: float, epoch_ms: int, *, announce: bool = True) -> None:
        """Hold the lease from now on, also if it is held elsewhere: a newer one wins.

        Without ``announce`` nobody is told, and nobody ends it: then it only measures the way through the broker.
        """
        newest = max((one.since_ms for one in self._others.values()), default=0)
        self.held, self._announces = True, announce
        self._since_ms, self._used_at = max(epoch_ms, newest + 1), now
        self._announced_at = float("-inf")

    def use(self, now: float) -> None:
        """A gesture lasts."""
        self._used_at = now

    def release(self) -> None:
        """Give it back; the next :meth:`tick` announces that."""
        if self.held:
            self.held, self.round_trip_s = False, None  # it is no longer measured
            self._announced_at = float("-inf")

    def tick(self, now: float, epoch_ms: int) -> list[Message]:
        """What to publish now: once a second while the lease is held, and once when it is no longer."""
        if self.held and now - self._used_at > IDLE_S:
            self.release()
        due = self._announced_at + EVERY_S
        if not self._since_ms or now < due:
            return []
        robots = {}
        if self.held:
            self._announced_at = now
        if self.held and self._announces:
            robots[self._base] = Driver(by=self._by, device=self.device, since=self._since_ms)
        if not self.held:
            self._since_ms = 0
        self._unanswered = {**dict(list(self._unanswered.items())[-_UNANSWERED:]), epoch_ms: now}
        payload = codec.encode(DRIVING, Driving(t=epoch_ms, robots=robots))
        return [Message(self._topic, payload, QoS(DRIVING.default_qos))]

    def late_s(self, now: float) -> float:
        """How long the oldest own announcement has been on its way; 0: none is, or none has ever come back."""
        if self.round_trip_s is None:
            return 0.0
        return now - min(self._unanswered.values(), default=now)

    def reconnected(self) -> None:
        """What was on its way is lost."""
        self._unanswered.clear()

    def _update(self, one: OtherDriver) -> None:
        self._others[one.server] = one
        if self.held and self._announces and (one.since_ms, one.server) > (self._since_ms, self._server):
            self.release()

    def _answered(self, stamp: int, now: float) -> None:
        sent_at = self._unanswered.get(stamp)
        if sent_at is not None:
            self.round_trip_s = now - sent_at
            self._unanswered = {t: at for t, at in self._unanswered.items() if t > stamp}
