"""Conversion of robots' messages to Foxglove's schemas, for its files and for the live connection.

A converted topic gets a suffix, because Foxglove expects one schema for each topic: ``…/front-camera/video``. Sources:
https://docs.foxglove.dev/docs/sdk/schemas, and for the payloads ``pebble.contract.payloads``.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from pebble import contract as c
from pebble.contract import codec
from pebble.contract.channels import channel_of
from pebble.contract.payloads import Corners, LogRecord, TagLocations, VideoOverlays
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.media.packets import PBAT, PBVD, Picture, PictureKind
from pebble.extensions.recordings.stamps import CLOCK_FROM_NS, stamp_ns

if TYPE_CHECKING:
    from pebble.extensions.media.decode import VideoDecoder
    from pebble.extensions.media.sound import SoundDecoder

QUALITY: Final = 85  # of the JPEGs that are made of pictures, 1 to 100
MOST_CHANNELS: Final = 8192  # of one export; further ones are left out and counted

_LEVELS: Final = {"DEBUG": 1, "INFO": 2, "WARNING": 3, "ERROR": 4, "CRITICAL": 5}  # Foxglove's numbers; 0: unknown
_LINE_LOOP, _LINE_STRIP = 2, 3  # types of PointsAnnotation
_YELLOW: Final = {"r": 1.0, "g": 0.85, "b": 0.0, "a": 1.0}
_THICKNESS, _FONT_SIZE = 2.0, 14.0  # pixels
_MILLIMETRES: Final = 1000.0


class MediaChannel(NamedTuple):
    """A Foxglove channel for pictures or sound: its schema, and the ending of its topic."""

    schema: str
    ending: str


VIDEO = MediaChannel("CompressedVideo", "video")  # H.264
IMAGE = MediaChannel("CompressedImage", "image")
SOUND = MediaChannel("RawAudio", "sound")


class Converted(NamedTuple):
    """A Protobuf message of Foxglove's, and the suffix of its topic."""

    message: Any
    ending: str


class Schemas:
    """The classes of Foxglove's schemas, by name."""

    def __init__(self) -> None:
        """Load the schemas. Raises PebbleError if they are not installed."""
        try:
            self._descriptors = importlib.import_module("google.protobuf.descriptor_pb2")
            # One schema shows that the package is there; `make` imports each when it is needed.
            importlib.import_module("foxglove_schemas_protobuf.RawAudio_pb2")
        except ImportError as error:
            raise PebbleError(
                f'Foxglove\'s format needs its schemas: pip install "pebble-robot[foxglove]" ({error})'
            ) from None

    def make(self, schema: str, /, **fields: Any) -> Any:
        return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{schema}_pb2"), schema)(**fields)

    def descriptors(self, message: Any) -> bytes:
        """Return a message's protobuf FileDescriptorSet, each file after its imports: a schema in MCAP's terms."""
        files: dict[str, Any] = {}

        def add(file: Any) -> None:
            for needed in file.dependencies:
                if needed.name not in files:
                    add(needed)
            files[file.name] = file

        add(message.DESCRIPTOR.file)
        together = self._descriptors.FileDescriptorSet()
        for file in files.values():
            file.CopyToProto(together.file.add())
        return bytes(together.SerializeToString())


