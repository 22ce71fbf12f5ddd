"""A whole robot's pictures and sound, requested over MQTT with the original Pebble's messages; and its recorder."""

from __future__ import annotations

import re
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.recordings import library
from tests.kit.scene import read_counter
from tests.robot.operator import ReceivedMessage
from tests.robot.rig import BASE, DEVICES, Rig
from tests.support import further, until

pytestmark = pytest.mark.alone  # deadlines are checked

CAMERA, AUDIO = "outgoing/front-camera", "outgoing/audio"
VIDEO_FLAG, AUDIO_FLAG = "incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"
MEDIA = {"camera_publisher", "audio_publisher", "audio_receiver"}
ASK_VIDEO, ASK_AUDIO = "incoming/front-camera", "incoming/audio"
SEGMENT = re.compile(r"/dev/shm/\d+\.zenoh")


def counters(seen: list[ReceivedMessage]) -> list[int]:
    """The frame counters in these pictures."""
    decoder = VideoDecoder()
    pictures = [picture for one in seen if (picture := decoder.feed(one.payload)) is not None]
    return [counter for one in pictures if (counter := read_counter(one.picture)) is not None]


def segments_of(rig: Rig) -> set[str]:
    mapped = [Path(f"/proc/{pid}/maps").read_text() for pid in rig.processes().values()]
    return {path for one in mapped for path in SEGMENT.findall(one)}


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_stopping_media_does_not_delay_driving_and_leaves_no_shared_memory(kind: str) -> None:
    with Rig(kind, av_daemon=DEVICES) as rig:
        began = time.monotonic()
        for ask, flag in ((ASK_VIDEO, VIDEO_FLAG), (ASK_AUDIO, AUDIO_FLAG)):
            rig.operator.send(flag, True, retain=True)
            rig.operator.send(ask, True)
        assert until(lambda: len(counters(rig.operator.on(CAMERA, began))) > 3, step=0.1)
        assert until(lambda: len(rig.operator.on(AUDIO, began)) > 20)
        assert rig.processes().keys() >= MEDIA
        assert until(lambda: len(segments_of(rig)) >= 2)
        used = segments_of(rig)
        drive_from = time.monotonic()
        for number in range(40):
            rig.operator.send("incoming/drive-values", {"x": 0, "z": round(0.1 + number / 100, 3)}, qos=0)
            if number == 10:
                rig.operator.send(VIDEO_FLAG, False, retain=True)
                rig.operator.send(AUDIO_FLAG, False, retain=True)
            time.sleep(0.05)
        moves = [at for at, wheels in rig.mcu.drives(drive_from) if wheels != (0.0, 0.0)]
        assert len(moves) > 10  # of 40: the newest counts, and a busy machine skips some
        assert max(later - earlier for earlier, later in pairwise(moves)) < 1.0
        assert until(lambda: not MEDIA & rig.processes().keys())
        assert rig.stop() == 0
    assert [path for path in used if Path(path).exists()] == []


def counted(folder: Path) -> Counter[tuple[str, str]]:
    """Messages by topic and connection."""
    if not list(folder.rglob("*.mcap*")):
        return Counter()
    found = library.merged(library.files([folder]))
    return Counter((message.channel.topic, message.channel.metadata.get("source", "")) for message in found)


@pytest.mark.parametrize("kind", [further("mqtt"), "zenoh"])
def test_what_a_robot_publishes_is_recorded_on_it(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    section = {"enabled": True, "folder": str(folder), "free_bytes": 0, "remote": True}
    with Rig(kind, recorder=section) as rig:
        assert until(lambda: counted(folder)[f"{BASE}/outgoing/online", "remote"] > 2)  # it reads what is written
        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.1})
        assert until(lambda: rig.mcu.turning())
        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0})
        assert until(lambda: not rig.mcu.turning())
        for topic, source, least in (
            ("incoming/drive-values", "remote", 2),
            ("incoming/drive-values", "", 2),
            ("outgoing/status", "", 1),
        ):
            assert until(lambda: counted(folder)[f"{BASE}/{topic}", source] >= least), (topic, source)  # noqa: B023
        assert rig.stop() == 0
        assert "Traceback" not in rig.log.read_text()
    assert not list(folder.rglob("*.active"))
