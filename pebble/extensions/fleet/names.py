"""Accounts of senders at the level ``named``: read from topics, written into payloads. Pure.

The broker checks the account in ``incoming/by/{account}/{metric}``. On the robot itself the topic has no account, and
the payload has the sender: ``"by": "otto"``, or ``"page-1/ann"`` where a page server adds the person. A message without
``by`` is from a program of the robot.
"""

from functools import lru_cache
from typing import Any

import msgspec

from pebble.config.security import Strangers
from pebble.contract import DRIVE, GROUP, INCOMING, Channel, codec, groups
from pebble.contract.names import BY, NO_ACCOUNT, stop_topic, unchecked, without_name
from pebble.contract.payloads import AutonomyCommand, Drive, EstopCommand, MediaRequest, SoundboardCommand
from pebble.errors import PayloadError
from pebble.extensions.fleet.roles import WRITES, Right
from pebble.forwarding.names import Names, Sender, Signed
from pebble.forwarding.routing import Drop
from pebble.forwarding.subjects import Subjects
from pebble.motion.lease import shown
from pebble.transports import Message

_REMEMBERED = 4096  # topics
_USUAL_BYTES = 256  # of a drive command
_LONGEST = 40  # characters of a sender
_UNSIGNED = (bool, bytes)  # payloads that take no name: a flag has the same bytes from every sender
#: Payloads that need not be objects; of all others only objects are commands.
_MAY_BE_BARE = (*_UNSIGNED, AutonomyCommand, EstopCommand, MediaRequest, SoundboardCommand)

_decoder, _encoder = msgspec.json.Decoder(), msgspec.json.Encoder()


class CheckedNames(Names):
    """A table of the senders of messages, by topic. ``strangers``: the rights of senders without an account."""

    def __init__(self, base: str, subjects: Subjects, strangers: Strangers) -> None:
        super().__init__()
        self._below = f"{base}/{INCOMING}/{BY}/"
        self._subjects = subjects
        rights = () if strangers == "refuse" else (Right.LOOK, Right.DRIVE)
        self._strangers = frozenset(  # channels that senders without an account may write
            channel.suffix for right in rights for channel in WRITES[right] if isinstance(channel, Channel)
        )

    def __missing__(self, topic: str) -> Sender:
        if len(self) >= _REMEMBERED:
            self.clear()
        sender = self[topic] = self._find(topic)
        return sender

    def _find(self, topic: str) -> Sender:
        if not topic.startswith(self._below):
            return Sender(NO_ACCOUNT, topic, self._subjects[topic])
        named = without_name(topic)
        if named is not None:
            return Sender(named.account, named.topic, self._subjects[named.topic])
        plain = stop_topic(topic)  # a stop counts, whatever name is in its topic
        if plain is not None:
            return Sender(NO_ACCOUNT, plain, self._subjects[plain])
        return Sender(NO_ACCOUNT, topic, None, Drop.MISNAMED)

    def sign(self, sender: Sender, message: Message) -> Signed | Drop:
        """Return ``message`` with its sender in the payload, or why it is refused. Called for each message.

        A ``by`` in the payload is only a claim. If the sender has an account, the claim is added to it, as the person's
        name; if not, it is removed. A stop needs no account; its claim stays, with a mark.
        """
        subject, account, payload = sender.subject, sender.account, message.payload
        channel = None if subject is None else subject.channel
        payload_type = None if channel is None else channel.payload
        if account == NO_ACCOUNT:
            if payload_type is EstopCommand:
                return Signed(_moved(message, sender.topic, _doubted(payload)), NO_ACCOUNT)
            if channel is None or not (channel.suffix in self._strangers or _is_zero(channel, payload)):
                return Drop.UNNAMED  # a drive command that only stops passes without a right
        elif (message.retain or message.retain_requested) and payload_type is not EstopCommand:
            return Drop.STALE  # also a flag: with a name it is a command; its value is retained on the plain topic
        if channel is GROUP and not _is_group(payload):  # several commands in one payload
            return Drop.UNREADABLE
        fields, by = _object(payload), account  # by: the checked sender, in place of a claim
        if fields is not None:
            body = _body(fields)  # the same object, or its ``value``
            claim = body.get("by")
            if account != NO_ACCOUNT and isinstance(claim, str) and claim:  # a page server names its person
                by = _with_person(account, claim[:_LONGEST])
            if payload_type not in _UNSIGNED:
                fields.pop("by", None)  # also a claim outside of ``body``
                body["by"] = by
                payload = _encoder.encode(fields)
        elif channel is not None and payload_type not in _MAY_BE_BARE:
            return Drop.UNREADABLE  # of such a type only an object is a command
        return Signed(_moved(message, sender.topic, payload), by)


def _moved(message: Message, topic: str, payload: bytes) -> Message:
    return Message(topic, payload, message.qos, message.retain, message.retain_requested, message.waiting_since)


def _doubted(payload: bytes) -> bytes:
    """Mark the claimed sender of a stop as unchecked; return the payload unchanged if none can be read in it."""
    fields = _object(payload)
    body = {} if fields is None else _body(fields)
    claim = body.get("by")
    if not isinstance(claim, str) or not claim:
        return payload
    body["by"] = unchecked(claim)  # in ``fields``, of which ``body`` is a part
    return _encoder.encode(fields)


def _body(command: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON object that holds the message's fields: the command itself, or its ``value``."""
    value = command.get("value")
    return value if isinstance(value, dict) else command


def _is_zero(channel: Channel, payload: bytes) -> bool:
    try:
        return channel.payload is Drive and not codec.decode(channel, payload).moves
    except PayloadError:
        return False


def _is_group(payload: bytes) -> bool:
    """True if the payload is a valid group. `_object` would keep the last of equal keys: call this before it."""
    try:
        return bool(groups.decode(payload))
    except PayloadError:
        return False


def _object(payload: bytes) -> dict[str, Any] | None:
    """Return the JSON object in ``payload`` as every reader of the contract parses it; None if there is none."""
    try:
        usual = payload[:1] == b"{" and payload[-1:] == b"}" and len(payload) <= _USUAL_BYTES
        if usual and payload.isascii() and b"\0" not in payload:  # the fast way to the same result; a NUL ends the JSON
            fields = _decoder.decode(payload)
        else:
            fields = codec.plain(DRIVE, payload)  # reads the JSON of any channel
    except (PayloadError, msgspec.DecodeError):
        return None
    return fields if isinstance(fields, dict) else None


@lru_cache(maxsize=256)
def _with_person(account: str, person: str) -> str:
    return shown(f"{account}/{person}", _LONGEST)
