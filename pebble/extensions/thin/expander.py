"""Splits groups of streams beside a broker, so that every tool there sees the plain topics."""

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
        self.named = False
        self.dictionaries: dict[int, bytes] = {}  # the newest, and the one before
        self.other_at = -inf  # when one with a smaller id was heard
        self.own_at = -inf  # when this one said what it has heard last of itself
        self.works = False  # this expander, not another one, takes its groups apart
        self.short, self.short_at = "", -inf  # the topic of its groups besides the plain one, and when it was heard


class Expander:
    """An expander of groups on a connection; its owner calls :meth:`announce` every ANNOUNCE_S.

    If there are several, the one with the smallest id works. Each goes by the announcements as the broker passes them
    on, its own included: all see them between the same groups, so no group is taken apart twice, and what comes long
    after its last announcement has waited, and is dropped. Members become nothing but streams: no state, stop or
    command is published for a robot. While two robots claim a short name, neither has it.
    """

    def __init__(self, transport: Transport, clock: Callable[[], float] = time.monotonic, id_: str = "") -> None:
        self.id = id_ or secrets.token_hex(4)
        self.counts: Counter[str] = Counter()
        self._transport, self._clock = transport, clock
        self._robots: dict[str, _Robot] = {}
        self._number, self._said_at = 0, dict[int, float]()  # of announcements
        self._lock = threading.RLock()

    def start(self) -> None:
        """Subscribe, first to the announcements of other expanders."""
        for suffix, receive in (
            (EXPANDER.suffix, self._receive_other),
            (f"{INCOMING}/{BY}/+/{EXPANDER.metric}", self._receive_other),
            (WIRE.suffix, self._receive_wire),
            (STREAMS.suffix, self._receive_group),
        ):
            self._transport.subscribe(f"{_ANY}/{suffix}", receive, qos=QoS.DELIVERED, direct=True)
        self._transport.subscribe(f"{SHORT}+", self._receive_short, qos=QoS.LATEST, direct=True)

    def announce(self) -> None:
        """Announce this expander to robots that send groups, unless another expander works."""
        with self._lock:
            self._number = (self._number + 1) % _NUMBERS
            self._said_at[self._number] = now = self._clock()
            silent_since = now - HEARD_S
            robots = [(base, robot) for base, robot in self._robots.items() if robot.other_at < silent_since]
        for base, robot in robots:
            short = {"short": robot.short} if robot.short_at >= silent_since else {}
            said = {"id": self.id, "n": self._number, **short}
            self._transport.publish(EXPANDER.topic(base), msgspec.json.encode(said), qos=QoS.DELIVERED)

    def is_named(self, base: str) -> bool:
        """True if a robot takes commands only on topics with an account's name."""
        robot = self._robots.get(base)
        return robot is not None and robot.named

    # -- the transport's thread

    def _receive_other(self, message: Message) -> None:
        base = _base(message.topic)
        with self._lock:
            robot = self._robots.get(base)
            if robot is None or message.retain:
                return
            try:
                said = codec.plain(EXPANDER, message.payload)
            except PayloadError:
                return
            name, number = (said.get("id"), said.get("n")) if isinstance(said, dict) else (None, None)
            if name == self.id:
                robot.own_at = self._said_at.get(number, -inf) if isinstance(number, int) else -inf
                robot.works = self._clock() - robot.other_at > HEARD_S
            elif isinstance(name, str) and name < self.id:
                robot.works, robot.other_at = False, self._clock()

    def _receive_wire(self, message: Message) -> None:
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
                robot.short, robot.short_at = short, -inf
            if isinstance(wire.dict_id, int) and isinstance(wire.dict, str):
                robot.dictionaries.pop(wire.dict_id, None)
                former = list(robot.dictionaries.items())[-1:]
                robot.dictionaries = {**dict(former), wire.dict_id: wire.dict.encode()}

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
            if not (is_stream(channel) if channel is not None else not is_reserved(metric)):
                self.counts["refused members"] += 1
                continue
            qos = QoS.LATEST if channel is None else QoS(channel.default_qos)
            try:
                self._transport.publish(f"{base}/{OUTGOING}/{metric}", payload, qos=qos)
            except TransportError:  # no topic
                self.counts["refused members"] += 1
                continue
            self.counts["streams"] += 1
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
