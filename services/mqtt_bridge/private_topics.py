"""Keeps ``local_only`` interfaces of self-describing MCUs on the robot, as their manifests say.

The order of two topics is undefined: on Zenoh, and behind a full queue of a broker, a sample may arrive before the
manifest that makes it private, and at a bridge that starts late it nearly always does. So a value passes only after a
manifest that allows it. Each interface is read by itself, whatever the rest of its manifest looks like; of an MCU whose
interfaces cannot be read nothing passes.
"""

import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from pebble.contract import INCOMING, MCU_COMMAND, MCU_DESCRIBE, MCU_VALUE, OUTGOING, codec, is_reserved
from pebble.contract.identity import LEVEL
from pebble.errors import PayloadError
from pebble.transports import Message

_DEVICES = 256  # remembered; a robot has a handful
_TOPICS = 1024  # remembered of one MCU
_WAITING = 256  # retained values that wait for a manifest
_QUESTION = "/" + MCU_DESCRIBE.metric.rpartition("/")[2]
_MARK = b'"device_uid"'  # in every value under an alias: the MCU it belongs to
_DIRECTIONS = {"in": (INCOMING,), "out": (OUTGOING,)}
_BOTH = (INCOMING, OUTGOING)

_level = re.compile(LEVEL).search


@dataclass(frozen=True, slots=True)
class _Interface:
    """What can be read of one. Only a missing or false ``local_only`` makes it public."""

    name: str | None
    channel: str | None
    directions: tuple[str, ...]  # both, if that cannot be read
    public: bool

    @property
    def whole(self) -> bool:
        """Whether all of its topics are known."""
        return self.name is not None and self.channel is not None


@dataclass(frozen=True, slots=True)
class _Device:
    """One MCU by its newest manifest; ``topics`` also by earlier ones."""

    public: frozenset[str] = frozenset()  # outgoing interfaces that may pass; one that is gone has none
    private: frozenset[str] = frozenset()  # topics that may not; remembered
    topics: frozenset[str] = frozenset()  # that are or were this MCU's
    allowed: frozenset[str] | None = None  # if not all could be read: the only topics of it that may pass


