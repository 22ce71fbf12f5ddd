"""Extensions' parts of the way between operators and a robot: steps that refuse messages, observers, private topics.

All are called on the threads that receive messages, and must not wait. No step is asked about an emergency stop.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Concatenate, Final, ParamSpec, TypeAlias

from pebble.config import Config
from pebble.contract import Channel
from pebble.contract.payloads import ControlState, EstopCommand, EstopState
from pebble.extension import part
from pebble.forwarding.routing import Drop, Side
from pebble.forwarding.subjects import Subject
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports import Message

_log = RateLimitedLog(logging.getLogger(__name__), period_s=60.0)
_V = ParamSpec("_V")

ROBOT: Final = "(robot)"  # a program of the robot: no account has such a name

#: Returns why a message that was received there does not pass; empty: it may.
Step: TypeAlias = Callable[[Side, Subject, Message], str]


class Observer:
    """An observer of messages to the robot, passed and refused. Its class is called with config and clock at the start.

    ``by`` is the sender that the broker has checked, ROBOT, or None where no names are checked.
    """

    def start(self) -> None:
        """Begin to observe. Runs on the service's thread, like all methods but :meth:`passed` and :meth:`refused`."""

    def close(self) -> None:
        """Stop observing, and save what was observed."""

    def passed(self, channel: Channel, by: str | None, payload: bytes) -> None:
        """Note a command, or a changed flag, that was forwarded."""

    def refused(self, drop: Drop, channel: Channel | None, by: str | None) -> None:
        """Note a message from outside that was refused; ``drop`` is the reason."""

    def control(self, state: ControlState) -> None:
        """Note the state of control, as the deciding motor owner has published it."""

    def estop(self, owner: str, state: EstopState) -> None:
        """Note the state of the emergency stop, as a motor owner has published it."""

    def unconfirmed(self, owner: str, stop: EstopCommand) -> None:
        """Note a stop that is no longer repeated although a motor owner has not confirmed it."""


class PrivateTopics:
    """The topics of one robot, below its ``base``, that never leave it: none, unless an extension publishes such."""

    def __init__(self, base: str) -> None:
        self.base = base

    def stays(self, topic: str) -> bool:  # noqa: ARG002
        """True if messages on ``topic`` must not be forwarded, in either direction."""
        return False

    def admit(self, message: Message) -> list[Message]:
        """Return the robot's messages that may pass now: none, ``message``, or waiting ones before it as well."""
        return [message]


class Observers:
    """The observers of all extensions. An exception in one is logged, and the others are still called."""

    def __init__(self, config: Config, clock: Callable[[], float]) -> None:
        self._observers: list[Observer] = []
        for extension in config.installed:
            if extension.observer:
                with logged(extension.name):
                    self._observers.append(part(extension.observer)(config, clock))

    def tell(self, method: Callable[Concatenate[Any, _V], None], *values: _V.args, **named: _V.kwargs) -> None:
        """Call a method of each observer: ``tell(Observer.control, state)``."""
        for observer in self._observers:
            with logged(type(observer).__name__):
                getattr(observer, method.__name__)(*values, **named)


def steps_of(config: Config) -> dict[str, Step]:
    """Return the steps that extensions add, by extension. A step that cannot be made is logged and left out."""
    steps: dict[str, Step] = {}
    for extension in config.installed:
        if extension.step:
            with logged(extension.name):
                steps[extension.name] = part(extension.step)(config)
    return steps


@contextmanager
def logged(name: str) -> Iterator[None]:
    """Log an exception in the block, as one of the extension called ``name``, and continue."""
    try:
        yield
    except Exception as error:  # noqa: BLE001 - whatever a stranger's code raises: it must not end the bridge
        _log.warning(name, "the extension %s failed at the bridge: %s: %s", name, type(error).__name__, error)
