"""The channels of a file, bounded: a stranger may invent topics."""

from collections import Counter
from collections.abc import Hashable, Mapping
from typing import Final

from pebble.recordings.files.mcap import OTHER, Schema, pack_other
from pebble.recordings.files.writer import McapWriter

#: Channels of one file, and of one component in it: who invents topics must not use up a robot's.
_MOST, _MOST_OF_ONE = 4096, 512
_BYTES: Final = "application/octet-stream"


class ChannelTable:
    """Writes messages under channels that are declared when they are needed; beyond the limits they share one."""

    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._channels: dict[Hashable, int] = {}
        self._counts = Counter[str]()  # by component
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._other: int | None = None

    def find(self, key: Hashable) -> int | None:
        """The channel that :meth:`declare` has given to ``key``."""
        return self._channels.get(key)

    def declare(
        self, key: Hashable, topic: str, encoding: str, metadata: Mapping[str, str], schema: Schema | None = None
    ) -> int | None:
        """A new channel; None if there is no room for it."""
        component = "/".join(topic.split("/", 3)[:3])
        if len(self._channels) >= _MOST or self._counts[component] >= _MOST_OF_ONE:
            return None
        self._counts[component] += 1
        channel = self._channels[key] = self._writer.channel(topic, encoding, metadata, self._schema(schema))
        return channel

    def _schema(self, schema: Schema | None) -> int:
        if schema is None:
            return 0
        about = schema.name, schema.encoding, schema.data
        if about not in self._schemas:
            self._schemas[about] = self._writer.schema(*about)
        return self._schemas[about]

    def add_other(self, topic: str, metadata: Mapping[str, str], log_ns: int, payload: bytes, publish_ns: int) -> None:
        """Add a message whose topic has no room for a channel of its own."""
        if self._other is None:
            self._other = self._writer.channel(OTHER, _BYTES, {})
        self._writer.add(self._other, log_ns, pack_other(topic, metadata, payload), publish_ns)
