"""The mirror read by Debian's own ``shmsrc``, and our stand-in for that fed by Debian's own ``shmsink``."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.services.autonomy_manager.needs import SHMSRC
from pebble.services.autonomy_manager.pythons import SYSTEM, probe
from pebble.transports.segments import SHM
from tests.kit.shm_reader import connected
from tests.services.gstreamer_mirror.mirror_rig import (
    HEIGHT,
    WIDTH,
    Camera,
    Microphone,
    Mirror,
    needs_gstreamer,
    picture_reader,
    sound_reader,
)
from tests.support import Broker, Child, until

pytestmark = [needs_gstreamer, pytest.mark.thorough]


@pytest.fixture
def mirror(local: Broker) -> Iterator[Mirror]:
    with Mirror(local.port) as mirror:
        assert until(mirror.video.exists)
        yield mirror


def whole(frames: list[bytes]) -> bool:
    """Whether each picture has one number throughout, and none comes twice."""
    assert all(frame == frame[:1] * len(frame) for frame in frames)
    return all(before != after for before, after in pairwise(frames))


@pytest.mark.parametrize("there", [True, False])
def test_a_missing_plugin_is_known_without_running_a_script(tmp_path: Path, there: bool) -> None:
    variables = {} if there else {"GST_PLUGIN_SYSTEM_PATH_1_0": str(tmp_path)}
    missing, path = probe(
        str(SYSTEM[0]), [SHMSRC], tmp_path, {"GST_REGISTRY_1_0": str(tmp_path / "registry"), **variables}
    )
    assert missing == [SHMSRC][there:]
    assert any("gstreamer-1.0" in place for place in path) == there, "to be asked again once it is installed"


def test_our_stand_in_reads_what_debians_writer_sends(tmp_path: Path) -> None:
    path, size = tmp_path / "v.sock", 3 * WIDTH * HEIGHT
    caps = f"video/x-raw,format=BGR,width={WIDTH},height={HEIGHT},framerate=30/1"
    sink = ["shmsink", f"socket-path={path}", f"shm-size={16 << 20}", "wait-for-connection=false", "sync=false"]
    source = ["videotestsrc", "is-live=true", "pattern=blue", "!", caps]
    writer = Child(["gst-launch-1.0", "-q", *source, "!", *sink], stderr=subprocess.DEVNULL)
    try:
        with connected(path) as reader:
            for _ in range(40):  # more than fit: it goes on because they are acknowledged
                assert reader.read() == bytes([255, 0, 0]) * (size // 3)
    finally:
        writer.kill()
        writer.wait(10)
        for left in SHM.glob(f"shmpipe.{writer.pid:5}.*"):  # it leaves that even when it ends regularly
            left.unlink()


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (161, 90), (162, 91)], ids=str)
def test_pictures_also_of_widths_whose_rows_are_padded(local: Broker, size: tuple[int, int]) -> None:
    width, height = size
    with Mirror(local.port, width=width, height=height) as mirror, Camera(mirror.config.run_dir(), size=size):
        assert until(mirror.video.exists)
        with picture_reader(mirror.video, width, height) as reader:
            assert reader.gets(20)
            stride = -(-3 * width // 4) * 4
            rows = [frame[at : at + 3 * width] for frame in reader.frames for at in range(0, len(frame), stride)]
            assert all(row == row[:1] * (3 * width) for row in rows)


def test_turned_pictures_have_the_other_size(local: Broker) -> None:
    turned = (HEIGHT, WIDTH)
    with Mirror(local.port, rotate_degrees=90) as mirror, Camera(mirror.config.run_dir(), size=turned):
        assert until(mirror.video.exists)
        with picture_reader(mirror.video, *turned) as reader:
            assert reader.gets(5)
            assert whole(reader.frames)


def test_sound(mirror: Mirror) -> None:
    with Microphone(mirror.config.run_dir()), sound_reader(mirror.audio) as reader:
        assert reader.gets(50)
        samples = b"".join(reader.frames)
        first = int.from_bytes(samples[:2], "little")
        assert samples == b"".join(((first + at) % 65536).to_bytes(2, "little") for at in range(len(samples) // 2))


def test_one_of_three_stops_and_one_is_killed(mirror: Mirror) -> None:
    with (
        Camera(mirror.config.run_dir()),
        picture_reader(mirror.video) as reader,
        picture_reader(mirror.video) as stopped,
        picture_reader(mirror.video) as killed,
    ):
        assert reader.gets(5)
        assert stopped.gets(5)
        assert killed.gets(5)
        os.kill(stopped.process.pid, signal.SIGSTOP)
        assert reader.gets(60)
        killed.process.kill()
        assert reader.gets(60)
        assert until(lambda: mirror.newest().readers == 2)
        os.kill(stopped.process.pid, signal.SIGCONT)
        assert stopped.gets(20), "it goes on where it stopped"
        for one in (reader, stopped, killed):
            assert whole(one.frames)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM], ids=lambda how: how.name)
def test_readers_end_with_the_mirror_as_with_the_original(mirror: Mirror, how: signal.Signals) -> None:
    with Camera(mirror.config.run_dir()), picture_reader(mirror.video) as reader:
        assert reader.gets(5)
        mirror.process.end(how)
        assert until(lambda: reader.process.poll() is not None), "its pipeline reports an error: scripts open it again"
        mirror.start()
        with connected(mirror.video), picture_reader(mirror.video) as again:
            assert again.gets(5)


def test_a_reader_waits_while_the_camera_pauses(mirror: Mirror) -> None:
    with Camera(mirror.config.run_dir()) as camera, picture_reader(mirror.video) as reader:
        assert reader.gets(5)
        camera.pausing.set()
        assert until(lambda: "no frame from the camera" in (mirror.newest().last_error or ""))
        camera.pausing.clear()
        assert reader.gets(5)