class PrivateTopics:
    """The ``local_only`` interfaces of every MCU. Called on the transports' threads."""

    def __init__(self, base: str) -> None:
        self._base = base
        self._lock = threading.Lock()
        self._devices: dict[str, _Device] = {}  # by uid
        self._waiting: dict[str, Message] = {}  # by topic
        self._values = f"{base}/{OUTGOING}/{MCU_VALUE.metric.partition('{')[0]}"
        self._commands = f"{base}/{INCOMING}/{MCU_COMMAND.metric.partition('{')[0]}"

    def is_known(self, topic: str) -> bool:
        """Whether a manifest makes this topic private. Requests for one always are: they concern serial lines only."""
        if topic.startswith(self._commands) and topic.endswith(_QUESTION):
            return True
        if not self._devices:
            return False
        if any(topic in device.private for device in list(self._devices.values())):
            return True
        device = self._device_of(topic)
        return device is not None and device.allowed is not None and topic not in device.allowed

    def admit(self, message: Message) -> list[Message]:
        """What may pass now: ``message`` or nothing; with a manifest, then the retained values that waited for it."""
        if not message.payload:
            with self._lock:
                self._waiting.pop(message.topic, None)  # removed: nothing to forward any more
        if not message.topic.startswith(self._values) and _MARK not in message.payload:
            return [] if self.is_known(message.topic) else [message]
        with self._lock:
            uid = MCU_DESCRIBE.names(message.topic).get("uid")
            if uid is not None and message.topic == MCU_DESCRIBE.topic(self._base, uid=uid):
                return [message, *self._released()] if self._learn(uid, message) else []
            return [message] if self._may_pass(message) else self._hold(message)

    def _learn(self, uid: str, message: Message) -> bool:
        """False if no interface can be read. After the removal of a manifest, what is private stays private."""
        known = self._devices.get(uid)
        if not message.payload:
            if known is not None:
                self._devices[uid] = replace(known, public=frozenset())
            return True
        entries = _entries(message.payload)
        interfaces = [_interface(entry) for entry in entries or ()]
        by_public = {
            public: frozenset(topic for one in interfaces if one.public is public for topic in self._topics(uid, one))
            for public in (True, False)
        }
        topics = by_public[True] | by_public[False]
        if known is not None and len(known.topics) < _TOPICS:
            topics |= known.topics
        private, allowed = by_public[False], None
        if entries is None or not all(one.whole for one in interfaces):  # an unread one may be any of the others
            allowed = by_public[True] - private
            private |= topics - allowed
        self._remember(uid, _Device(_public_names(interfaces), private, topics, allowed))
        return entries == [] or any(one.name is not None for one in interfaces)

    def _remember(self, uid: str, device: _Device) -> None:
        if uid in self._devices or len(self._devices) < _DEVICES:
            self._devices[uid] = device

    def _topics(self, uid: str, interface: _Interface) -> Iterator[str]:
        for direction in interface.directions:
            if interface.name is not None:
                generic = MCU_COMMAND if direction == INCOMING else MCU_VALUE
                yield generic.topic(self._base, uid=uid, name=interface.name)
            if interface.channel and not is_reserved(interface.channel):  # never an alias: a stop must pass
                yield f"{self._base}/{direction}/{interface.channel}"

    def _device_of(self, topic: str) -> _Device | None:
        """The MCU below whose generic topics this one is."""
        prefix = next((prefix for prefix in (self._values, self._commands) if topic.startswith(prefix)), topic)
        return self._devices.get(topic.removeprefix(prefix).partition("/")[0])

    def _may_pass(self, message: Message) -> bool:
        if self.is_known(message.topic):
            return False
        if not message.payload:
            return True  # a retained value is removed
        if message.topic.startswith(self._values):
            names = MCU_VALUE.names(message.topic)
            return not names or self._is_public(names["uid"], names["name"])
        sample = _object(message.payload)
        uid, name = sample.get("device_uid"), sample.get("interface")
        if not isinstance(uid, str) or not (isinstance(name, str) or uid in self._devices):
            return True  # another message that contains the word by chance
        return self._is_public(uid, name)

    def _is_public(self, uid: str, name: object) -> bool:
        device = self._devices.get(uid)
        return device is not None and isinstance(name, str) and name in device.public

    def _hold(self, message: Message) -> list[Message]:
        retained = (message.retain or message.retain_requested) and not self.is_known(message.topic)
        if retained and (message.topic in self._waiting or len(self._waiting) < _WAITING):
            self._waiting[message.topic] = message
        return []

    def _released(self) -> list[Message]:
        waiting, self._waiting = self._waiting, {}
        released = []
        for message in waiting.values():
            released += [message] if self._may_pass(message) else self._hold(message)
        return released


def _object(payload: bytes) -> dict[str, Any]:
    """The JSON object that ``payload`` is; empty for anything else."""
    try:
        plain = codec.plain(MCU_DESCRIBE, payload)
    except PayloadError:
        return {}
    return plain if isinstance(plain, dict) else {}


def _entries(payload: bytes) -> list[Any] | None:
    """The interfaces of a manifest, whatever each is; None if there are none to be read."""
    entries = _object(payload).get("interfaces")
    return entries if isinstance(entries, list) else None


def _interface(entry: object) -> _Interface:
    plain = entry if isinstance(entry, dict) else {}
    name, channel, direction = plain.get("name"), plain.get("channel"), plain.get("dir")
    return _Interface(
        name=name if isinstance(name, str) and _level(name) else None,
        channel=channel
        if isinstance(channel, str) and all(map(_level, channel.split("/") if channel else ()))
        else None,
        directions=_DIRECTIONS.get(direction, _BOTH) if isinstance(direction, str) else _BOTH,
        public=plain.get("local_only", False) is False,
    )


def _public_names(interfaces: list[_Interface]) -> frozenset[str]:
    outgoing = [one for one in interfaces if one.name is not None and OUTGOING in one.directions]
    private = {one.name for one in outgoing if not one.public}
    return frozenset(one.name for one in outgoing if one.name is not None and one.name not in private)
