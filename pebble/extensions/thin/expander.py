"""An expander: it splits groups of streams beside a broker, so that every tool there sees the plain topics."""

import logging
import re
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable
from math import inf

import msgspec

from pebble.contract import EXPANDER, INCOMING, OUTGOING, STREAMS, WIRE, Channel, Kind, channel_of, codec
from pebble.contract.channels import SHORT, is_reserved
from pebble.contract.names import BY
from pebble.contract.payloads import Wire
from pebble.errors import PayloadError, TransportError
from pebble.extensions.thin.packed import HEARD_S, unpacked
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports import Message, QoS, Transport

ANNOUNCE_S = 2.0  # between two signs that an expander is there
_NUMBERS = 100  # of announcements, then they begin again
_log = RateLimitedLog(logging.getLogger(__name__), period_s=60.0)
_ANY = "+/+/+"
_BASE = re.compile(rf"((?:[^/]+/){{2}}[^/]+)/(?:{INCOMING}|{OUTGOING})/")


class _Robot:
    """The state of a robot that sends groups, as an expander knows it; times are on the expander's clock."""

    def __init__(self) -> None:
        self.named = False  # it takes commands only on topics with an account's name
        self.dictionaries: dict[int, bytes] = {}  # by number: the newest, and the one before
        self.other_at = -inf  # when an announcement of an expander with a smaller id was heard
        self.own_at = -inf  # when this expander sent the newest of its announcements that came back from the broker
        self.works = False  # this expander, not another one, takes its groups apart
        self.short, self.short_at = "", -inf  # its short topic for groups, and when a group last came there


