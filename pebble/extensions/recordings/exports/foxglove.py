"""Recordings for Foxglove: MCAP files in its Protobuf schemas, which its panels show without further settings.

``foxglove_messages`` has the conversion of each topic; other JSON stays on its topic unchanged.
"""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from pebble.extensions.media.packets import PBAT
from pebble.extensions.recordings.exports.foxglove_messages import (
    Converted,
    Media,
    Schemas,
    Telemetry,
    as_object,
    stamped,
    time_of,
)
from pebble.extensions.recordings.exports.unfinished import unfinished
from pebble.extensions.recordings.files.recorded import Channel, Recorded, Schema
from pebble.extensions.recordings.files.rewrite import Copy
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.stamps import is_picture

JSON: Final = "json"
LEFT_OUT: Final = "left out"


def write_foxglove(messages: Iterable[Recorded], target: Path) -> dict[str, int]:
    """Write ``messages`` to the MCAP file ``target``; return the number by schema, with ``json`` and ``left out``.

    Left out are unknown media, pictures that build on missing ones, and removals of retained messages. Raises
    RecordingError if ``target`` cannot be written, PebbleError without Foxglove's schemas.
    """
    schemas = Schemas()
    with unfinished(target) as path, path.open("wb", buffering=0) as file:
        writer = RecordingWriter(file)
        export = _Export(Copy(writer), schemas)
        for message in messages:
            export.add(message)
        writer.finish()
    return dict(export.counts)


class _Export:
    """A file that is being written."""

    def __init__(self, copy: Copy, schemas: Schemas) -> None:
        self.counts: Counter[str] = Counter()
        self._copy, self._schemas = copy, schemas
        self._media = Media(schemas)
        self._telemetry = Telemetry(schemas)
        self._channels: dict[str, Channel] = {}  # of converted messages, by topic

    def add(self, message: Recorded) -> None:
        """Add a message in Foxglove's form, or as JSON. Media have no JSON: without a form they are left out."""
        topic, payload = message.channel.topic, message.payload
        is_medium = is_picture(payload) or payload.startswith(PBAT)
        converted = (self._media if is_medium else self._telemetry).convert(topic, payload)
        stamp = time_of(payload, message.log_ns, message.publish_ns)
        if converted is not None:
            channel, name = self._channel(topic, converted), converted.message.DESCRIPTOR.name
            data: bytes | None = stamped(converted.message, stamp)
        else:
            channel, name, data = Channel(0, topic, JSON), JSON, None if is_medium else as_object(payload)
        if data is None:
            self.counts[LEFT_OUT] += 1
            return
        self._copy.add(Recorded(channel, 0, message.log_ns, stamp, data))  # 0: ``Copy`` numbers them itself
        self.counts[name] += 1

    def _channel(self, topic: str, converted: Converted) -> Channel:
        protobuf, topic = converted.message, f"{topic}/{converted.ending}"
        if topic not in self._channels:
            schema = Schema(protobuf.DESCRIPTOR.full_name, "protobuf", self._schemas.descriptors(protobuf))
            self._channels[topic] = Channel(0, topic, "protobuf", {}, schema)
        return self._channels[topic]
