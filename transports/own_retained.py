"""The retained messages that one transport has published. They are sent again to a broker or hub that lacks them."""

from collections.abc import Callable, Collection

from pebble.transports.bounds import BoundedTable
from pebble.transports.counters import Counters
from pebble.transports.message import Message

LIMIT = 10_000  # retained topics a transport can send again; the names of topics may come from other programs
BYTES = 16 << 20  # the same, with their payloads


class OwnRetained(BoundedTable[Message]):
    """The newest message of each topic, even an empty one. The transport's lock of publishing guards its attributes."""

    def __init__(self, counters: Counters) -> None:
        super().__init__(LIMIT, BYTES, lambda message: len(message.payload))
        self.pending: dict[str, None] = {}  # topics whose message is not sent yet, oldest first
        self.shared: set[str] = set()  # topics that others publish on, too
        self.syncing = False  # True while messages are sent again
        self._counters = counters

    def remember(self, message: Message, *, sent: bool, shared: bool | None = None) -> bool:
        """Store a message, to send it again; return False if there is no room: then its topic is forgotten.

        ``sent``: it need not be sent now. ``shared``: others publish on the topic as well; None: as before.
        """
        shared = message.topic in self.shared if shared is None else shared
        self.pending.pop(message.topic, None)
        self.shared.discard(message.topic)
        if sent and not message.payload:
            self.pop(message.topic, None)
            return True
        if not self.put_if_room(message.topic, message):
            self._counters.add("forgotten")
            return False
        if shared:
            self.shared.add(message.topic)
        if not sent:
            self.pending[message.topic] = None
        return True

    def send_again(self, known_topics: Collection[str], send: Callable[[Message], bool]) -> None:
        """Send the pending messages; then all others but those on ``known_topics``."""
        pending = [self[topic] for topic in self.pending]
        others = [message for topic, message in self.items() if topic not in self.pending and topic not in known_topics]
        self.syncing = True
        try:
            for message in pending + others:
                self.remember(message, sent=send(message))
        finally:
            self.syncing = False
