"""What a script may publish through the gate, by topic. Pure."""

from __future__ import annotations

from enum import Enum

from pebble.config import Config
from pebble.contract import AUTONOMY_COMMAND, DRIVE, ESTOP_RESET, INCOMING, OUTGOING
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.runtime.addresses import Addresses
from pebble.runtime.process import view_of

#: The last level of incoming topics that a script may not publish on, of whichever robot.
_REFUSED = frozenset({DRIVE.metric, ESTOP_RESET.metric, AUTONOMY_COMMAND.metric})


class Rule(Enum):
    """What happens to a message."""

    FORWARD = "is forwarded"
    DRIVE = "is signed"
    REFUSE = "is refused"


class TopicRules:
    """Sorts the topics of one robot's scripts.

    A script drives its own robot, signed, and no other. It may stop robots, but neither release an emergency stop, nor
    publish a motor owner's state, nor start scripts: that would be a new run, after a person has stopped this one.
    """

    def __init__(self, drive_topics: frozenset[str], refused: frozenset[str] = frozenset()) -> None:
        self.drive_topics = drive_topics
        self._refused = refused

    @classmethod
    def of(cls, config: Config) -> TopicRules:
        """The rules for a robot's config, with its renamed topics."""
        lines = [name for name, line in config.serial_instances().items() if SERIAL_PROTOCOLS[line.protocol].drives]
        drive = {Addresses(view_of(config, name))[DRIVE].topic for name in ("", *lines)}
        drive.add(DRIVE.topic(config.base))
        return cls(frozenset(drive), frozenset({Addresses(config)[AUTONOMY_COMMAND].topic}))

    def rule(self, topic: str) -> Rule:
        """What happens to a message on ``topic``."""
        if topic in self.drive_topics:
            return Rule.DRIVE
        levels = topic.split("/")  # a base has three
        direction, metric = "".join(levels[3:4]), levels[4:]
        if direction == INCOMING and metric and metric[-1] in _REFUSED:
            return Rule.REFUSE
        if topic in self._refused or (direction == OUTGOING and metric[:1] == ["estop"]):
            return Rule.REFUSE
        return Rule.FORWARD
