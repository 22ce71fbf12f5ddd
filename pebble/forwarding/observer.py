"""What extensions add to the way between operators and a robot: steps that may refuse, observers of what became of it.

Both are called on the threads that receive: they must not wait. No step is asked about an emergency stop.
"""

from collections.abc import Callable
from typing import Final, TypeAlias

from pebble.contract import Channel
from pebble.contract.payloads import ControlState, EstopCommand
from pebble.forwarding.routing import Drop, Side
from pebble.forwarding.subjects import Subject
from pebble.transports import Message

ROBOT: Final = "(robot)"  # a program of the robot: no account has such a name

#: Returns why a message that was received there does not pass; empty: it may.
Step: TypeAlias = Callable[[Side, Subject, Message], str]


class Observer:
    """Sees what passes to the robot, and what does not. It is made with the config and a clock, before anything passes.

    ``by`` is the sender that the broker has checked, ROBOT, or None where no names are checked.
    """

    def start(self) -> None:
        """Begin; on the service's thread, as :meth:`close`, :meth:`control` and :meth:`unconfirmed`."""

    def close(self) -> None:
        """End; what was seen until now is kept."""

    def passed(self, channel: Channel, by: str | None, payload: bytes) -> None:
        """Note a command or a changed flag."""

    def refused(self, drop: Drop, channel: Channel | None, by: str | None) -> None:
        """Note that a message from outside did not pass."""

    def control(self, state: ControlState) -> None:
        """Note what the motor owner that decides says of who has control."""

    def unconfirmed(self, owner: str, stop: EstopCommand) -> None:
        """Note a stop that a motor owner has not confirmed, and that is given up."""
