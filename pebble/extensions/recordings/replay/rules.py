"""The rules that make a replay harmless unless its user asks for more. Pure.

In their order: no topics of the broker itself; another base topic; no commands, except mild ones if asked for; nothing
retained. The contract decides by a topic's name; an unknown name counts as the worst of its direction.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import msgspec

from pebble import contract as c
from pebble.contract import Channel as Declared
from pebble.contract import channel_of, codec
from pebble.contract.channels import is_reserved
from pebble.contract.identity import Identity, ParsedTopic, parse_topic
from pebble.contract.payloads import Drive
from pebble.errors import PayloadError, PebbleError, TransportError
from pebble.extensions.recordings.files.recorded import Channel, Recorded
from pebble.extensions.recordings.stamps import shifted
from pebble.transports import Message, QoS
from pebble.transports.topics import check_filter, check_topic, matches

SYSTEM: Final = "replay"  # the first level of replayed topics, unless another one is named

#: Commands whose effect ends by itself, or is visible at once. All others, and all that the contract does not know,
#: are never sent: they switch on cameras, mains and scripts, or move what no zero stops.
_MILD: Final = frozenset({c.DRIVE, c.LIGHTS_SOLID, c.LIGHTS_FLASH, c.AUDIO_STREAM, c.SOUNDBOARD_COMMAND})
_HEARTBEATS: Final = frozenset({c.ONLINE, c.HEARTBEAT})
_PROBE: Final = 24  # bytes of white space at the end of a payload by which bridges look for cycles
_WATCHED: Final = frozenset({"video", "audio"})  # sections of capabilities that a viewer has to request
_ZERO: Final = codec.encode(c.DRIVE, Drive(valid_ms=0))  # final: no script resumes after it


class ReplayError(PebbleError):
    """An error: a replay cannot be done. Example: ``--base pebble is the base of pebble/robots/goob itself: …``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The options of `pebble replay`."""

    system: str = SYSTEM
    incoming: bool = False  # commands that end by themselves
    only: tuple[str, ...] = ()  # filters of recorded topics; none: all


class Outgoing(NamedTuple):
    """A message to publish."""

    message: Message
    moves: bool | None  # of a drive command, whether it moves anything; None: it is none


class _Address(NamedTuple):
    """A recorded channel's robot, and the base, topic, channel and QoS with which its messages are published."""

    recorded: Identity
    base: str  # the new one
    topic: str  # below the new base
    declared: Declared | None  # the contract's channel
    qos: QoS


class Rules:
    """The decisions about a recording's messages."""

    def __init__(self, options: Options, channels: Iterable[Channel]) -> None:
        """Check the options. ``channels``: the recording's. Raises ReplayError, ConfigError or TransportError."""
        self._options = options
        Identity(options.system, "robots", "any")  # raises if topics cannot begin with that system
        for filter_ in options.only:
            check_filter(filter_)
        self._remembered_address = lru_cache(maxsize=65_536)(self._find_address)
        #: The robots that are replayed: recorded base by new base.
        self.robots: dict[str, str] = {}
        for channel in channels:
            self._add(channel)

    def publishes(self, channel: Channel) -> bool:
        return self._listed(channel) is not None

    def outgoing(self, recorded: Recorded, by_ns: int) -> Outgoing | None:
        """Return the message to publish for a recorded one, with its stamps moved by ``by_ns``; None: there is none."""
        address = self._listed(recorded.channel)
        if address is None or _is_probe(recorded.payload):
            return None
        payload, moves = recorded.payload, None  # moves: None if it is no drive command
        if address.declared is c.DRIVE:
            moves = self._moves(payload)
            if moves is None:  # a drive command that must not be sent
                return None
        if address.declared is c.CAPABILITIES and payload:
            payload = harmless(payload, address.recorded.base, address.base)
            if not payload:
                return None
        return Outgoing(Message(address.topic, shifted(payload, by_ns), address.qos), moves)

    def _listed(self, channel: Channel) -> _Address | None:
        """Return how the channel's messages are published; None if they are not, or its robot is not in ``robots``."""
        address = self._address(channel)
        return address if address is not None and address.base in self.robots else None

    def _address(self, channel: Channel) -> _Address | None:
        metadata = channel.metadata
        return self._remembered_address(channel.topic, metadata.get("qos", "0"), metadata.get("retained") == "1")

    def _find_address(self, topic: str, qos: str, retained: bool) -> _Address | None:
        """Return how messages of a topic are published; None if none is to be published.

        ``retained``: the recorder received them as old ones.
        """
        parsed = None if topic.startswith("$") else parse_topic(topic)
        if parsed is None or parsed.identity.is_server or not self._wanted(topic):
            return None
        declared = channel_of(f"{parsed.direction}/{parsed.metric}")
        if not self._allowed(parsed, declared, retained):
            return None
        identity = Identity(self._options.system, parsed.identity.type, parsed.identity.id)
        new = ParsedTopic(identity, parsed.direction, parsed.metric).topic
        try:
            check_topic(new)
        except TransportError:  # no transport of ours can have recorded it
            return None
        quality = QoS.LATEST if qos == "0" else QoS.DELIVERED
        return _Address(parsed.identity, identity.base, new, declared, quality)

    def _wanted(self, topic: str) -> bool:
        only = self._options.only
        return not only or any(matches(filter_, topic) for filter_ in only)

    def _allowed(self, parsed: ParsedTopic, declared: Declared | None, retained: bool) -> bool:
        if parsed.direction != c.INCOMING:
            return declared is not c.BRIDGE_PROBE and not (retained and declared in _HEARTBEATS)
        if retained or is_reserved(parsed.metric):  # stale; or about stops and control
            return False
        return self._options.incoming and declared in _MILD

    def _moves(self, payload: bytes) -> bool | None:
        """Return True if a drive command moves the robot; None if it must not be sent: unreadable, or a script's."""
        try:
            command: Drive = codec.decode(c.DRIVE, payload)
        except PayloadError:
            return None
        # A script's number would bar the runs of the robot's own scripts.
        return None if command.signed else command.moves

    def _add(self, channel: Channel) -> None:
        """Note the robot of a channel. Raises ReplayError if its new base is its old one, or another robot's."""
        address = self._address(channel)
        if address is None:
            return
        base = address.recorded.base
        if self._options.system == address.recorded.system:
            raise ReplayError(f"--base {self._options.system} is the base of {base} itself: choose another one")
        if self.robots.setdefault(address.base, base) != base:
            raise ReplayError(
                f"{self.robots[address.base]} and {base} would both be {address.base}: choose one by --only '{base}/#'"
            )


