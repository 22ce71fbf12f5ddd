"""Recordings for Foxglove: MCAP with its Protobuf schemas, which its panels show without further settings.

Each topic that is converted gets an ending, because Foxglove expects one schema for a topic: ``…/front-camera/video``.
Other JSON stays on its topic as it is. Sources: https://docs.foxglove.dev/docs/sdk/schemas, and for the payloads
``pebble.contract.payloads``.
"""

from __future__ import annotations

import importlib
import math
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import msgspec

from pebble.contract import (
    APRILTAG_LOCATIONS,
    INCOMING,
    LOCALIZATION_POSE,
    LOGS,
    OUTGOING,
    VIDEO_OVERLAYS,
    WHEEL_ODOMETRY,
    Channel,
    codec,
)
from pebble.contract.channels import channel_of
from pebble.contract.packets import PBAT, PBVD, Picture, PictureKind
from pebble.contract.payloads import Corners, LogRecord, TagLocations, VideoOverlays
from pebble.errors import PayloadError, PebbleError
from pebble.recordings.exports.film import unfinished
from pebble.recordings.exports.lines import Progress
from pebble.recordings.files.mcap import Recorded
from pebble.recordings.files.writer import McapWriter
from pebble.recordings.stamps import is_picture, stamp_ns

QUALITY: Final = 85.0  # of the JPEGs that are made of pictures, 1 to 100
JSON: Final = "json"
LEFT_OUT: Final = "left out"

_LEVELS: Final = {"DEBUG": 1, "INFO": 2, "WARNING": 3, "ERROR": 4, "CRITICAL": 5}  # Foxglove's numbers; 0: unknown
_LINE_LOOP, _LINE_STRIP = 2, 3  # types of PointsAnnotation
_CLOCK_FROM_NS: Final = 10**18  # 2001: a smaller stamp counts from the start of a board
_YELLOW: Final = {"r": 1.0, "g": 0.85, "b": 0.0, "a": 1.0}
_MOST_CHANNELS: Final = 8192
_THICKNESS, _FONT_SIZE = 2.0, 14.0  # pixels
_MILLIMETRES: Final = 1000.0

#: A Protobuf message, and the ending of its topic.
_Converted = tuple[Any, str]


def write_foxglove(
    messages: Iterable[Recorded],
    target: Path,
    *,
    overwrite: bool = False,
    quality: float = QUALITY,
    on_time: Progress | None = None,
) -> dict[str, int]:
    """Write ``messages`` to the MCAP file ``target``; returns how many there are by schema, ``json`` and ``left out``.

    Left out are bytes that are no media of a known kind, pictures without those that they build on, and removals of
    retained messages. Raises RecordingError if ``target`` cannot be written, PebbleError without Foxglove's schemas.
    """
    schemas = _Schemas()
    with unfinished(target, overwrite=overwrite) as path, path.open("wb", buffering=0) as file:
        export = _Export(McapWriter(file, library="pebble recordings"), schemas, quality)
        for message in messages:
            export.add(message)
            if on_time is not None:
                on_time(message.log_ns)
        export.finish()
    return dict(export.counts)


class _Schemas:
    """The classes of Foxglove's schemas, by name."""

    def __init__(self) -> None:
        """Raises PebbleError."""
        try:
            self._descriptors = importlib.import_module("google.protobuf.descriptor_pb2")
            importlib.import_module("foxglove_schemas_protobuf.RawAudio_pb2")
        except ImportError as error:
            raise PebbleError(
                f'Foxglove\'s format needs its schemas: pip install "pebble-robot[foxglove]" ({error})'
            ) from None

    def make(self, schema: str, /, **fields: Any) -> Any:
        """A message of ``schema``."""
        return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{schema}_pb2"), schema)(**fields)

    def descriptors(self, message: Any) -> bytes:
        """The file descriptors of a message's schema, each after those that it imports: what MCAP calls its schema."""
        found: dict[str, Any] = {}

        def add(file: Any) -> None:
            for needed in file.dependencies:
                if needed.name not in found:
                    add(needed)
            found[file.name] = file

        add(message.DESCRIPTOR.file)
        together = self._descriptors.FileDescriptorSet()
        for file in found.values():
            file.CopyToProto(together.file.add())
        return bytes(together.SerializeToString())