class Expander:
    """An expander of groups on a connection; its owner calls :meth:`announce` every ANNOUNCE_S.

    Of several, only the one with the smallest id works: each hears the ids in all announcements. The broker sends
    announcements and groups to all expanders in the same order, so no group is taken apart twice. A group that comes
    long after this expander's last announcement has waited, and is dropped. Only streams are published: no state, stop
    or command of a robot. A robot's state ``wire`` may name a short topic for its groups; while two robots name the
    same, groups there are dropped.
    """

    def __init__(self, transport: Transport, clock: Callable[[], float] = time.monotonic, id_: str = "") -> None:
        self.id = id_ or secrets.token_hex(4)
        self.counts: Counter[str] = Counter()
        self._transport, self._clock = transport, clock
        self._robots: dict[str, _Robot] = {}  # by base topic; `_Robot` explains its times
        self._number, self._sent_at = 0, dict[int, float]()  # of the newest announcement; by number, when it was sent
        self._lock = threading.RLock()

    def start(self) -> None:
        """Subscribe, first to announcements: they tell which expander works."""
        for suffix, receive in (
            (EXPANDER.suffix, self._receive_announcement),
            (f"{INCOMING}/{BY}/+/{EXPANDER.metric}", self._receive_announcement),  # to robots that check names
            (WIRE.suffix, self._receive_wire),
            (STREAMS.suffix, self._receive_group),
        ):
            self._transport.subscribe(f"{_ANY}/{suffix}", receive, qos=QoS.DELIVERED, direct=True)
        self._transport.subscribe(f"{SHORT}+", self._receive_short, qos=QoS.LATEST, direct=True)

    def announce(self) -> None:
        """Announce this expander to robots that send groups, unless another expander works."""
        with self._lock:
            self._number = (self._number + 1) % _NUMBERS
            self._sent_at[self._number] = now = self._clock()
            silent_since = now - HEARD_S
            robots = [(base, robot) for base, robot in self._robots.items() if robot.other_at < silent_since]
        for base, robot in robots:
            announcement: dict[str, object] = {"id": self.id, "n": self._number}
            if robot.short_at >= silent_since:
                announcement["short"] = robot.short
            self._transport.publish(EXPANDER.topic(base), msgspec.json.encode(announcement), qos=QoS.DELIVERED)

    def is_named(self, base: str) -> bool:
        """True if a robot takes commands only on topics with an account's name."""
        robot = self._robots.get(base)
        return robot is not None and robot.named

    # -- the transport's thread

    def _receive_announcement(self, message: Message) -> None:
        """Handle an announcement to a robot, of this expander or of another one."""
        base = _base(message.topic)
        with self._lock:
            robot = self._robots.get(base)
            if robot is None or message.retain:
                return
            try:
                announcement = codec.plain(EXPANDER, message.payload)
            except PayloadError:
                return
            if not isinstance(announcement, dict):
                return
            id_, number = announcement.get("id"), announcement.get("n")
            if id_ == self.id:
                robot.own_at = self._sent_at.get(number, -inf) if isinstance(number, int) else -inf
                robot.works = self._clock() - robot.other_at > HEARD_S
            elif isinstance(id_, str) and id_ < self.id:
                robot.works, robot.other_at = False, self._clock()

    def _receive_wire(self, message: Message) -> None:
        """Note how a robot sends its groups: short topic, dictionary. An empty message: it sends none any more."""
        base = _base(message.topic)
        with self._lock:
            if not message.payload:
                self._robots.pop(base, None)
                return
            try:
                wire: Wire = codec.decode(WIRE, message.payload)
            except PayloadError as error:
                self._refuse(base, error)
                return
            robot = self._robots.setdefault(base, _Robot())
            robot.named = wire.named
            short = wire.short if isinstance(wire.short, str) else ""
            if short != robot.short:
                robot.short, robot.short_at = short, -inf  # no group has come there yet
            if isinstance(wire.dict_id, int) and isinstance(wire.dict, str):
                others = [entry for entry in robot.dictionaries.items() if entry[0] != wire.dict_id]
                newest = (wire.dict_id, wire.dict.encode())
                # One older stays for groups under way. A new object: _expand reads the present one without the lock.
                robot.dictionaries = dict([*others[-1:], newest])

    def _receive_short(self, message: Message) -> None:
        with self._lock:
            bases = [base for base, robot in self._robots.items() if robot.short == message.topic]
            if len(bases) != 1 or message.retain:
                return
            self._robots[bases[0]].short_at = self._clock()
        self._expand(bases[0], message.payload)

    def _receive_group(self, message: Message) -> None:
        if not message.retain:
            self._expand(_base(message.topic), message.payload)

    def _expand(self, base: str, raw: bytes) -> None:
        """Publish the streams of a robot's group, if this expander works and the group has not waited."""
        with self._lock:
            robot = self._robots.get(base)
            if robot is None or not robot.works:
                return
            if self._clock() - robot.own_at > HEARD_S:
                self.counts["late groups"] += 1
                return
            dictionaries = robot.dictionaries
        try:
            streams = unpacked(raw, dictionaries)
        except PayloadError as error:
            self._refuse(base, error)
            return
        for metric, payload in streams.items():
            channel = channel_of(f"{OUTGOING}/{metric}")
            # A metric that the contract does not know passes as well, unless only the robot itself may define it.
            may_pass = not is_reserved(metric) if channel is None else is_stream(channel)
            if may_pass:
                qos = QoS.LATEST if channel is None else QoS(channel.default_qos)
                try:
                    self._transport.publish(f"{base}/{OUTGOING}/{metric}", payload, qos=qos)
                except TransportError:  # the metric makes no valid topic
                    may_pass = False
            self.counts["streams" if may_pass else "refused members"] += 1
        self.counts["groups"] += 1

    def _refuse(self, base: str, error: PayloadError) -> None:
        self.counts["refused groups"] += 1
        _log.warning(base, "a group of %s is dropped: %s", base, error)


def is_stream(channel: Channel) -> bool:
    """True if messages of this channel may be in a group."""
    return channel.kind is Kind.STREAM and channel.remote and channel.bridged and channel is not STREAMS


def _base(topic: str) -> str:
    match = _BASE.match(topic)
    return match[1] if match is not None else ""
