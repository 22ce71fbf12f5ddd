"""The mirror's process, read by a stand-in for shmsrc: what it offers, refuses and reports, and how it ends."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from tests.kit.shm_reader import ShmReader, connected
from tests.services.gstreamer_mirror.mirror_rig import CHUNK, HEIGHT, WIDTH, Camera, Microphone, Mirror
from tests.support import Broker, until


@pytest.fixture
def mirror(local: Broker) -> Iterator[Mirror]:
    with Mirror(local.port) as mirror:
        yield mirror


def numbers(reader: ShmReader, count: int) -> list[int]:
    """The numbers of the next pictures, each of which is whole."""
    found = []
    for _ in range(count):
        data = reader.read(15)
        assert data is not None
        assert data == data[:1] * (3 * WIDTH * HEIGHT)
        found.append(data[0])
    return found


def ended(reader: ShmReader) -> bool:
    """Read what is left, and whether the writer is gone."""
    try:
        reader.read(0.1)
    except (EOFError, BrokenPipeError):  # what is read last, or acknowledged last
        return True
    return False


def test_pictures_and_sound_while_they_are_read(mirror: Mirror) -> None:
    with Camera(mirror.config.run_dir()) as camera, Microphone(mirror.config.run_dir()) as microphone:
        with connected(mirror.video) as pictures, connected(mirror.audio) as sound:
            found = numbers(pictures, 10)
            steps = [(after - before) % 251 for before, after in pairwise(found)]
            assert min(steps) > 0, "none twice, none late"
            pieces = [sound.read(15) or b"" for _ in range(10)]
            assert {len(piece) for piece in pieces} == {2 * CHUNK}
            samples = b"".join(pieces)
            first = int.from_bytes(samples[:2], "little")
            assert samples == b"".join(((first + at) % 65536).to_bytes(2, "little") for at in range(10 * CHUNK))
            assert until(lambda: (mirror.newest().readers, mirror.newest("audio").readers) == (1, 1))
            assert (mirror.newest().width, mirror.newest().encoding) == (WIDTH, "bgr24")
        assert until(lambda: camera.writer.readers == microphone.writer.readers == 0), "unread, the devices rest"
        assert until(lambda: mirror.newest().readers == 0)
        assert mirror.newest().doing == f"rests: no program reads {mirror.video}"


def test_pictures_of_another_size_are_not_sent_until_they_are_right(mirror: Mirror) -> None:
    with Camera(mirror.config.run_dir()) as camera, connected(mirror.video) as reader:
        numbers(reader, 3)
        camera.size = (WIDTH // 2, HEIGHT)
        assert until(lambda: mirror.newest().last_error is not None)
        assert mirror.newest().last_error == (
            f"the camera sends {WIDTH // 2}x{HEIGHT}, and readers expect {WIDTH}x{HEIGHT}: nothing is shown"
        )
        while reader.read(0.3) is not None:
            pass
        camera.size = (WIDTH, HEIGHT)
        numbers(reader, 3)
        assert until(lambda: mirror.newest().last_error is None)


def test_sound_of_another_rate_is_not_sent(mirror: Mirror) -> None:
    with Microphone(mirror.config.run_dir()) as microphone, connected(mirror.audio) as reader:
        microphone.rate = 48_000
        assert until(lambda: "microphone sends s16le 48000 Hz" in (mirror.newest("audio").last_error or ""))
        assert reader.read(0.1) is None


def test_readers_wait_while_the_camera_pauses(mirror: Mirror) -> None:
    with Camera(mirror.config.run_dir()) as camera, connected(mirror.video) as reader:
        numbers(reader, 3)
        camera.pausing.set()
        assert until(lambda: "no frame from the camera" in (mirror.newest().last_error or ""))
        with connected(mirror.video):
            assert until(lambda: mirror.newest().readers == 2), "one that connects meanwhile waits, too"
        camera.pausing.clear()
        numbers(reader, 3)


def test_after_a_kill_readers_end_and_find_the_next_one(mirror: Mirror) -> None:
    with Camera(mirror.config.run_dir()):
        with connected(mirror.video) as reader:
            numbers(reader, 3)
            mirror.process.end(signal.SIGKILL)
            assert until(lambda: ended(reader))
            assert mirror.video.exists(), "which refuses connections"
            assert reader.segment.exists()
        began = time.monotonic()
        mirror.start()
        with connected(mirror.video) as again:
            numbers(again, 3)
            assert not reader.segment.exists(), "what the killed one left is removed"
        assert time.monotonic() - began < 30


def test_what_cannot_be_offered_is_reported_and_tried_again(local: Broker, tmp_path: Path) -> None:
    folder = tmp_path / "later"
    with Mirror(local.port, socket_path=str(folder / "v.sock")) as mirror:
        assert until(lambda: "make the folder" in (mirror.newest().last_error or ""))
        assert (mirror.newest().running, mirror.newest("audio").running) == (False, True)
        folder.mkdir()
        other = socket.socket(socket.AF_UNIX)
        other.bind(os.fspath(folder / "v.sock"))
        other.listen()
        assert until(lambda: "another program serves" in (mirror.newest().last_error or ""))
        other.close()
        assert until(lambda: mirror.newest().running)
        connected(folder / "v.sock")


def test_sockets_that_were_removed_are_made_again_and_none_is_left_at_the_end(mirror: Mirror) -> None:
    with Camera(mirror.config.run_dir()):
        with connected(mirror.video) as reader:
            numbers(reader, 3)
            mirror.video.unlink()
            assert until(mirror.video.exists)
        with connected(mirror.video) as again:
            numbers(again, 3)
            mirror.process.end()
            assert not again.segment.exists()
        assert not mirror.video.exists()
        assert not mirror.audio.exists()