class _Export:
    """One file in the making."""

    def __init__(self, writer: McapWriter, schemas: _Schemas, quality: float) -> None:
        self.counts: Counter[str] = Counter()
        self._writer, self._schemas = writer, schemas
        self._media = _Media(schemas, quality)
        self._telemetry = _Telemetry(schemas)
        self._schema_ids: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(self, message: Recorded) -> None:
        payload = message.payload
        if is_picture(payload) or payload.startswith(PBAT):
            converted = self._media.convert(message)
            if converted is None:
                self.counts[LEFT_OUT] += 1
                return
        else:
            converted = self._telemetry.convert(message)
        if converted is None:
            self._add_json(message)
        else:
            self._add(message, *converted)

    def finish(self) -> None:
        self._writer.finish()

    def _add(self, message: Recorded, made: Any, ending: str) -> None:
        name, stamp = made.DESCRIPTOR.full_name, _stamp_ns(message)
        topic = f"{message.channel.topic}/{ending}"
        if topic not in self._channels:
            if name not in self._schema_ids:
                schema = self._schemas.descriptors(made)
                self._schema_ids[name] = self._writer.schema(name, "protobuf", schema)
            self._declare(topic, "protobuf", self._schema_ids[name])
        made.timestamp.FromNanoseconds(stamp)
        self._put(topic, message.log_ns, made.SerializeToString(), stamp, made.DESCRIPTOR.name)

    def _add_json(self, message: Recorded) -> None:
        payload, topic = _object(message.payload), message.channel.topic
        if payload is None:
            self.counts[LEFT_OUT] += 1
            return
        if topic not in self._channels:
            self._declare(topic, JSON, 0)
        self._put(topic, message.log_ns, payload, _stamp_ns(message), JSON)

    def _declare(self, topic: str, encoding: str, schema: int) -> None:
        if len(self._writer.contents.channels) < _MOST_CHANNELS:
            self._channels[topic] = self._writer.channel(topic, encoding, {}, schema)

    def _put(self, topic: str, log_ns: int, payload: bytes, stamp: int, count_as: str) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            self.counts[LEFT_OUT] += 1
            return
        self._writer.add(channel, log_ns, payload, stamp)
        self.counts[count_as] += 1


class _Media:
    """Pictures and sound: H.264 as it was sent, other pictures as whole JPEGs, all sound as samples."""

    def __init__(self, schemas: _Schemas, quality: float) -> None:
        self._make, self._quality = schemas.make, round(quality)
        self._pictures: dict[str, Any] = {}  # decoders by topic
        self._sounds: dict[str, Any] = {}

    def convert(self, message: Recorded) -> _Converted | None:
        payload, topic = message.payload, message.channel.topic
        if payload.startswith(PBAT):
            return self._sound(payload, topic)
        frame = "/".join(topic.split("/")[2:3])  # the robot's id
        return self._video(payload, frame) if _is_h264(payload) else self._image(payload, topic, frame)

    def _video(self, payload: bytes, frame: str) -> _Converted | None:
        from pebble.media.h264 import unseal

        try:
            unit = unseal(Picture.unpack(payload).body)
        except PayloadError:
            return None
        return self._make("CompressedVideo", frame_id=frame, data=unit, format="h264"), "video"

    def _image(self, payload: bytes, topic: str, frame: str) -> _Converted | None:
        import cv2

        from pebble.media.decode import VideoDecoder

        decoder = self._pictures.get(topic) or self._pictures.setdefault(topic, VideoDecoder())
        decoded = decoder.feed(payload)
        if decoded is None:
            return None
        jpeg = cv2.imencode(".jpg", decoded.picture, [cv2.IMWRITE_JPEG_QUALITY, self._quality])[1].tobytes()
        return self._make("CompressedImage", frame_id=frame, data=jpeg, format="jpeg"), "image"

    def _sound(self, payload: bytes, topic: str) -> _Converted | None:
        from pebble.media.sound import SoundDecoder

        decoder = self._sounds.get(topic) or self._sounds.setdefault(topic, SoundDecoder())
        sound = decoder.feed(payload)
        if sound is None:
            return None
        made = self._make(
            "RawAudio", data=sound.pcm, format="pcm-s16", sample_rate=sound.rate, number_of_channels=sound.channels
        )
        return made, "sound"


