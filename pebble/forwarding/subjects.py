"""What a topic means to one robot: its channel, renamed or not, or the family of an unknown metric."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from pebble.config import Config
from pebble.contract import CHANNELS, ESTOP, INCOMING, OUTGOING, Channel, Kind
from pebble.errors import TransportError
from pebble.runtime.addresses import Addresses
from pebble.runtime.process import view_of
from pebble.transports.topics import check_topic, matches

_REMEMBERED = 4096  # topics; other programs may invent any number

#: Metrics the contract does not know, by the families of the paper's Table A.2.
_FAMILIES = (
    (f"{INCOMING}/flags/", Kind.FLAG),
    (f"{INCOMING}/", Kind.COMMAND),
    (f"{OUTGOING}/", Kind.EVENT),
)


@dataclass(frozen=True)
class Subject:
    """One topic below our own identity. ``channel`` is None for metrics that are not in the contract."""

    kind: Kind
    channel: Channel | None = None
    qos: int = 0
    retain: bool = False  # assumed if the broker hides it

    @cached_property
    def stays(self) -> bool:
        """Whether it never leaves the robot."""
        return self.channel is not None and not self.channel.remote

    @cached_property
    def bridged(self) -> bool:
        """Whether it is forwarded with other messages; media has connections of its own."""
        return self.channel is None or self.channel.bridged

    @cached_property
    def is_stop(self) -> bool:
        return self.channel is ESTOP


class _Unknown:
    """Not looked up yet."""


_UNKNOWN = _Unknown()


class Subjects:
    """Looks subjects up by effective topic, those of every serial instance included."""

    def __init__(self, config: Config) -> None:
        self._base = config.base
        names = dict.fromkeys(["", *config.serial_instances()])
        self._addresses = [Addresses(view_of(config, name)) for name in names]
        self._known: dict[str, Subject | _Unknown | None] = {}
        self._incoming = f"{self._base}/{INCOMING}/".encode()
        named = (addresses[one].topic.encode() for addresses in self._addresses for one in CHANNELS)
        self._named = frozenset(topic.removeprefix(self._incoming) for topic in named)

    def __getitem__(self, topic: str) -> Subject | None:
        """The subject of ``topic``; None if it is not this robot's, or not a valid topic."""
        found = self._known.get(topic, _UNKNOWN)  # one step: another thread may clear them
        if not isinstance(found, _Unknown):
            return found
        if len(self._known) >= _REMEMBERED:
            self._known.clear()
        subject = self._known[topic] = self._find(topic)
        return subject

    def invented(self, topic: bytes) -> Kind | None:
        """The kind of an incoming topic that the contract does not name, as UTF-8; found out quickly."""
        if not topic.startswith(self._incoming):
            return None
        metric = topic[len(self._incoming) :]
        if metric in self._named:
            return None
        return Kind.FLAG if metric.startswith(b"flags/") else Kind.COMMAND

    def filters(self, *directions: str) -> list[str]:
        """What to subscribe to for everything of ``directions``: no two of the filters overlap."""
        families = [f"{self._base}/{direction}/#" for direction in directions]
        renamed = (
            addresses[channel].topic
            for addresses in self._addresses
            for channel in CHANNELS
            if channel.direction in directions and not channel.is_pattern
        )
        outside = (topic for topic in renamed if not any(matches(family, topic) for family in families))
        return [*families, *dict.fromkeys(outside)]

    def topics(self, *channels: Channel) -> list[str]:
        """The topics of ``channels``, those of every serial instance included."""
        return list(dict.fromkeys(addresses[channel].topic for addresses in self._addresses for channel in channels))

    def _find(self, topic: str) -> Subject | None:
        try:
            check_topic(topic)
        except TransportError:
            return None
        for addresses in self._addresses:
            channel = addresses.channel(topic)
            if channel is not None:
                address = addresses[channel]
                return Subject(channel.kind, channel, address.qos, address.retain)
        suffix = topic.removeprefix(f"{self._base}/")
        if suffix == topic:
            return None
        return next((Subject(kind) for family, kind in _FAMILIES if suffix.startswith(family)), None)
