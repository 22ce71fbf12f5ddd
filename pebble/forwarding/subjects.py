"""Subjects: the meaning of a topic to one robot, which is a channel (renamed or not) or a family of unknown metrics."""

from functools import cache, cached_property
from math import inf

from msgspec import Struct

from pebble.config import Config
from pebble.contract import CHANNELS, INCOMING, OUTGOING, WAITS_S, Channel, Kind
from pebble.contract.channels import BETWEEN_ROBOTS
from pebble.contract.payloads import ControlRequest, Drive, EstopCommand
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


class Subject(Struct, frozen=True, eq=False, dict=True):
    """The meaning of all topics of a channel, or of a family; ``channel`` is None for metrics beyond the contract.

    All topics of a channel or family share one object, so tables by subject are small and fast.
    """

    kind: Kind
    channel: Channel | None = None
    qos: int = 0
    retain: bool = False  # assumed if the broker hides it
    thin: bool = False  # the way to it may be a thin link

    @cached_property
    def stays(self) -> bool:
        """True if messages of this subject never leave the robot."""
        return self.channel is not None and not self.channel.remote

    @cached_property
    def bridged(self) -> bool:
        """True if the bridge forwards messages of this subject; media has connections of its own."""
        return self.channel is None or self.channel.bridged

    @cached_property
    def waits_s(self) -> float:
        """Seconds for which a message may wait before it is stale."""
        if not self.kind.one_shot:
            return inf
        if self.channel is None:
            return WAITS_S
        thin_s = self.channel.thin_waits_s
        return thin_s if self.thin and thin_s is not None else self.channel.waits_s

    @cached_property
    def prompt(self) -> bool:
        """True if a message never waits for room on a thin link."""
        return self.channel is not None and self.channel.prompt

    @cached_property
    def is_stop(self) -> bool:
        return self.channel is not None and self.channel.payload is EstopCommand

    @cached_property
    def drives(self) -> bool:
        return self.channel is not None and self.channel.payload is Drive

    @cached_property
    def stamped(self) -> bool:
        """True if messages may tell their age: by the time of a clock, and a key or id that identifies the clock."""
        return self.channel is not None and self.channel.payload in (Drive, ControlRequest)

    @cached_property
    def runs(self) -> bool:
        """True if a message starts something, which must happen only once even if the message circulates."""
        return self.kind in (Kind.COMMAND, Kind.ACTION) and not self.drives and not self.is_stop

    @cached_property
    def counted(self) -> bool:
        """True if the robot limits the number of such messages: actions, and metrics beyond the contract."""
        return self.channel is None or self.kind is Kind.ACTION

    @cached_property
    def is_two_way(self) -> bool:
        """True if messages pass both ways even while remote-mirror is off. A broker may then send them back."""
        return self.kind in (Kind.FLAG, Kind.ACTION)


class Subjects(dict[str, Subject | None]):
    """Subjects by effective topic, those of all serial instances included.

    The subject is None for a topic that is invalid or not this robot's. A topic that was looked up before is found
    without calling a Python function. ``config``: the robot's, or only its base if no topic is renamed.
    """

    def __init__(self, config: Config | str) -> None:
        super().__init__()
        self._subject = cache(Subject)
        if isinstance(config, str):
            self._base, self._thin = config, False  # _thin: see Subject
            self._addresses = [Addresses(config)]
        else:
            self._base, self._thin = config.base, config.services.mqtt_bridge.link.profile != "wide"
            instances = dict.fromkeys(["", *config.serial_instances()])  # "": the section of all serial lines
            self._addresses = [Addresses(view_of(config, instance)) for instance in instances]
        self._between_robots = tuple(f"{self._base}/{family}" for family in BETWEEN_ROBOTS)
        self._incoming = f"{self._base}/{INCOMING}/".encode()
        topics = (topic.encode() for topic in self.topics(*CHANNELS))  # others than incoming stay whole: no metric
        self._known_metrics = frozenset(topic.removeprefix(self._incoming) for topic in topics)

    def __missing__(self, topic: str) -> Subject | None:
        if len(self) >= _REMEMBERED:
            self.clear()
        subject = self[topic] = self._find(topic)
        return subject

    def invented(self, topic: bytes) -> Kind | None:
        """Return the kind of an incoming topic (as UTF-8) that the contract does not know; else None. Fast."""
        if not topic.startswith(self._incoming):
            return None
        metric = topic[len(self._incoming) :]
        if metric in self._known_metrics:
            return None
        return Kind.FLAG if metric.startswith(b"flags/") else Kind.COMMAND

    def filters(self, *directions: str) -> list[str]:
        """Return the filters for all topics of ``directions``; no two of them overlap."""
        families = [f"{self._base}/{direction}/#" for direction in directions]
        topics = (  # renamed or not
            addresses[channel].topic
            for addresses in self._addresses
            for channel in CHANNELS
            if channel.direction in directions and not channel.is_pattern
        )
        outside = (topic for topic in topics if not any(matches(family, topic) for family in families))
        return [*families, *dict.fromkeys(outside)]

    def topics(self, *channels: Channel) -> list[str]:
        """Return the topics of ``channels``, those of every serial instance included."""
        return list(dict.fromkeys(addresses[channel].topic for addresses in self._addresses for channel in channels))

    @cached_property
    def flags(self) -> list[str]:
        """The topics of the contract's flags."""
        return self.topics(*(flag for flag in CHANNELS if flag.kind is Kind.FLAG and not flag.is_pattern))

    @cached_property
    def probed(self) -> list[str]:
        """Topics that are probed for cycles at each connection, before they are used."""
        actions = (channel for channel in CHANNELS if channel.kind is Kind.ACTION)
        return self.topics(*(channel for channel in CHANNELS if channel.payload is Drive), *actions)

    def _find(self, topic: str) -> Subject | None:  # None: invalid, or not this robot's
        try:
            check_topic(topic)
        except TransportError:
            return None
        if topic.startswith(self._between_robots):
            return None  # such topics are never forwarded
        for addresses in self._addresses:
            channel = addresses.channel(topic)
            if channel is not None:
                address = addresses[channel]
                return self._subject(channel.kind, channel, address.qos, address.retain, self._thin)
        suffix = topic.removeprefix(f"{self._base}/")
        if suffix == topic:
            return None
        return next((self._subject(kind) for family, kind in _FAMILIES if suffix.startswith(family)), None)
