"""Forwards groups of commands into a robot: each member is checked; then the whole and copies of the members pass."""

import logging
from collections.abc import Callable, Iterable
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from pebble.config import Config
from pebble.contract import (
    DRIVE,
    GROUP,
    INCOMING,
    LIGHTS_FLASH,
    LIGHTS_SOLID,
    MCU_COMMAND,
    OUTLET_COMMAND,
    SOUNDBOARD_COMMAND,
    codec,
    groups,
)
from pebble.contract.capabilities import CapabilitiesValue
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.errors import PayloadError
from pebble.forwarding.command_ages import ends_something
from pebble.forwarding.forwarder import Forwarder, Pass
from pebble.forwarding.routing import Drop, Forward, Side
from pebble.forwarding.side import SideState
from pebble.forwarding.subjects import Subject
from pebble.runtime.addresses import Addresses
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports import Message

#: Channels that motor owners and described boards take from the group; their copies are marked.
MARKED = (DRIVE, LIGHTS_SOLID, LIGHTS_FLASH, MCU_COMMAND)
_log = RateLimitedLog(logging.getLogger(__name__), period_s=60.0)


def encoded(members: Iterable[groups.Member]) -> bytes:
    """Return a group of members as JSON that every reader understands in the same way."""
    return msgspec.json.encode({member.metric: msgspec.Raw(member.payload) for member in members})


def copy_of(member: groups.Member) -> bytes:
    """Return the payload for programs that know no groups; on a channel in MARKED it is marked as a copy."""
    if member.channel not in MARKED:
        return member.payload
    return msgspec.json.encode(msgspec.json.decode(member.payload) | {groups.MARK: True})


def is_marked(raw: bytes) -> bool:
    """True if a command is marked as a copy, which only the bridge may send."""
    if groups.MARK.encode() not in raw and b"\\" not in raw:  # the mark may be written with escapes
        return False
    try:
        command = codec.plain(DRIVE, raw)
    except PayloadError:
        return False
    if not isinstance(command, dict):
        return False
    bodies = (command, command.get("value"))  # a command may be wrapped in `value`
    return any(isinstance(body, dict) and body.get(groups.MARK) is True for body in bodies)


class _Part(NamedTuple):
    """A member of a group as a message of its own; ``way``: how it is forwarded, or why it is not."""

    member: groups.Member
    subject: Subject
    message: Message
    way: Forward | Drop


class GroupGate:
    """A gate before a forwarder, for messages from outside. Messages that are no groups go on to :attr:`pass_on`.

    A group passes if each member would: it is published whole, and then a copy of each member by itself, for programs
    that know no groups. Motor owners and described boards obey the whole. The copies of their members are marked, and
    of marked copies they obey only zeros. A group of which a member may not pass is dropped, except for members that
    only end something. Marked copies from outside are refused: observers would see motion that is not there.
    """

    def __init__(self, forwarder: Forwarder, addresses: Addresses, note_drive: Callable[[bytes], None]) -> None:
        self.pass_on: Pass = forwarder.pass_now
        self._forwarder, self._addresses, self._note_drive = forwarder, addresses, note_drive
        self._subjects = forwarder.subjects

    def receive(
        self, source: SideState, subject: Subject, message: Message, forward: Forward, account: str
    ) -> Forward | Drop:
        """Take the place of :meth:`Forwarder.pass_now`; ``account``: the sender's, where names are checked."""
        if source.side is Side.REMOTE:
            if subject.channel is GROUP:
                return self._receive_group(source, subject, message, forward, account)
            marked = subject.channel in MARKED and is_marked(message.payload)
            if marked and not ends_something(subject, message):
                return Drop.REFUSED
        return self.pass_on(source, subject, message, forward, account)

    def _receive_group(
        self, source: SideState, subject: Subject, message: Message, forward: Forward, account: str
    ) -> Forward | Drop:
        """Deliver a group and copies of its members; or, if a member may not pass, only members that end something."""
        try:
            members = groups.decode(message.payload)
        except PayloadError as error:
            _log.warning("group", "a group is not forwarded: %s", error)
            return Drop.REFUSED
        parts = [self._part(source, message, member, account) for member in members]
        drops = [part.way for part in parts if isinstance(part.way, Drop)]
        outcome: Forward | Drop = drops[0] if drops else forward  # one refused member refuses the group
        if isinstance(outcome, Forward):
            # the checks may have changed the payloads
            parts = [part._replace(member=replace(part.member, payload=part.message.payload)) for part in parts]
            whole = replace(message, payload=encoded(part.member for part in parts))
            outcome = self._forwarder.deliver(source, subject, whole, forward)
            # no copies of a group that could not be delivered after all
            deliveries = [(part, copy_of(part.member)) for part in parts] if isinstance(outcome, Forward) else []
        else:
            deliveries = [(part, part.message.payload) for part in parts if part.member.channel.ends(part.member.value)]
        for part, payload in deliveries:
            if isinstance(part.way, Drop):  # what ends something may be refused, too
                continue
            self._forwarder.deliver(source, part.subject, replace(part.message, payload=payload), part.way)
            if part.member.channel is DRIVE:
                self._note_drive(payload)
        return outcome

    def _part(self, source: SideState, message: Message, member: groups.Member, account: str) -> _Part:
        """Check a member of the group ``message`` as the forwarder checks a message of its own."""
        if member.channel.is_pattern:
            topic = f"{self._addresses.base}/{INCOMING}/{member.metric}"
        else:
            topic = self._addresses[member.channel].topic
        subject = self._subjects[topic]
        assert subject is not None  # noqa: S101 - its metric is that of a channel
        message = replace(message, topic=topic, payload=member.payload)
        way = self._forwarder.admit(source, subject, message, topic, named=True)  # True: counted with those of accounts
        if self._forwarder.stays(topic):
            way = Drop.STAYS
        if isinstance(way, Forward):
            examined = self._forwarder.examine(source, subject, message, way, account)
            if isinstance(examined, Drop):
                way = examined
            else:
                message = examined
        return _Part(member, subject, message, way)


def install_gate(
    config: Config, addresses: Addresses, forwarder: Forwarder, note_drive: Callable[[bytes], None]
) -> GroupGate | None:
    """Put a gate before the forwarder of a robot that takes groups, and return it; None for other robots."""
    if not config.services.mqtt_bridge.link.groups:
        return None
    gate = GroupGate(forwarder, addresses, note_drive)
    forwarder.pass_on = gate.receive
    return gate


def offers(config: Config, value: CapabilitiesValue) -> CapabilitiesValue:
    """Return the capabilities with the metrics that this robot accepts in a group."""
    link = config.services.mqtt_bridge.link
    if not link.groups:
        return value
    lines = config.serial_instances().values()
    is_offered = {
        DRIVE: value.drive and value.drive.available,
        LIGHTS_SOLID: value.lights and value.lights.solid,
        LIGHTS_FLASH: value.lights and value.lights.flash,
        SOUNDBOARD_COMMAND: value.soundboard and value.soundboard.available,
        OUTLET_COMMAND: value.outlets and value.outlets.available,
        MCU_COMMAND: any(SERIAL_PROTOCOLS[line.protocol].describes_itself for line in lines),
    }
    return replace(value, groups=[channel.metric for channel, offered in is_offered.items() if offered])
