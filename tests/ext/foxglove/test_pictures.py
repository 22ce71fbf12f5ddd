"""Pictures and sound: requested while a client subscribes, as Foxglove expects them, and withdrawn afterwards."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.extensions.foxglove.media_feed import MAX_WAITING, MAX_WAITING_BYTES, MediaFeed
from pebble.extensions.foxglove.server import MAX_BYTES, ChannelSpec, Server
from pebble.extensions.media.packets import PBAT
from pebble.extensions.media.picture_header import MAX_PAYLOAD
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.video import make_encoder
from pebble.extensions.operator.client.media_request import shared
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.recordings.exports.foxglove_messages import Schemas
from pebble.transports.memory import MemoryHub
from tests.ext.foxglove.live import Live, Watcher, client, live, parser
from tests.ext.page.media.robots import (
    AUDIO,
    CAMERA,
    CAPABILITIES,
    REF,
    SOUND,
    VIDEO,
    PictureRobot,
    SoundRobot,
    broker_on,
    capabilities,
)
from tests.kit.npm import package
from tests.kit.scene import read_counter
from tests.support import Broker, until

H264, JPEG, SAMPLES = f"{CAMERA}/video", f"{CAMERA}/image", f"{SOUND}/sound"
REQUESTED, WITHDRAWN = {"enabled": True, "encoding": "h264"}, {"enabled": False}
_nal_types = re.compile(rb"\x00\x00\x01(.)", re.DOTALL).findall


@pytest.fixture(autouse=True)
def _short_linger(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have requests withdrawn soon after the last client has left."""
    monkeypatch.setattr(shared, "LINGER_S", 0.4)


@contextmanager
def filming(broker: Broker, *, fps: float = 15, **video: Any) -> Iterator[PictureRobot]:
    robot = PictureRobot({**VIDEO, **video}, fps=fps, size=(160, 120), transport=client(broker))
    try:
        yield robot
    finally:
        robot.close()


def nal_types(unit: bytes) -> list[int]:
    return [byte[0] & 31 for byte in _nal_types(unit)]


def test_h264_is_requested_while_a_client_subscribes_and_passed_on_as_foxglove_expects_it(broker: Broker) -> None:
    with filming(broker, fps=30) as robot, live(broker) as server:
        watcher = Watcher(server.address)
        assert until(lambda: {H264, JPEG} <= set(watcher.channels))
        assert robot.requests == []
        watcher.subscribe(H264)
        assert until(lambda: watcher.count(H264) >= 40)
        assert robot.requests[0] == REQUESTED
        watcher.unsubscribe(H264)
        assert until(lambda: robot.requests[-1] == WITHDRAWN and robot.flags == [True, False])
        assert watcher.statuses == []
    videos = watcher.of(H264)
    assert {(video.format, video.frame_id) for video in videos} == {("h264", "goob")}
    units = [video.data for video in videos]
    assert all(unit.startswith(b"\x00\x00\x00\x01") for unit in units)
    assert [5 in nal_types(unit) for unit in units] == [{5, 7, 8} <= set(nal_types(unit)) for unit in units]
    assert 31 not in {kind for unit in units for kind in nal_types(unit)}  # the seal is ours
    stamps = [video.timestamp.ToMilliseconds() for video in videos]
    assert stamps == sorted(stamps)
    assert all(
        0 <= message.at_ns / 1e6 - stamp < 10_000 for message, stamp in zip(watcher.messages, stamps, strict=True)
    )


def test_a_client_that_comes_later_begins_with_a_key_frame_and_sees_why_there_are_no_pictures(broker: Broker) -> None:
    with filming(broker) as robot, live(broker) as server:
        first, second = Watcher(server.address), Watcher(server.address)
        first.subscribe(H264)
        assert until(lambda: first.count(H264) >= 5)
        second.subscribe(H264)
        assert until(lambda: any(5 in nal_types(video.data) for video in second.of(H264)))
        assert {**REQUESTED, "keyframe": True} in robot.requests
        robot.transport.publish(CAPABILITIES, capabilities({**VIDEO, "available": False}), retain=True)
        assert until(lambda: second.statuses)
        assert second.statuses[0]["message"] == f"{CAMERA}: it has no camera"
        assert until(lambda: robot.requests[-1] == WITHDRAWN)


def test_pictures_become_jpegs(broker: Broker) -> None:
    with filming(broker, encoding="json") as robot, live(broker) as server:
        watcher = Watcher(server.address)
        watcher.subscribe(JPEG)
        assert until(lambda: watcher.count(JPEG) >= 12)
        assert robot.requests[0] == {"enabled": True}  # as configured: what others see of it does not change
    images = watcher.of(JPEG)
    assert {(image.format, image.frame_id) for image in images} == {("jpeg", "goob")}
    pictures = [cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR) for image in images]
    numbers = [read_counter(np.asarray(picture, np.uint8)) for picture in pictures]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_a_signal_withdraws_the_requests(broker: Broker) -> None:
    with filming(broker) as robot:
        server = Live(broker)
        watcher = Watcher(server.address)
        watcher.subscribe(H264)
        assert until(lambda: watcher.count(H264))
        code, errors = server.end(signal.SIGTERM)
        assert (code, errors.splitlines()[1:]) == (0, [])
        assert errors.startswith("Showed 1 robot in ")
        assert until(lambda: robot.requests[-1] == WITHDRAWN and robot.flags == [True, False])
        assert until(lambda: watcher.closed)


