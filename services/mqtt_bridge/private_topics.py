"""What a self-describing MCU wants kept on the robot: learnt from its manifest, and not let out before.

No order between two topics is promised: on Zenoh, and behind a full queue of a broker, a sample may come before the
manifest that calls it private, and to a bridge that starts late it nearly always does. So a value passes only once its
manifest has said that it may.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator

from pebble import codec
from pebble.contract import INCOMING, MCU_COMMAND, MCU_DESCRIBE, MCU_VALUE, OUTGOING
from pebble.errors import PayloadError
from pebble.payloads import McuManifest
from pebble.transports import Message

_DEVICES = 256  # remembered; a robot has a handful
_WAITING = 256  # kept values that wait for a manifest
_QUESTION = "/" + MCU_DESCRIBE.metric.rpartition("/")[2]
_MARK = b'"device_uid"'  # what a value under an alias carries: it says whose it is


class PrivateTopics:
    """The ``local_only`` interfaces of every MCU. Called on the transports' threads."""

    def __init__(self, base: str) -> None:
        self._base = base
        self._lock = threading.Lock()
        self._public: dict[str, frozenset[str]] = {}  # interfaces that may pass, by uid; one that is gone has none
        self._private: dict[str, frozenset[str]] = {}  # topics that may not, by uid; remembered
        self._waiting: dict[str, Message] = {}  # by topic
        self._values = f"{base}/{OUTGOING}/{MCU_VALUE.metric.partition('{')[0]}"
        self._commands = f"{base}/{INCOMING}/{MCU_COMMAND.metric.partition('{')[0]}"

    def is_known(self, topic: str) -> bool:
        """Does a manifest call this topic private? So is the question whose a uid is: only lines settle that."""
        if topic.startswith(self._commands) and topic.endswith(_QUESTION):
            return True
        return any(topic in topics for topics in list(self._private.values()))

    def admit(self, message: Message) -> list[Message]:
        """What may pass now: ``message`` or nothing; with a manifest, after it the kept values that waited for it."""
        if not message.payload:
            with self._lock:
                self._waiting.pop(message.topic, None)  # taken back: not to be told any more
        if not message.topic.startswith(self._values) and _MARK not in message.payload:
            return [] if self.is_known(message.topic) else [message]
        with self._lock:
            uid = MCU_DESCRIBE.names(message.topic).get("uid")
            if uid is not None and message.topic == MCU_DESCRIBE.topic(self._base, uid=uid):
                self._learn(uid, message)
                return [message, *self._released()]
            return [message] if self._may_pass(message) else self._hold(message)

    def _learn(self, uid: str, message: Message) -> None:
        """A malformed manifest changes nothing. One that is taken back leaves what is private private."""
        if not message.payload:
            self._public.pop(uid, None)
            return
        try:
            manifest: McuManifest = codec.decode(MCU_DESCRIBE, message.payload)
        except PayloadError:
            return
        if uid not in self._private and len(self._private) >= _DEVICES:
            return
        interfaces = [one for one in manifest.interfaces if isinstance(one.get("name"), str)]
        private = [one for one in interfaces if one.get("local_only") is True]
        outgoing = {one["name"] for one in interfaces if one.get("dir") != "in"}
        self._public[uid] = frozenset(outgoing - {one["name"] for one in private if one.get("dir") != "in"})
        self._private[uid] = frozenset(topic for one in private for topic in self._topics(uid, one))

    def _topics(self, uid: str, interface: dict[str, object]) -> Iterator[str]:
        incoming = interface.get("dir") == "in"
        generic = MCU_COMMAND if incoming else MCU_VALUE
        yield generic.topic(self._base, uid=uid, name=str(interface["name"]))
        if interface.get("channel"):
            yield f"{self._base}/{INCOMING if incoming else OUTGOING}/{interface['channel']}"

    def _may_pass(self, message: Message) -> bool:
        if self.is_known(message.topic):
            return False
        if not message.payload:
            return True  # a kept value is taken back
        if message.topic.startswith(self._values):
            names = MCU_VALUE.names(message.topic)
            return not names or names["name"] in self._public.get(names["uid"], ())
        try:
            sample = codec.decode(MCU_VALUE, message.payload)
        except PayloadError:
            return True  # something else that happens to use the word
        return sample.interface in self._public.get(sample.device_uid, ())

    def _hold(self, message: Message) -> list[Message]:
        kept = (message.retain or message.keep) and not self.is_known(message.topic)
        if kept and (message.topic in self._waiting or len(self._waiting) < _WAITING):
            self._waiting[message.topic] = message
        return []

    def _released(self) -> list[Message]:
        waiting, self._waiting = self._waiting, {}
        released = []
        for message in waiting.values():
            released += [message] if self._may_pass(message) else self._hold(message)
        return released
