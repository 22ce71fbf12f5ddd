"""Routing of messages between a robot's own transport and another one: a pure function of a table.

While *mirroring* is on (the flag remote-mirror), the bridge also sends operators the commands and feeds that
programs on the robot publish.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final

from msgspec import Struct

from pebble.contract import INCOMING, Kind
from pebble.forwarding.subjects import Subject
from pebble.transports import Message, QoS

URGENT: Final = frozenset({Kind.COMMAND, Kind.ACTION, Kind.FLAG})


class Side(Enum):
    """A side of a forwarder, with a transport of its own."""

    LOCAL = "local"  # the robot's own transport
    REMOTE = "remote"  # the other one: for the bridge the operators', for the mirror the broker on the robot

    other: Side
    __hash__ = object.__hash__  # of C's, not of Python's: a side is looked up ten times for each message


Side.LOCAL.other, Side.REMOTE.other = Side.REMOTE, Side.LOCAL


class Drop(Enum):
    """Reason why a message does not pass."""

    FOREIGN = "no topic of this robot"
    MEDIA = "media has connections of its own"
    STAYS = "stays on the robot"
    STALE = "a retained message of something that happens once"
    ONE_WAY = "goes the other way only"
    NOT_MIRRORED = "passes only while remote-mirror is on"
    # found by the forwarder
    TOO_LARGE = "larger than a message to a robot may be"
    TOO_MANY = "one more unknown flag than a robot stores"
    TOO_OFTEN = "more often in a second than a robot takes it"
    ECHO = "our own, sent back by the broker"
    PROBE = "a probe for cycles"
    CIRCULATES = "comes back by another way"
    KNOWN = "the other side has this value"
    OVERRULED = "the other side's value counts"
    NO_ROOM = "waits for room on a thin link"
    HELD = "waits for the other side's values"
    CLOSED = "nothing is forwarded now"
    LATE = "waited too long, here or at the broker"
    RESET = "a copy of a stop that was reset since"
    REFUSED = "an extension refuses it"
    SIGNED = "only programs on the robot may sign as a script"
    # found in its topic, where names are checked (see .names)
    UNNAMED = "has no name of a sender"
    MISNAMED = "has a name that no account can have, or more than one"
    UNREADABLE = "no JSON object, so it takes no name"


class Forward(Struct, frozen=True):
    """Options with which a message is published on the other side; topic and bytes stay the same."""

    qos: QoS
    retain: bool
    urgent: bool
    unsigned: bool = False  # a script's signature does not pass (see forwarder.unsigned)
    stamped: bool = False  # it may tell its own age (see .command_ages)


class Rules(Struct, frozen=True, kw_only=True):
    """A routing table: the kinds of messages forwarded from each side, and the kinds that pass only while mirroring."""

    passes: Mapping[Side, frozenset[Kind]]
    mirrored: Mapping[Side, frozenset[Kind]] = {}
    leaves_robot: bool  # the other side is not on the robot
    media: bool = False  # pictures and sound pass, too, which have no connection of their own here
    stored: bool = True  # what is retained is sent again after an outage, because no other program forwards it

    def both_ways(self, kind: Kind) -> bool:
        """True if either side may be the origin of messages of this kind."""
        return all(kind in self.passes[side] for side in Side)


#: Between the robot and its operators: the paper's Table A.1. :func:`route` drops messages that no table may allow.
TABLE_A1: Final = Rules(
    passes={
        Side.LOCAL: frozenset({Kind.STATE, Kind.EVENT, Kind.STREAM, Kind.FLAG, Kind.ACTION}),
        Side.REMOTE: frozenset({Kind.COMMAND, Kind.FLAG, Kind.ACTION, Kind.FEED}),
    },
    mirrored={Side.LOCAL: frozenset({Kind.COMMAND, Kind.FEED})},
    leaves_robot=True,
)
#: Between a robot's own transport and a broker on the robot: everything, both ways, except media.
MIRROR: Final = Rules(passes={side: frozenset(Kind) for side in Side}, leaves_robot=False)


def route(rules: Rules, side: Side, subject: Subject | None, message: Message, *, mirroring: bool) -> Forward | Drop:
    """Return how to forward ``message``, received on ``side``, or why it does not pass. Pure."""
    if subject is None:
        return Drop.FOREIGN
    if not subject.bridged and not rules.media:
        return Drop.MEDIA
    if subject.stays and rules.leaves_robot:
        return Drop.STAYS
    if subject.kind.one_shot and (message.retain or message.retain_requested):
        return Drop.STALE  # also a live one that was published to be retained: some brokers hide which it is
    if subject.kind not in rules.passes[side]:
        if subject.kind not in rules.mirrored.get(side, ()):
            return Drop.ONE_WAY
        if not mirroring:
            return Drop.NOT_MIRRORED
    from_outside = side is Side.REMOTE and rules.leaves_robot
    return Forward(
        _qos(subject, message),
        _retain(subject, message),
        urgent=subject.kind in URGENT,
        unsigned=from_outside and subject.drives,  # only programs on the robot may sign as a script
        stamped=from_outside and subject.stamped,  # its own time stamp, if any, tells its age
    )


def _qos(subject: Subject, message: Message) -> QoS:
    """Return the received QoS; to the robot at least the channel's, because one QoS per topic keeps the order."""
    if subject.kind.direction == INCOMING:
        return message.qos if message.qos >= subject.qos else QoS(subject.qos)
    return message.qos


def _retain(subject: Subject, message: Message) -> bool:
    """True if a message is to be retained: as it was published or, where a broker hides that, as its channel says."""
    if subject.kind.one_shot:
        return False
    if subject.kind is Kind.FLAG and subject.retain:  # however it was published
        return True
    if message.retain or message.retain_requested:
        return True
    return message.retain_requested is None and subject.retain
