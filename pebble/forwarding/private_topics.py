"""Topics that never leave the robot: none, unless an extension publishes private ones."""

from pebble.transports import Message


class PrivateTopics:
    """The private topics of one robot, below its ``base``; used on the transports' threads."""

    def __init__(self, base: str) -> None:
        self.base = base

    def stays(self, topic: str) -> bool:  # noqa: ARG002
        """True if messages on ``topic`` must not be forwarded, in either direction."""
        return False

    def admit(self, message: Message) -> list[Message]:
        """Return the robot's messages that may pass now: none, ``message``, or waiting ones before it as well."""
        return [message]
