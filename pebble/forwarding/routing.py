"""Which messages pass between a robot's own fabric and another side, and how: a pure function of a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from pebble.contract import INCOMING, Kind
from pebble.forwarding.subjects import Subject
from pebble.transports import Message, QoS

ONE_SHOT: Final = frozenset({Kind.COMMAND, Kind.ACTION, Kind.FEED})
URGENT: Final = frozenset({Kind.COMMAND, Kind.ACTION, Kind.FLAG})


class Side(Enum):
    LOCAL = "local"  # the robot's own transport
    REMOTE = "remote"  # the other one

    @property
    def other(self) -> Side:
        return Side.REMOTE if self is Side.LOCAL else Side.LOCAL


class Drop(Enum):
    """Why a message does not pass."""

    FOREIGN = "no topic of this robot"
    MEDIA = "media has connections of its own"
    STAYS = "stays on the robot"
    STALE = "a kept copy of something that happens once"
    ONE_WAY = "goes the other way only"
    NOT_MIRRORED = "passes only while remote-mirror is on"
    # what the forwarder finds out
    ECHO = "our own, come back"
    KNOWN = "the other side knows it already"
    OVERRULED = "the other side's copy counts"
    HELD = "waits for the other side's copy"
    CLOSED = "nothing is forwarded now"


@dataclass(frozen=True, slots=True)
class Forward:
    """How a message is published on the other side: same topic, same bytes."""

    qos: QoS
    retain: bool
    urgent: bool


@dataclass(frozen=True, kw_only=True)
class Rules:
    """A routing table: the kinds that leave each side, and those that follow only while mirroring is on."""

    passes: Mapping[Side, frozenset[Kind]]
    mirrored: Mapping[Side, frozenset[Kind]] = field(default_factory=dict)
    leaves_robot: bool  # the other side is not on the robot

    def both_ways(self, kind: Kind) -> bool:
        """May both sides be the origin of such messages?"""
        return all(kind in self.passes[side] for side in Side)


def route(rules: Rules, side: Side, subject: Subject | None, message: Message, *, mirroring: bool) -> Forward | Drop:
    """What becomes of ``message``, received on ``side``. Pure."""
    if subject is None:
        return Drop.FOREIGN
    if not subject.bridged:
        return Drop.MEDIA
    if subject.stays and rules.leaves_robot:
        return Drop.STAYS
    if is_stale(subject.kind, message):
        return Drop.STALE
    if subject.kind not in rules.passes[side]:
        if subject.kind not in rules.mirrored.get(side, ()):
            return Drop.ONE_WAY
        if not mirroring:
            return Drop.NOT_MIRRORED
    return Forward(_qos(subject, message), _retain(subject, message), subject.kind in URGENT)


def is_stale(kind: Kind, message: Message) -> bool:
    """Something that happens once, marked as kept: a kept copy, or (they look alike in places) meant to become one."""
    return kind in ONE_SHOT and (message.retain or bool(message.keep))


def _qos(subject: Subject, message: Message) -> QoS:
    """As received; what is sent *to* a robot gets its channel's quality at least: one QoS per topic keeps the order."""
    if subject.kind.direction == INCOMING:
        return QoS(max(message.qos, subject.qos))
    return message.qos


def _retain(subject: Subject, message: Message) -> bool:
    """As published, where one can know; a flag is kept on both sides whoever set it."""
    if subject.kind in ONE_SHOT:
        return False
    if subject.kind is Kind.FLAG and subject.retain:
        return True
    if message.retain or message.keep is not None:
        return message.retain or bool(message.keep)
    return subject.retain
