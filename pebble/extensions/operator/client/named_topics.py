"""Accounts in the topics of commands, for robots that accept only such commands. Pure.

The capabilities of such a robot have ``named``. With :meth:`NamedTopics.forms` as its ``policy.forms``, a transport
publishes each command on the topic that its robot reads at present.
"""

from collections.abc import Callable, Iterator

import msgspec

from pebble.contract import DRIVE, ESTOP, INCOMING, codec
from pebble.contract.identity import ParsedTopic, parse_topic
from pebble.contract.names import BY, NAME, with_name
from pebble.errors import PayloadError, TransportError
from pebble.extensions.operator.client.assumed import json_object
from pebble.transports import Message


def why_not(name: str, account: str) -> str:
    """Return why a robot does not take commands of this account, and what to do; empty if it does."""
    if NAME.fullmatch(account):
        return ""
    lacks = f"{account!r} is none that it knows" if account else "there is none here"
    return f"{name} takes commands only with a name, and {lacks}: log in at its broker, as in --url mqtts://ANN@BROKER"


class NamedTopics:
    """A client's topics. ``account``: its user name at the broker; ``is_named(base)``: that robot needs an account."""

    def __init__(self, account: str, is_named: Callable[[str], bool]) -> None:
        self.account = account
        self._is_named = is_named

    def forms(self, message: Message) -> Iterator[Message]:
        """Yield the messages to publish instead of this one. Raises TransportError.

        A stop needs no account: it is also published unchanged, and first. Without an account, a zero is published
        unchanged. No message on a topic with an account is retained: the robot itself retains its flags.
        """
        command = _command(message.topic)
        is_stop = command is not None and command.metric == ESTOP.metric
        if is_stop:
            yield message
        if command is None or not self._is_named(command.identity.base):
            if not is_stop:  # else it was yielded above
                yield message
        elif NAME.fullmatch(self.account):
            payload = _without_claim(message.payload, self.account)
            yield Message(with_name(message.topic, self.account), payload, message.qos)
        elif command.metric == DRIVE.metric and not moves(message.payload):
            yield message
        elif not is_stop:
            raise TransportError(why_not(command.identity.id, self.account))

    def signed(self, topic: str, payload: bytes, person: str) -> bytes:
        """Return a command's payload with the person for whom this client acts, if the robot needs accounts in topics.

        A payload that names a sender itself is unchanged.
        """
        command = _command(topic) if person else None
        if command is None or not self._is_named(command.identity.base):
            return payload
        plain = json_object(payload)
        if plain is None:
            return payload
        body = plain["value"] if isinstance(plain.get("value"), dict) else plain  # that has the command's fields
        if "by" in body:
            return payload
        body["by"] = person
        return msgspec.json.encode(plain)


def _command(topic: str) -> ParsedTopic | None:
    """Return the parts of a command's topic, if it has no account yet."""
    parsed = parse_topic(topic)
    if parsed is None or parsed.direction != INCOMING or parsed.metric.startswith(f"{BY}/"):
        return None
    return parsed


def moves(payload: bytes) -> bool:
    """True if a drive command moves a robot, or cannot be read here."""
    try:
        return bool(codec.decode(DRIVE, payload).moves)
    except PayloadError:  # the robot refuses it, or has other rules
        return True


def _without_claim(payload: bytes, account: str) -> bytes:
    """Return the payload without its sender if that is the account, which the topic names already."""
    if f'"{account}'.encode() not in payload:  # the fast way; no quote at its end, as "@desk" may follow
        return payload
    command = json_object(payload)
    if command is None or str(command.get("by")).partition("@")[0] != account:
        return payload
    return msgspec.json.encode({key: value for key, value in command.items() if key != "by"})
