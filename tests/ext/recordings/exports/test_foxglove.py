"""Foxglove's file is proper MCAP, and its messages are what was recorded."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.records import Channel as McapChannel
from mcap.records import Schema

from pebble.contract import APRILTAG_LOCATIONS, LOGS, VIDEO_OVERLAYS, WHEEL_ODOMETRY, codec
from pebble.contract.channels import Channel as ContractChannel
from pebble.contract.payloads import (
    LogRecord,
    OverlayLabel,
    TagDetection,
    TagLocations,
    VideoOverlays,
    WheelOdometry,
)
from pebble.extensions.media.h264 import unseal
from pebble.extensions.media.pcm import to_bytes
from pebble.extensions.media.sound import make_sound_encoder
from pebble.extensions.recordings.exports.foxglove import write_foxglove
from pebble.extensions.recordings.files.recorded import Channel, Recorded
from tests.ext.recordings.exports.test_film import DELAY_MS, ROBOT, T0_MS, pictures
from tests.kit.scene import read_counter

T0_NS = T0_MS * 10**6
DELAY_NS = DELAY_MS * 10**6
CORNERS = [(0.1, 0.2), (0.3, 0.2), (0.3, 0.4), (0.1, 0.4)]


def recorded(metric: str, payload: bytes, at_ms: int = T0_MS, publish_ns: int = 0) -> Recorded:
    channel = Channel(1, f"{ROBOT}/{metric}", "json", {"qos": "0", "retain": "0"})
    return Recorded(channel, 0, at_ms * 10**6 + DELAY_NS, publish_ns, payload)


def of(channel: ContractChannel, value: Any) -> Recorded:
    return recorded(channel.suffix, codec.encode(channel, value))


class File:
    """A file read by other people's packages alone: MCAP's with its checksums, Protobuf's with the file's schemas."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            self.messages = [
                (schema, channel, message.log_time, message.publish_time, message.data)
                for schema, channel, message in reader.iter_messages()
            ]
            summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(self.messages)
        self.topics = {channel.topic: channel for channel in summary.channels.values()}

    def of(self, ending: str) -> list[Any]:
        """The messages of the topics that end so, as Protobuf or JSON has them."""
        return [
            _parsed(schema, channel, data)
            for schema, channel, _, _, data in self.messages
            if channel.topic.endswith(ending)
        ]

    def names(self) -> dict[str, str]:
        """By topic, the schema."""
        return {channel.topic: schema.name if schema else "" for schema, channel, *_ in self.messages}


def _parsed(schema: Schema | None, channel: McapChannel, data: bytes) -> Any:
    if schema is None:
        return json.loads(data)
    assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)  # refuses a file before those that it imports
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(data)


def converted(tmp_path: Path, messages: list[Recorded]) -> tuple[File, dict[str, int]]:
    target = tmp_path / "walk.mcap"
    counts = write_foxglove(messages, target)
    assert [path.name for path in tmp_path.iterdir()] == ["walk.mcap"]
    return File(target), counts


@pytest.mark.parametrize("name", ["json", "pbvd"])
def test_pictures_become_jpegs(tmp_path: Path, name: str) -> None:
    file, counts = converted(tmp_path, pictures(name, range(8)))
    assert counts == {"CompressedImage": 8}
    assert file.names() == {f"{ROBOT}/outgoing/front-camera/image": "foxglove.CompressedImage"}
    images = file.of("/image")
    assert [(image.format, image.frame_id) for image in images] == [("jpeg", "goob")] * 8
    captured = [T0_NS + number * 66_000_000 for number in range(8)]
    assert [(publish, log) for _, _, log, publish, _ in file.messages] == [(at, at + DELAY_NS) for at in captured]
    assert [image.timestamp.ToNanoseconds() for image in images] == captured
    decoded = [cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR) for image in images]
    assert [read_counter(np.asarray(one, np.uint8)) for one in decoded] == list(range(8))