def harmless(payload: bytes, old_base: str, new_base: str) -> bytes:
    """Return capabilities with their topics below ``new_base``, without offers that a replay cannot serve.

    Pages publish to the topics that they find here: unchanged, they would drive the real robot. Unreadable capabilities
    become b"".
    """
    try:
        plain = codec.plain(c.CAPABILITIES, payload)
    except PayloadError:
        return b""
    if not isinstance(plain, dict) or not isinstance(plain.get("value"), dict):
        return b""
    value = {name: _section(name, section, old_base, new_base) for name, section in plain["value"].items()}
    return msgspec.json.encode({**plain, "value": value})


def _section(name: str, section: Any, old_base: str, new_base: str) -> Any:
    section = _rebased(section, f"{old_base}/", f"{new_base}/")
    return section if name in _WATCHED else _without_controls(section, drives=name == "drive")


def zero(topic: str) -> Message:
    """Return the message that stops a robot after a command on ``topic``."""
    return Message(topic, _ZERO, QoS.DELIVERED)


def _is_probe(payload: bytes) -> bool:
    """True if the payload is a bridge's probe for cycles, or empty but for white space."""
    return bool(payload) and payload[-_PROBE:].isspace()


def _rebased(plain: Any, old: str, new: str) -> Any:
    """Return ``plain`` with all topics below ``old`` moved below ``new``; topics elsewhere are left out."""
    if isinstance(plain, dict):
        return {key: _rebased(value, old, new) for key, value in plain.items() if not _is_elsewhere(key, value, old)}
    if isinstance(plain, list):
        return [_rebased(value, old, new) for value in plain if not _is_elsewhere("", value, old)]
    return new + plain.removeprefix(old) if isinstance(plain, str) and plain.startswith(old) else plain


def _is_elsewhere(key: str, value: Any, below: str) -> bool:
    """True if ``value`` is a topic that does not begin with ``below``: by its form, or as ``key`` ends with topic."""
    if not isinstance(value, str):
        return False
    return not value.startswith(below) and (key.endswith("topic") or parse_topic(value) is not None)


def _without_controls(section: Any, *, drives: bool) -> Any:
    """Return a section of capabilities with ``controls`` false, since a recording obeys no command.

    ``drives``: it is the section ``drive``, whose ``available`` becomes false, too.
    """
    if isinstance(section, list):
        return [_without_controls(value, drives=drives) for value in section]
    if not isinstance(section, dict):
        return section
    plain = {key: _without_controls(value, drives=drives) for key, value in section.items()}
    refused = {"controls", "available"} if drives else {"controls"}
    return {key: False if key in refused else value for key, value in plain.items()}
