"""Frames between real processes: readers get the newest, and no process disturbs another."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pebble.errors import TransportError
from pebble.extensions.media.frames import FrameInfo, FrameReader, FrameWriter, memory
from pebble.extensions.media.frames import reader as frame_reader
from pebble.extensions.media.frames.frame import encode
from pebble.extensions.media.frames.session import METADATA, StreamNames, open_writing
from pebble.transports import segments
from pebble.transports.peers import prepare_run_dir
from pebble.transports.segments import SHM
from tests.locking import needs_shared_memory
from tests.support import WAIT_S, needs_root, until
from tests.transports.forked import Forked

SMALL = 160 * 120 * 3  # to be shared all the same
QVGA = 320 * 240 * 3  # a pool of these fits into the 8 MiB that users may usually lock
UNPRIVILEGED_USER = os.geteuid() or 65534  # root may lock what it likes; for others the limits count


class Peer(Forked):
    """One process; `ask` for its numbers."""

    def __init__(self, role: str, folder: Path, options: dict[str, Any]) -> None:
        super().__init__("tests.ext.media.frames.frames_peer", role, folder, options)
        assert self.stdout.readline() == "up\n"

    def ask(self) -> dict[str, Any]:
        self.stdin.write("?\n")
        self.stdin.flush()
        answer: dict[str, Any] = json.loads(self.stdout.readline())
        return answer

    def reaches(self, condition: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Ask until ``condition`` is true for an answer, and return that."""
        answers: list[dict[str, Any]] = [{}]

        def asked() -> object:
            answers.append(self.ask())
            return condition(answers[-1])

        assert until(asked, step=0.02), answers[-1]
        return answers[-1]

    def has(self, **least: int) -> dict[str, Any]:
        """Ask until every number is at least as given."""
        return self.reaches(lambda answer: all(answer.get(name, 0) >= number for name, number in least.items()))

    def end(self) -> None:
        self.kill()
        self.wait(WAIT_S)
        for pipe in (self.stdin, self.stdout):
            with suppress(BrokenPipeError):
                pipe.close()