def test_h264_is_passed_on_without_its_seal(tmp_path: Path) -> None:
    sent = pictures("h264", range(8))
    damaged = recorded("outgoing/front-camera", sent[5].payload[:-20], T0_MS + 5 * 66)
    file, counts = converted(tmp_path, [*sent[:5], damaged, *sent[6:]])
    assert counts == {"CompressedVideo": 7, "left out": 1}
    videos = file.of("/video")
    assert {video.format for video in videos} == {"h264"}
    assert [video.data for video in videos[:5]] == [unseal(one.payload[19:]) for one in sent[:5]]
    decoder = av.CodecContext.create("h264", "r")
    shown = [frame for video in videos[:5] for frame in decoder.decode(av.Packet(video.data))] + decoder.decode(None)
    assert [read_counter(frame.to_ndarray(format="bgr24")) for frame in shown] == list(range(5))


@pytest.mark.parametrize(("name", "rate", "channels"), [("pcm", 16_000, 1), ("opus", 48_000, 2)])
def test_sound(tmp_path: Path, name: str, rate: int, channels: int) -> None:
    tone = (9000 * np.sin(np.arange(rate) / 20)).astype(np.int16)
    encoder = make_sound_encoder(name, rate=rate, channels=channels)
    packets = encoder.encode(to_bytes(np.repeat(tone[:, None], channels, axis=1)), T0_MS)
    messages = [recorded("outgoing/audio", packet) for packet in packets]
    messages += [recorded("incoming/audio-stream", packets[0]), recorded("outgoing/audio", packets[0][:30])]
    file, counts = converted(tmp_path, messages)
    assert counts == {"RawAudio": len(packets) + 1, "left out": 1}
    blocks = file.of("/outgoing/audio/sound")
    assert {(one.format, one.sample_rate, one.number_of_channels) for one in blocks} == {("pcm-s16", rate, channels)}
    assert sum(len(one.data) for one in blocks) == pytest.approx(2 * channels * rate, rel=0.03)
    assert [one.timestamp.ToNanoseconds() for one in blocks[:3]] == [T0_NS, T0_NS + 20_000_000, T0_NS + 40_000_000]
    assert len(file.of("/incoming/audio-stream/sound")) == 1


def test_log_lines(tmp_path: Path) -> None:
    records = [LogRecord(t=T0_MS, level=level, service="bridge", message=f"{level}!") for level in ("WARNING", "odd")]
    file, counts = converted(tmp_path, [of(LOGS, one) for one in records])
    assert counts == {"Log": 2}
    logs = file.of("/logs/log")
    assert [(one.level, one.name, one.message) for one in logs] == [(3, "bridge", "WARNING!"), (0, "bridge", "odd!")]
    assert logs[0].timestamp.ToNanoseconds() == T0_NS


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        ({"x_mm": 1500.0, "y_mm": -250.0, "heading_rad": math.pi / 2}, "mm", (1.5, -0.25, math.pi / 2)),
        ({"x": 1500, "y": -250, "heading": -3.0}, "mm", (1.5, -0.25, -3.0)),
        ({"x_mm": 1500, "y_mm": -250}, "m", (1.5, -0.25, 0.0)),
    ],
)
def test_odometry(tmp_path: Path, value: dict[str, Any], unit: str, expected: tuple[float, float, float]) -> None:
    file, counts = converted(
        tmp_path, [of(WHEEL_ODOMETRY, WheelOdometry(value=value, timestamp=T0_MS / 1e3, unit=unit))]
    )
    assert counts == {"PoseInFrame": 1}
    (made,) = file.of("/wheel-odometry/pose")
    position, turned = made.pose.position, made.pose.orientation
    assert made.frame_id == "goob/odom"
    assert (position.x, position.y, 2 * math.atan2(turned.z, turned.w)) == pytest.approx(expected)
    assert made.timestamp.ToNanoseconds() == T0_NS


def test_the_pose_of_a_ros_robot(tmp_path: Path) -> None:
    payload = {"t": T0_MS, "value": {"x_m": 1.0, "y_m": 2.0, "z_m": 0.5, "yaw_rad": 1.0, "frame_id": "hall"}}
    file, _ = converted(tmp_path, [recorded("outgoing/localization-pose", json.dumps(payload).encode())])
    (made,) = file.of("/localization-pose/pose")
    position = made.pose.position
    assert (made.frame_id, position.x, position.y, position.z) == ("hall", 1.0, 2.0, 0.5)
    assert made.pose.orientation.w == pytest.approx(math.cos(0.5))


