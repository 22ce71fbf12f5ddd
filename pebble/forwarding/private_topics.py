"""Topics that stay on the robot: none, unless an extension that publishes them knows more."""

from pebble.transports import Message


class PrivateTopics:
    """The private topics of one robot, below its ``base``; used on the transports' threads."""

    def __init__(self, base: str) -> None:
        self.base = base

    def stays(self, topic: str) -> bool:  # noqa: ARG002
        """True if messages on ``topic`` may not pass, in either direction."""
        return False

    def admit(self, message: Message) -> list[Message]:
        """Return the messages of the robot that may pass now: ``message``, none, or earlier ones as well."""
        return [message]