class Media:
    """A converter of media: H.264 as it was sent, other pictures to complete JPEGs, sound to samples."""

    def __init__(self, schemas: Schemas) -> None:
        self._make = schemas.make
        self._pictures: dict[str, VideoDecoder] = {}  # by topic
        self._sounds: dict[str, SoundDecoder] = {}

    def convert(self, topic: str, payload: bytes) -> Converted | None:
        """Return the converted payload; None for unknown media, and for pictures that build on missing ones."""
        if payload.startswith(PBAT):
            return self.sound(topic, payload)
        return self.video(topic, payload) if is_h264(payload) else self.image(topic, payload)

    def video(self, topic: str, payload: bytes) -> Converted | None:
        """Return H.264 as it was sent; None for another encoding or damaged data.

        It is as Foxglove requires: Annex B, parameter sets in key frames, no B-frames.
        """
        from pebble.extensions.media.h264 import unseal

        if not is_h264(payload):
            return None
        try:
            unit = unseal(Picture.unpack(payload).body)
        except PayloadError:
            return None
        schema, ending = VIDEO
        return Converted(self._make(schema, frame_id=_id(topic), data=unit, format="h264"), ending)

    def image(self, topic: str, payload: bytes) -> Converted | None:
        """Return a picture in any encoding as a complete JPEG; None as in :meth:`convert`."""
        import cv2

        decoded = self.decoder(topic).feed(payload)
        if decoded is None:
            return None
        jpeg = cv2.imencode(".jpg", decoded.picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
        schema, ending = IMAGE
        return Converted(self._make(schema, frame_id=_id(topic), data=jpeg, format="jpeg"), ending)

    def sound(self, topic: str, payload: bytes) -> Converted | None:
        """Return samples; None for other data, and for Opus without PyAV.

        Foxglove does not read Opus.
        """
        from pebble.extensions.media.sound import SoundDecoder

        if topic not in self._sounds:
            self._sounds[topic] = SoundDecoder()
        sound = self._sounds[topic].feed(payload)
        if sound is None:
            return None
        schema, ending = SOUND
        message = self._make(
            schema, data=sound.pcm, format="pcm-s16", sample_rate=sound.rate, number_of_channels=sound.channels
        )
        return Converted(message, ending)

    def decoder(self, topic: str) -> VideoDecoder:
        """Return the decoder of this topic's pictures.

        It knows why it refused a picture, and whether it needs a key frame.
        """
        from pebble.extensions.media.decode import VideoDecoder

        if topic not in self._pictures:
            self._pictures[topic] = VideoDecoder()
        return self._pictures[topic]


class Telemetry:
    """A converter of those payloads of the contract for which Foxglove has a schema."""

    def __init__(self, schemas: Schemas) -> None:
        self._make = schemas.make
        self._converters: dict[c.Channel, Callable[[str, bytes], Converted | None]] = {
            c.LOGS: self._log,
            c.WHEEL_ODOMETRY: self._odometry,
            c.LOCALIZATION_POSE: self._localization,
            c.APRILTAG_LOCATIONS: self._tags,
            c.VIDEO_OVERLAYS: self._overlays,
        }

    def convert(self, topic: str, payload: bytes) -> Converted | None:
        """Return the converted payload; None if it is to stay as it is, also if it does not fit its channel."""
        below_base = "".join(topic.split("/", 3)[3:])  # empty if there are only three levels
        channel = channel_of(below_base) if below_base.startswith((c.INCOMING, c.OUTGOING)) else None
        convert = None if channel is None else self._converters.get(channel)
        if convert is None:
            return None
        try:
            return convert(topic, payload)
        except (PayloadError, OverflowError):  # whole numbers of any length are JSON
            return None

    def _log(self, _topic: str, payload: bytes) -> Converted:
        record: LogRecord = codec.decode(c.LOGS, payload)
        level = _LEVELS.get(record.level.upper(), 0)
        return Converted(self._make("Log", level=level, message=record.message, name=record.service), "log")

    def _odometry(self, topic: str, payload: bytes) -> Converted | None:
        """Convert odometry. Some robots send metres, under other names (paper A.8.12)."""
        odometry = codec.decode(c.WHEEL_ODOMETRY, payload)
        value = odometry.value
        x, y = _number(value, "x_mm", "x"), _number(value, "y_mm", "y")
        if x is None or y is None:
            return None
        per_metre = 1.0 if odometry.unit == "m" and "x_mm" not in value else _MILLIMETRES
        heading = _number(value, "heading_rad", "theta_rad", "heading") or 0.0
        return Converted(self._pose(f"{_id(topic)}/odom", x / per_metre, y / per_metre, 0.0, heading), "pose")

    def _localization(self, _topic: str, payload: bytes) -> Converted | None:
        """Convert the pose of a ROS robot: metres and radians in the frame that it names."""
        pose = codec.plain(c.LOCALIZATION_POSE, payload)
        value = pose.get("value", pose) if isinstance(pose, dict) else None  # wrapped in ``value`` or not
        if not isinstance(value, dict):
            return None
        x, y = _number(value, "x_m"), _number(value, "y_m")
        if x is None or y is None:
            return None
        frame = str(value.get("frame_id") or "map")
        message = self._pose(frame, x, y, _number(value, "z_m") or 0.0, _number(value, "yaw_rad") or 0.0)
        return Converted(message, "pose")

    def _pose(self, frame: str, x: float, y: float, z: float, heading_rad: float) -> Any:
        pose = self._make("PoseInFrame", frame_id=frame)
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = x, y, z
        pose.pose.orientation.z, pose.pose.orientation.w = math.sin(heading_rad / 2), math.cos(heading_rad / 2)
        return pose

    def _tags(self, _topic: str, payload: bytes) -> Converted:
        tags: TagLocations = codec.decode(c.APRILTAG_LOCATIONS, payload)
        drawn = _Drawing(self._make("ImageAnnotations"), tags.frame_width, tags.frame_height)
        for tag in tags.detections:
            drawn.outline(tag.corners_norm, _LINE_LOOP)
            drawn.label(str(tag.marker_id), tag.center_norm)
        return Converted(drawn.annotations, "annotations")

    def _overlays(self, _topic: str, payload: bytes) -> Converted:
        overlays: VideoOverlays = codec.decode(c.VIDEO_OVERLAYS, payload)
        drawn = _Drawing(self._make("ImageAnnotations"), overlays.frame_width, overlays.frame_height)
        for shape in overlays.shapes:
            drawn.outline(shape, _LINE_STRIP)
        for label in overlays.labels:
            drawn.label(str(label.marker_id), label.center_norm)
        return Converted(drawn.annotations, "annotations")


class _Drawing:
    """A converter of lines and texts on a picture, from fractions of its size to pixels."""

    def __init__(self, annotations: Any, width: int, height: int) -> None:
        self.annotations, self._width, self._height = annotations, width, height

    def outline(self, corners: Corners, line: int) -> None:
        drawn = self.annotations.points.add(type=line, thickness=_THICKNESS, outline_color=_YELLOW)
        for x, y in corners:
            drawn.points.add(x=x * self._width, y=y * self._height)

    def label(self, text: str, at: tuple[float, float]) -> None:
        position = {"x": at[0] * self._width, "y": at[1] * self._height}
        self.annotations.texts.add(text=text, position=position, font_size=_FONT_SIZE, text_color=_YELLOW)


def is_h264(payload: bytes) -> bool:
    """True if the payload is a picture in H.264, by its header."""
    return payload.startswith(PBVD) and payload[5:6] == bytes([PictureKind.H264])


def stamped(message: Any, ns: int) -> bytes:
    """Return the message with this time, as bytes."""
    message.timestamp.FromNanoseconds(ns)
    return bytes(message.SerializeToString())


def time_of(payload: bytes, received_ns: int, publish_ns: int = 0) -> int:
    """Return ``publish_ns`` or, if it is 0, the payload's stamp; without a plausible one, ``received_ns``."""
    stamp = publish_ns or stamp_ns(payload)
    return stamp if stamp >= CLOCK_FROM_NS else received_ns


def as_object(payload: bytes) -> bytes | None:
    """Return the JSON object in ``payload``; None if it is no JSON, or empty.

    Another JSON value is wrapped as the contract does (paper A.4.5).
    """
    payload = codec.trim(payload)
    try:
        payload.decode()  # raises if it is not UTF-8
        value = msgspec.json.decode(payload)
    except (UnicodeDecodeError, msgspec.DecodeError, RecursionError):
        return None
    return payload if isinstance(value, dict) else msgspec.json.encode({"value": value})


def _id(topic: str) -> str:
    """Return the id of a topic's robot, after which Foxglove's frames of reference are named."""
    return "/".join(topic.split("/")[2:3])


def _number(value: dict[str, Any], *names: str) -> float | None:
    """Return the first of the named fields that is a number; None if there is none."""
    for name in names:
        number = value.get(name)
        if isinstance(number, int | float) and not isinstance(number, bool):
            return float(number)
    return None
