"""Topics that a self-describing MCU marks ``local_only``: serial bridges publish a list for each MCU.

A value may arrive before the list: the order of two topics is undefined on Zenoh, and behind a full queue of a broker;
at a bridge that starts late it nearly always happens. So no value of an MCU passes before its list.
"""

import threading
from typing import Any

from pebble.contract import MCU_COMMAND, MCU_DESCRIBE, MCU_LOCAL_ONLY, MCU_VALUE, codec, is_reserved
from pebble.contract.payloads import McuLocalOnly
from pebble.errors import PayloadError
from pebble.forwarding.observer import PrivateTopics
from pebble.transports import Message

_DEVICES = 256  # remembered; a robot has a handful
_WAITING = 256  # retained values that wait for a list
_DESCRIBE, _LIST = ("/" + channel.metric.rpartition("/")[2] for channel in (MCU_DESCRIBE, MCU_LOCAL_ONLY))
_MARK = b'"device_uid"'  # in every value under an alias: the MCU it belongs to


class LocalOnly(PrivateTopics):
    """The private topics of all self-describing MCUs, by the list of each MCU."""

    def __init__(self, base: str) -> None:
        super().__init__(base)
        self._lock = threading.Lock()
        self._private: dict[str, frozenset[str]] = {}  # topics by uid; also of an MCU that has gone
        self._listed: set[str] = set()  # the uids whose list is valid now
        self._waiting: dict[str, Message] = {}  # by topic
        self._before_values = f"{base}/{MCU_VALUE.suffix.partition('{')[0]}"  # begins their topics; a uid follows
        self._before_commands = f"{base}/{MCU_COMMAND.suffix.partition('{')[0]}"

    def stays(self, topic: str) -> bool:
        """True if ``topic`` is on a list, is a command to an MCU without a list, or a request for a manifest.

        Only the robot's serial bridges send such requests, to each other. Values before a list are held by `admit`.
        """
        if topic.startswith(self._before_commands):
            uid = topic.removeprefix(self._before_commands).partition("/")[0]
            if uid not in self._listed or topic.endswith(_DESCRIBE):
                return True
        return bool(self._private) and any(topic in topics for topics in list(self._private.values()))

    def admit(self, message: Message) -> list[Message]:
        """Return ``message`` if it may pass now, otherwise keep it; for a list, return the values that waited."""
        with self._lock:
            if not message.payload:
                self._waiting.pop(message.topic, None)  # removed: nothing to forward any more
            if message.topic.startswith(self._before_values) and message.topic.endswith(_LIST):
                self._learn(message.topic.removeprefix(self._before_values).removesuffix(_LIST), message.payload)
                waiting, self._waiting = self._waiting, {}
                admitted: list[Message] = []
                for held in waiting.values():  # those of other MCUs go on waiting
                    admitted += self._judge(held)
                return admitted
            return self._judge(message)

    def _learn(self, uid: str, payload: bytes) -> None:
        """Store a list. A list that was removed or cannot be read lets no value pass; known topics stay private."""
        self._listed.discard(uid)
        try:
            listed: McuLocalOnly = codec.decode(MCU_LOCAL_ONLY, payload)
        except PayloadError:
            return
        if uid in self._private or len(self._private) < _DEVICES:
            # A list cannot hold back a stop, or what else is reserved. [2]: the metric, without incoming/ or outgoing/.
            usable = (topic for topic in listed.topics if not is_reserved(topic.partition("/")[2]))
            self._private[uid] = frozenset(f"{self.base}/{topic}" for topic in usable)
            self._listed.add(uid)

    def _judge(self, message: Message) -> list[Message]:
        """Return ``message`` if it may pass. A retained value of an MCU without a list is kept until its list comes.

        An empty message holds no value, so it needs no list.
        """
        if self.stays(message.topic):
            return []
        uid = self._uid_of(message)
        if not message.payload or uid is None or uid in self._listed:
            return [message]
        retained = message.retain or message.retain_requested
        if retained and (message.topic in self._waiting or len(self._waiting) < _WAITING):
            self._waiting[message.topic] = message
        return []

    def _uid_of(self, message: Message) -> str | None:
        """Return the uid of the MCU whose value this is; None for a manifest, or another program's message."""
        if message.topic.startswith(self._before_values):
            uid = message.topic.removeprefix(self._before_values).partition("/")[0]
            return None if message.topic.endswith(_DESCRIBE) else uid
        if _MARK not in message.payload:
            return None
        sample = _object(message.payload)  # a value under an alias: its topic has no uid, its payload has
        sender = sample.get("device_uid")
        return sender if isinstance(sender, str) and isinstance(sample.get("interface"), str) else None


def _object(payload: bytes) -> dict[str, Any]:
    """Return the JSON object in ``payload``; an empty dict if there is none."""
    try:
        plain = codec.plain(MCU_DESCRIBE, payload)
    except PayloadError:
        return {}
    return plain if isinstance(plain, dict) else {}