class FramesNet(ExitStack):
    """A run directory and its peers, which end with it."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        folder.mkdir(mode=0o700, exist_ok=True)

    def start(self, role: str, **options: Any) -> Peer:
        peer = Peer(role, self.folder, options)
        self.callback(peer.end)
        return peer


@pytest.fixture
def net(tmp_path: Path) -> Iterator[FramesNet]:
    with FramesNet(tmp_path / "run") as net:
        yield net


def test_a_slow_reader_gets_the_newest(tmp_path: Path) -> None:
    with FrameWriter(tmp_path, "camera", capacity=60_000) as writer, FrameReader(tmp_path, "camera") as reader:
        assert until(lambda: writer.wanted)
        for number in range(10):
            assert writer.write(bytes([number]) * 640, FrameInfo())
        assert until(lambda: reader.counters["received"] == 10)
        frame = reader.read(WAIT_S)
        assert frame is not None
        assert (frame.data[0], reader.counters["skipped"]) == (9, 9)


def test_a_deep_reader_gets_them_all_in_order_and_small_frames_travel_as_bytes(tmp_path: Path) -> None:
    with FrameWriter(tmp_path, "camera", capacity=640) as writer, FrameReader(tmp_path, "camera", depth=100) as reader:
        assert until(lambda: writer.wanted)
        for number in range(100):
            assert writer.write(bytes([number]) * 640, FrameInfo())
        frames = [reader.read(WAIT_S) for _ in range(100)]
        assert [frame is not None and (frame.data[0], frame.shared) for frame in frames] == [
            (number, False) for number in range(100)
        ]
        assert (reader.problem, writer.shared, writer.problem, writer.counters["fallbacks"]) == ("", False, "", 0)


def test_readers_and_writers_that_are_killed_are_noticed_and_their_segments_swept(net: FramesNet) -> None:
    writer = net.start("writer", size=SMALL)
    resting = writer.has(unwanted=10)
    assert (resting["wanted"], resting.get("written", 0)) == (False, 0)
    readers = [net.start("reader"), net.start("reader", views=True)]

    def all_receive(life: int) -> None:
        for reader in readers:
            before = reader.ask().get("frames", 0)
            reader.reaches(lambda seen, before=before: seen["frames"] > before)
            assert (reader.ask()["writers"], reader.ask()["wrong"]) == (life, 0)

    all_receive(1)
    writer.end()
    writer = net.start("writer", size=SMALL)
    all_receive(2)
    assert len(StreamNames(net.folder, "camera").lock_paths()) == 1, "that of the killed writer is gone"
    maps = [line for peer in (writer, *readers) for line in Path(f"/proc/{peer.pid}/maps").read_text().splitlines()]
    used = {SHM / Path(line.split()[5]).name for line in maps if ".zenoh" in line}
    assert len(used) >= 2
    for reader in readers:
        reader.end()
    writer.reaches(lambda printed: not printed["wanted"])
    writer.end()
    assert until(lambda: segments.sweep() >= 0 and not any(path.exists() for path in used))


def test_there_is_one_writer_at_a_time(tmp_path: Path) -> None:
    with FrameWriter(tmp_path, "camera", capacity=1000):
        with pytest.raises(TransportError, match=r"frames-camera\.sock"):
            FrameWriter(tmp_path, "camera", capacity=1000).open()
        with FrameWriter(tmp_path, "microphone", capacity=1000):
            pass
    with FrameWriter(tmp_path, "camera", capacity=1000) as writer:
        assert (writer.write(b"nobody reads it", FrameInfo()), writer.counters["unwanted"]) == (False, 1)


@pytest.fixture
def unprivileged_net() -> Iterator[FramesNet]:
    """A run directory of a user whose limits count."""
    folder = Path(tempfile.mkdtemp(prefix="pebble-frames-"))  # pytest's own folders are closed to others
    os.chown(folder, UNPRIVILEGED_USER, -1)
    with FramesNet(folder) as net:
        yield net
    shutil.rmtree(folder)


def test_a_reader_without_shared_memory_gets_bytes_and_reports_it(unprivileged_net: FramesNet) -> None:
    poor = unprivileged_net.start("reader", memlock=64 << 10, user=UNPRIVILEGED_USER)
    rich = unprivileged_net.start("reader", user=UNPRIVILEGED_USER)
    writer = unprivileged_net.start("writer", size=QVGA, user=UNPRIVILEGED_USER)
    seen = poor.has(frames=20, copied=20)
    assert "LimitMEMLOCK=" in seen["problem"]
    assert (seen["wrong"], seen.get("shared", 0)) == (0, 0)
    seen = rich.has(frames=20, shared=20)
    assert (seen["wrong"], seen["problem"]) == (0, "")
    assert writer.ask()["sharing"]


def test_a_process_that_ends_with_an_open_writer_or_reader_ends(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from pebble.extensions.media.frames import *\n"
        "folder = Path(sys.argv[1]); w = FrameWriter(folder, 'camera', capacity=1 << 20).open()\n"
        "r = FrameReader(folder, 'camera').open(); r.read(0.2); raise SystemExit(3)"
    )
    assert subprocess.run([sys.executable, "-c", program, str(tmp_path)], timeout=WAIT_S, check=False).returncode == 3


def test_a_fork_of_a_writer_or_reader_may_not_use_it(tmp_path: Path) -> None:
    program = (
        "import os, sys; from pathlib import Path; from pebble.errors import TransportError\n"
        "from pebble.extensions.media.frames import *\n"
        "folder = Path(sys.argv[1]); w = FrameWriter(folder, 'camera', capacity=1 << 20).open()\n"
        "r = FrameReader(folder, 'camera').open()\n"
        "if os.fork():\n"
        "    sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))\n"
        "refused = 0\n"
        "for use in (lambda: w.write(b'x', FrameInfo()), lambda: r.read(0.1), FrameReader(folder, 'camera').open):\n"
        "    try: use()\n"
        "    except TransportError: refused += 1\n"
        "w.close(); r.close(); os._exit(refused)"
    )
    assert subprocess.run([sys.executable, "-c", program, str(tmp_path)], timeout=WAIT_S, check=False).returncode == 3


@needs_shared_memory
def test_both_can_be_opened_again(tmp_path: Path) -> None:
    writer, reader = FrameWriter(tmp_path, "camera", capacity=50_000), FrameReader(tmp_path, "camera")
    for number in (1, 2, 3):
        with writer, reader:
            assert until(lambda: writer.wanted)
            assert writer.write(b"x" * 50_000, FrameInfo())
            frame = reader.read(WAIT_S)
            assert frame is not None
            assert (frame.info.sequence, frame.shared, reader.counters["writers"]) == (1, True, number)
        assert not writer.wanted
        assert not writer.write(b"x", FrameInfo())
        assert reader.read() is None
        reader.close()
    assert list(tmp_path.iterdir()) == []


@needs_shared_memory
def test_a_writer_knows_when_its_memory_was_removed(tmp_path: Path) -> None:
    with FrameWriter(tmp_path / "run", "camera", capacity=50_000) as writer:
        assert writer.in_place
        # Only the pool of this writer: what Zenoh shares for its own bookkeeping serves all writers of this process.
        for path in {path for start, end, path in memory.mappings() if METADATA > end - start > 6 * 50_000}:
            Path(path).unlink()
        assert not writer.in_place
    with writer:
        assert writer.in_place


@needs_root
def test_frames_are_shared_once_there_is_room(tmp_path: Path) -> None:
    """The writer is opened again for it, as av_daemon is; a reader that had no room either finds it by itself."""
    program = (
        "import subprocess, sys, time; from pathlib import Path; from pebble.extensions.media.frames import *\n"
        "from pebble.extensions.media.frames import writer; writer.RETRY_S = 0\n"
        "folder = Path(sys.argv[1]); w = FrameWriter(folder, 'camera', capacity=900_000).open()\n"
        "with FrameReader(folder, 'camera') as r:\n"
        "    before = w.may_share, r.shared\n"
        "    subprocess.run(sys.argv[2], shell=True, check=True)\n"
        "    assert w.may_share; w.close(); w.open(); frame = None; end = time.monotonic() + 15\n"
        "    while not (frame and frame.shared) and time.monotonic() < end:\n"
        "        w.write(b'x' * 900_000, FrameInfo()); frame = r.read(0.2) or frame\n"
        "    print(before, w.problem, r.problem, frame and frame.shared, w.may_share); w.close()"
    )
    mount = "mount -t tmpfs -o size=64m none /dev/shm && (dd if=/dev/zero of=/dev/shm/others bs=1M || true)"
    command = ["unshare", "-m", "sh", "-c", mount + ' 2>/dev/null; exec "$@"', "sh", sys.executable, "-c", program]
    printed = subprocess.check_output([*command, str(tmp_path), "rm /dev/shm/others"], timeout=40, text=True)
    assert printed == "(False, False)   True False\n"


@contextmanager
def publishing(folder: Path) -> Iterator[Any]:
    """What a program could send that listens as a writer does."""
    names = StreamNames(folder, "camera")
    prepare_run_dir(folder)
    with open_writing(names, shared=False) as session:
        yield session.declare_publisher(names.data)


def test_what_is_not_a_frame_is_refused(tmp_path: Path) -> None:
    with publishing(tmp_path) as publisher, FrameReader(tmp_path, "camera") as reader:
        assert until(lambda: publisher.matching_status.matching)
        for attachment in (None, b"", b"\xc1garbage", b"\x91\xa3abc"):
            publisher.put(b"x" * 50, attachment=attachment)
        sound = FrameInfo(format="s16le", rate=16000, channels=1, sequence=1, writer=7)
        publisher.put(b"\x01\x02", attachment=encode(sound))
        frame = reader.read(WAIT_S)
        assert frame is not None
        assert frame.data.tolist() == [1, 2]
        assert frame.info.rate == 16000
        assert reader.counters["refused"] == 4


@needs_shared_memory
def test_past_a_limit_of_mapped_memory_frames_come_as_bytes_and_the_reader_reports_it(
    net: FramesNet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_reader, "MAPPED_LIMIT", -1)
    with FrameReader(net.folder, "camera") as reader:
        net.start("writer", size=SMALL, rate=60)

        def comes_as_bytes() -> bool:
            frame = reader.read(1)
            return frame is not None and not frame.shared

        assert until(comes_as_bytes)
        assert "until this process is restarted" in reader.problem


def test_late_frames_of_a_replaced_writer_are_ignored(tmp_path: Path) -> None:
    with publishing(tmp_path) as publisher, FrameReader(tmp_path, "camera", depth=9) as reader:
        assert until(lambda: publisher.matching_status.matching)
        for life, number in ((7, 5), (8, 1), (7, 6), (8, 1), (8, 2)):
            publisher.put(bytes([number]), attachment=encode(FrameInfo(sequence=number, writer=life)))
        frames = [reader.read(WAIT_S) for _ in range(3)]
        assert [(frame.info.writer, frame.info.sequence) for frame in frames if frame] == [(7, 5), (8, 1), (8, 2)]
        assert reader.read(0.2) is None


@needs_shared_memory
def test_anything_with_bytes_can_be_written(tmp_path: Path) -> None:
    picture = np.arange(3 * 100 * 200, dtype=np.uint8).reshape(100, 200, 3)
    flat = picture.tobytes()
    whole = np.zeros((100, 400, 3), np.uint8)
    whole[:, ::2] = picture
    with (
        FrameWriter(tmp_path, "camera", capacity=60_000) as writer,
        FrameReader(tmp_path, "camera") as reader,
        FrameReader(tmp_path, "camera", sharing=False) as of_bytes,
    ):
        assert until(lambda: writer.readers == 2)
        for data in (picture, whole[:, ::2], flat, bytearray(flat), memoryview(flat), np.frombuffer(flat, "<u2")):
            assert writer.write(data, FrameInfo(format="bgr24", width=200, height=100))
            frame = reader.read(WAIT_S)
            assert frame is not None
            assert frame.shared
            assert frame.data.tobytes() == flat
            frame.data[0] = 7  # it is ours
            assert frame.picture().shape == (100, 200, 3)
            copied = of_bytes.read(5)
            assert copied is not None
            assert (copied.data.tobytes(), copied.shared) == (flat, False)
        assert (of_bytes.shared, of_bytes.problem) == (False, "")
        assert writer.write(b"x" * 1_000_000, FrameInfo())  # no slot is that large
        big = reader.read(WAIT_S)
        assert big is not None
        assert (big.data.size, big.shared) == (1_000_000, False)
        assert writer.counters["fallbacks"] == 1


def test_the_name_of_a_stream_is_part_of_a_path(tmp_path: Path) -> None:
    for name in ("", "..", "a/b", "Camera", "a*", "x" * 40):
        with pytest.raises(TransportError):
            FrameReader(tmp_path, name)
    with pytest.raises(TransportError, match="too long"):
        FrameWriter(tmp_path / ("x" * 100), "camera", capacity=1).open()