class _Telemetry:
    """Payloads of the contract for which Foxglove has a schema."""

    def __init__(self, schemas: _Schemas) -> None:
        self._make = schemas.make
        self._converters: dict[Channel, Callable[[Channel, Recorded], _Converted | None]] = {
            LOGS: self._log,
            WHEEL_ODOMETRY: self._odometry,
            LOCALIZATION_POSE: self._localization,
            APRILTAG_LOCATIONS: self._tags,
            VIDEO_OVERLAYS: self._overlays,
        }

    def convert(self, message: Recorded) -> _Converted | None:
        """None for a payload that is to stay as it is, also if it is not what its channel has."""
        levels = message.channel.topic.split("/", 3)
        channel = channel_of(levels[3]) if len(levels) == 4 and levels[3].startswith((INCOMING, OUTGOING)) else None
        convert = None if channel is None else self._converters.get(channel)
        if channel is None or convert is None:
            return None
        try:
            return convert(channel, message)
        except (PayloadError, OverflowError):  # whole numbers of any length are JSON
            return None

    def _log(self, channel: Channel, message: Recorded) -> _Converted:
        record: LogRecord = codec.decode(channel, message.payload)
        level = _LEVELS.get(record.level.upper(), 0)
        return self._make("Log", level=level, message=record.message, name=record.service), "log"

    def _odometry(self, channel: Channel, message: Recorded) -> _Converted | None:
        """Some robots have metres, and other names (paper A.8.12)."""
        payload = codec.decode(channel, message.payload)
        value, per_metre = payload.value, 1.0 if payload.unit == "m" else _MILLIMETRES
        x, y = (_number(value, f"{axis}_mm", axis) for axis in "xy")
        if x is None or y is None:
            return None
        per_metre = _MILLIMETRES if "x_mm" in value else per_metre
        heading = _number(value, "heading_rad", "theta_rad", "heading") or 0.0
        return self._pose(f"{_id(message)}/odom", x / per_metre, y / per_metre, 0.0, heading), "pose"

    def _localization(self, channel: Channel, message: Recorded) -> _Converted | None:
        """Of a ROS robot: metres and radians in the frame that it names."""
        payload = codec.plain(channel, message.payload)
        value = payload.get("value", payload) if isinstance(payload, dict) else None
        if not isinstance(value, dict):
            return None
        x, y = _number(value, "x_m"), _number(value, "y_m")
        if x is None or y is None:
            return None
        frame = str(value.get("frame_id") or "map")
        return self._pose(frame, x, y, _number(value, "z_m") or 0.0, _number(value, "yaw_rad") or 0.0), "pose"

    def _pose(self, frame: str, x: float, y: float, z: float, heading_rad: float) -> Any:
        pose = self._make("PoseInFrame", frame_id=frame)
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = x, y, z
        pose.pose.orientation.z, pose.pose.orientation.w = math.sin(heading_rad / 2), math.cos(heading_rad / 2)
        return pose

    def _tags(self, channel: Channel, message: Recorded) -> _Converted:
        tags: TagLocations = codec.decode(channel, message.payload)
        drawn = _Drawing(self._make("ImageAnnotations"), tags.frame_width, tags.frame_height)
        for tag in tags.detections:
            drawn.outline(tag.corners_norm, _LINE_LOOP)
            drawn.label(str(tag.marker_id), tag.center_norm)
        return drawn.annotations, "annotations"

    def _overlays(self, channel: Channel, message: Recorded) -> _Converted:
        overlays: VideoOverlays = codec.decode(channel, message.payload)
        drawn = _Drawing(self._make("ImageAnnotations"), overlays.frame_width, overlays.frame_height)
        for shape in overlays.shapes:
            drawn.outline(shape, _LINE_STRIP)
        for label in overlays.labels:
            drawn.label(str(label.marker_id), label.center_norm)
        return drawn.annotations, "annotations"


class _Drawing:
    """Lines and texts on a picture, from parts of its size to pixels."""

    def __init__(self, annotations: Any, width: int, height: int) -> None:
        self.annotations, self._width, self._height = annotations, width, height

    def outline(self, corners: Corners, line: int) -> None:
        drawn = self.annotations.points.add(type=line, thickness=_THICKNESS, outline_color=_YELLOW)
        for x, y in corners:
            drawn.points.add(x=x * self._width, y=y * self._height)

    def label(self, text: str, at: tuple[float, float]) -> None:
        position = {"x": at[0] * self._width, "y": at[1] * self._height}
        self.annotations.texts.add(text=text, position=position, font_size=_FONT_SIZE, text_color=_YELLOW)


def _is_h264(payload: bytes) -> bool:
    return payload.startswith(PBVD) and payload[5:6] == bytes([PictureKind.H264])


def _id(message: Recorded) -> str:
    return message.channel.topic.split("/")[2]


def _stamp_ns(message: Recorded) -> int:
    """The payload's own time, or when it was received."""
    stamp = message.publish_ns or stamp_ns(message.payload)
    return stamp if stamp >= _CLOCK_FROM_NS else message.log_ns


def _number(value: dict[str, Any], *names: str) -> float | None:
    """The first of the named fields that is a number; None if none is."""
    found = (value.get(name) for name in names)
    return next((float(one) for one in found if isinstance(one, int | float) and not isinstance(one, bool)), None)


def _object(payload: bytes) -> bytes | None:
    """The JSON object in ``payload``. Another JSON value is wrapped as the contract does (paper A.4.5).

    None for what is no JSON, and for an empty payload.
    """
    try:
        payload.decode()
        value = msgspec.json.decode(payload)
    except (UnicodeDecodeError, msgspec.DecodeError, RecursionError):
        return None
    return payload if isinstance(value, dict) else msgspec.json.encode({"value": value})