def test_tags_and_overlays_are_drawn_in_pixels(tmp_path: Path) -> None:
    detection = TagDetection(marker_id=7, corners_norm=CORNERS, center_norm=(0.2, 0.3))
    stamp = T0_MS / 1e3
    tags = TagLocations(source="tags", detections=[detection], frame_width=640, frame_height=480, timestamp=stamp)
    labels, size = [OverlayLabel(marker_id=7, center_norm=(0.2, 0.3))], {"frame_width": 640, "frame_height": 480}
    overlays = VideoOverlays(source="tags", shapes=[CORNERS, CORNERS[:2]], labels=labels, timestamp=stamp, **size)
    file, counts = converted(tmp_path, [of(APRILTAG_LOCATIONS, tags), of(VIDEO_OVERLAYS, overlays)])
    assert counts == {"ImageAnnotations": 2}
    (drawn,), (over,) = file.of("/apriltag-locations/annotations"), file.of("/video-overlays/annotations")
    assert [(point.x, point.y) for point in drawn.points[0].points] == [(64, 96), (192, 96), (192, 192), (64, 192)]
    assert (drawn.points[0].type, [shape.type for shape in over.points]) == (2, [3, 3])
    for one in (drawn, over):
        (text,) = one.texts
        assert (text.text, text.position.x, text.position.y) == ("7", 128, 144)


@pytest.mark.parametrize(
    ("metric", "payload", "expected"),
    [
        ("incoming/flags/mqtt-video", b"true", {"value": True}),
        ("outgoing/navigation-goal", b"[1, 2]", {"value": [1, 2]}),
        ("outgoing/wheel-odometry", b'{"value": {"left_mm": 3}, "timestamp": 1}', None),
        ("outgoing/wheel-odometry", b'{"value": {"x_mm": ' + b"9" * 400 + b', "y_mm": 1}, "timestamp": 1}', None),
        ("outgoing/localization-pose", b"[]", {"value": []}),
        ("outgoing/apriltag-locations", b'{"detections": "none"}', {"detections": "none"}),
    ],
)
def test_other_json_stays_as_it_is(tmp_path: Path, metric: str, payload: bytes, expected: Any) -> None:
    file, counts = converted(tmp_path, [recorded(metric, payload, publish_ns=1_200_000_000)])
    assert counts == {"json": 1}
    assert [publish for *_, publish, _ in file.messages] == [T0_NS + DELAY_NS], "a board's time since its start is none"
    assert file.topics[f"{ROBOT}/{metric}"].message_encoding == "json"
    assert file.of(metric) == [json.loads(payload) if expected is None else expected]


@pytest.mark.parametrize("payload", [b"", b"\xff\xfe", b"{", b"[" * 100_000, b"PBVD\1\1", b"PBAT\1\1", b"\xff\xd8"])
def test_what_is_left_out(tmp_path: Path, payload: bytes) -> None:
    file, counts = converted(tmp_path, [recorded("outgoing/thing", payload)])
    assert (file.messages, counts) == ([], {"left out": 1})


def test_several_channels_of_a_topic_become_one(tmp_path: Path) -> None:
    online = recorded("outgoing/online", b'{"t": 1}')
    retained = Recorded(Channel(5, online.channel.topic, "json", {"retained": "1"}), 0, T0_NS, 0, b'{"t": 2}')
    file, counts = converted(tmp_path, [*pictures("json", range(3)), *pictures("h264", range(3)), retained, online])
    assert counts == {"CompressedImage": 3, "CompressedVideo": 3, "json": 2}
    assert file.names() == {
        f"{ROBOT}/outgoing/front-camera/image": "foxglove.CompressedImage",
        f"{ROBOT}/outgoing/front-camera/video": "foxglove.CompressedVideo",
        f"{ROBOT}/outgoing/online": "",
    }
