"""What waits for conversion is bounded, and what does not fit is counted."""

from __future__ import annotations

import asyncio
import sys

import numpy as np
import pytest

from pebble.extensions.foxglove.media_feed import MAX_WAITING, MAX_WAITING_BYTES, MediaFeed
from pebble.extensions.foxglove.server import MAX_BYTES, ChannelSpec, Server
from pebble.extensions.media.packets import PBAT
from pebble.extensions.media.picture_header import MAX_PAYLOAD
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.video import make_encoder
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.recordings.exports.foxglove_messages import Schemas
from pebble.transports.memory import MemoryHub
from tests.ext.page.media.robots import AUDIO, REF, VIDEO, broker_on

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


async def _feed(medium: str, payloads: list[bytes]) -> MediaFeed:
    """Payloads that come while the conversion does not get on."""
    broker = broker_on(MemoryHub())
    feed = MediaFeed(broker, Server("test", lambda _topic, _on: None), Schemas(), ROBOT, medium)  # type: ignore[arg-type]
    for payload in payloads:
        feed.receive(payload)
    return feed


def feed(medium: str, payloads: list[bytes]) -> MediaFeed:
    return asyncio.run(_feed(medium, payloads))


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