def test_sound_becomes_samples(broker: Broker) -> None:
    robot = SoundRobot({**AUDIO, "encoding": "opus"}, transport=client(broker))
    try:
        with live(broker) as server:
            watcher = Watcher(server.address)
            watcher.subscribe(SAMPLES)
            assert until(lambda: watcher.count(SAMPLES) >= 50)
            watcher.unsubscribe(SAMPLES)
            assert until(lambda: robot.requests[-1] == WITHDRAWN)
            assert robot.requests[0] == {"enabled": True}
        blocks = watcher.of(SAMPLES)
        assert {(one.format, one.number_of_channels) for one in blocks} == {("pcm-s16", 1)}
        samples = np.frombuffer(b"".join(one.data for one in blocks), np.int16)
        assert len(samples) == pytest.approx(len(blocks) * blocks[0].sample_rate / 50, rel=0.1)
        assert np.abs(samples).max() > 1000
    finally:
        robot.close()


# -- Foxglove's own client, @foxglove/ws-protocol


def watch(address: str, topic: str, count: int) -> dict[str, Any]:
    package("@foxglove/ws-protocol")
    watcher = Watcher(address)
    assert until(lambda: topic in watcher.channels)
    watcher.close()
    command = ["node", str(Path(__file__).with_name("client.cjs")), address, topic, str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_it_sees_compressed_video(broker: Broker) -> None:
    with filming(broker) as robot, live(broker) as server:
        found = watch(server.address, H264, 20)
        assert until(lambda: robot.requests[-1] == WITHDRAWN)
    assert {H264, JPEG} <= set(found["topics"])
    assert (found["info"]["name"], found["info"]["capabilities"]) == ("Pebble", [])
    kind = parser(found["channel"])
    videos = [kind.FromString(base64.b64decode(message["data"])) for message in found["messages"]]
    assert {5, 7, 8} <= set(nal_types(videos[0].data))
    assert all(abs(int(message["at"]) / 1e9 - time.time()) < 60 for message in found["messages"])


# -- what waits for conversion is bounded, and what does not fit is counted


ROBOT = RobotView(REF)
ROBOT.capabilities = {"video": VIDEO, "audio": AUDIO}


def pictures(count: int, keyframe_interval: int = 10) -> list[bytes]:
    encoder = make_encoder("h264", fps=15, quality=40, keyframe_interval=keyframe_interval)
    scene, made = Scene(160, 120), np.empty((120, 160, 3), np.uint8)
    payloads = []
    for number in range(count):
        scene.render(number, made)
        payloads.append(encoder.encode(made, 1_790_000_000_000 + number * 66))
    return payloads


def feed(medium: str, payloads: list[bytes]) -> MediaFeed:
    """Payloads that come while the conversion does not get on."""

    async def fed() -> MediaFeed:
        server = Server("test", lambda _topic, _on: None)
        feed = MediaFeed(broker_on(MemoryHub()), server, Schemas(), ROBOT, medium)  # type: ignore[arg-type]
        for payload in payloads:
            feed.receive(payload)
        return feed

    return asyncio.run(fed())


def test_the_oldest_is_dropped_for_the_newest() -> None:
    found = feed("audio", [PBAT + bytes([number % 256]) for number in range(MAX_WAITING + 7)])
    assert found.dropped == 7
    assert found.waiting[0].payload == PBAT + b"\x07"
    large = bytes(PBAT) + bytes(MAX_PAYLOAD - 10)
    found = feed("audio", [large] * 5)
    assert found.dropped == 3
    assert sum(len(one.payload) for one in found.waiting) <= MAX_WAITING_BYTES


def test_pictures_that_build_on_a_dropped_one_go_with_it() -> None:
    (first, *differences) = pictures(MAX_WAITING + 5, keyframe_interval=1000)
    found = feed("video", [first, *differences])
    assert found.dropped == MAX_WAITING + 1
    assert [one.complete for one in found.waiting] == [False] * 4
    assert found.wants_keyframe


def test_without_pyav_nothing_is_requested_that_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    video, audio = feed("video", []), feed("audio", [])
    video.update()
    audio.update()
    assert (video.encoding(), audio.encoding()) == (None, None)
    monkeypatch.setitem(sys.modules, "av", None)
    assert (video.encoding(), audio.encoding()) == ("pbvd", "pcm")


def test_what_is_nothing_of_this_medium_or_too_large_is_refused() -> None:
    assert feed("audio", [b"noise", PBAT + bytes(MAX_PAYLOAD)]).refused == 2
    assert feed("video", [b"noise", b"", PBAT]).refused == 3


def test_after_a_missing_picture_none_is_passed_on_until_the_next_key_frame() -> None:
    sent = pictures(40)
    found = feed("video", [*sent[:3], *sent[4:]])
    complete = [one.complete for one in found.waiting]
    assert complete[:4] == [True, True, True, False]
    assert complete[4:] == sorted(complete[4:])  # from the key frame on all of them
    assert complete[-1]
    assert [len(found._converters(one)) - 1 for one in found.waiting] == complete  # as video, too


def test_a_message_that_is_too_large_is_dropped_and_counted() -> None:
    server = Server("test", lambda _topic, _on: None)
    server.declare(ChannelSpec("a", "json", "pebble.Any", "jsonschema", b""))
    server.publish("a", bytes(MAX_BYTES), 1)
    server.publish("a", bytes(MAX_BYTES + 1), 1)
    server.publish("b", b"{}", 1)
    assert (server.published, server.dropped) == (1, 2)


def test_the_channels_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.extensions.foxglove.server.MOST_CHANNELS", 2)
    server = Server("test", lambda _topic, _on: None)
    for topic in "abc":
        server.declare(ChannelSpec(topic, "json", "pebble.Any", "jsonschema", b""))
        server.publish(topic, b"{}", 1)
    assert (server.declared("b"), server.declared("c"), server.dropped) == (True, False, 1)
