"""Pictures and sound of a whole robot, requested by an operator over MQTT with the original Pebble's messages."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import pairwise, product
from typing import Any

import pytest

from pebble.extensions.media.decode import Decoded, VideoDecoder
from pebble.extensions.media.sound import SoundDecoder
from pebble.extensions.media.video import VIDEO_ENCODINGS
from tests.kit.scene import read_counter
from tests.robot.operator import ReceivedMessage
from tests.robot.rig import DEVICES, Rig
from tests.support import further, until

pytestmark = pytest.mark.alone  # deadlines are checked

CAMERA, AUDIO = "outgoing/front-camera", "outgoing/audio"
VIDEO_FLAG, AUDIO_FLAG = "incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"
ASK_VIDEO, ASK_AUDIO = "incoming/front-camera", "incoming/audio"


@pytest.fixture(scope="module", params=["mqtt", "zenoh", further("single")])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with Rig(request.param, av_daemon=DEVICES) as rig:
        yield rig


#: For what does not ask whether there are one broker or two.
two_kinds = pytest.mark.parametrize("rig", ["mqtt", "zenoh"], indirect=True)


@pytest.fixture(autouse=True)
def _quiet(rig: Rig) -> Iterator[None]:
    """Every test ends with no request, no running media process and no media messages."""
    yield
    for ask, flag in ((ASK_VIDEO, VIDEO_FLAG), (ASK_AUDIO, AUDIO_FLAG)):
        rig.operator.send(ask, {"enabled": False})
        rig.operator.send(flag, {"value": False}, retain=True)
    assert until(lambda: not media_programs(rig), 15)


def media_programs(rig: Rig) -> set[str]:
    return {"camera_publisher", "audio_publisher", "audio_receiver"} & set(rig.processes())


def shown(seen: list[ReceivedMessage]) -> list[Decoded]:
    """The pictures that may be shown."""
    decoder = VideoDecoder()
    return [picture for one in seen if (picture := decoder.feed(one.payload)) is not None]


def counters(seen: list[ReceivedMessage]) -> list[int]:
    """The frame counters in these pictures."""
    return [counter for one in shown(seen) if (counter := read_counter(one.picture)) is not None]


def pictures_come(rig: Rig, since: float, timeout: float = 15.0) -> bool:
    return until(lambda: len(counters(rig.operator.on(CAMERA, since))) > 3, timeout, step=0.1)


def want_video(rig: Rig, **more: Any) -> float:
    began = time.monotonic()
    rig.operator.send(VIDEO_FLAG, {"value": True}, retain=True)
    rig.operator.send(ASK_VIDEO, {"enabled": True, **more})
    return began


@pytest.mark.parametrize(
    ("rig", "encoding"),
    [
        *product(["zenoh"], ["json", "pbvd", "h264", "nonsense"]),
        ("mqtt", "h264"),
        *(further("mqtt", encoding) for encoding in ("json", "pbvd", "nonsense")),
    ],
    indirect=["rig"],
)
def test_pictures_in_every_encoding_advance_with_the_camera(rig: Rig, encoding: str) -> None:
    began = want_video(rig, encoding=encoding)
    assert until(lambda: len(rig.operator.on(CAMERA, began)) > 10, 15)
    seen = rig.operator.on(CAMERA, began)
    assert {one.encoding for one in shown(seen)} == {encoding if encoding in VIDEO_ENCODINGS else "json"}
    assert len(counters(seen)) > 8
    assert counters(seen) == sorted(set(counters(seen)))


@pytest.mark.parametrize(
    ("rig", "encoding"),
    [("mqtt", "opus"), ("zenoh", "pcm"), further("mqtt", "pcm"), further("zenoh", "opus")],
    indirect=["rig"],
)
def test_sound_in_every_encoding(rig: Rig, encoding: str) -> None:
    began = time.monotonic()
    rig.operator.send(AUDIO_FLAG, {"value": True}, retain=True)
    rig.operator.send(ASK_AUDIO, {"enabled": True, "encoding": encoding})
    assert until(lambda: len(rig.operator.on(AUDIO, began)) > 20, 15)
    assert media_programs(rig) == {"audio_publisher", "audio_receiver"}
    decoder = SoundDecoder()
    received = [decoder.feed(one.payload) for one in rig.operator.on(AUDIO, began)]
    assert all(one is not None for one in received)
    assert {one.encoding for one in received[-5:] if one is not None} == {encoding}


@two_kinds
def test_stopping_media_does_not_delay_driving(rig: Rig) -> None:
    began = want_video(rig)
    rig.operator.send(AUDIO_FLAG, True, retain=True)
    rig.operator.send(ASK_AUDIO, True)
    assert pictures_come(rig, began)
    drive_from = time.monotonic()
    for number in range(40):
        rig.operator.send("incoming/drive-values", {"x": 0, "z": round(0.1 + number / 100, 3)}, qos=0)
        if number == 10:
            rig.operator.send(VIDEO_FLAG, False, retain=True)
            rig.operator.send(AUDIO_FLAG, False, retain=True)
        time.sleep(0.05)
    moves = [at for at, wheels in rig.mcu.drives(drive_from) if wheels != (0.0, 0.0)]
    assert len(moves) > 35
    assert max(later - earlier for earlier, later in pairwise(moves)) < 0.5
