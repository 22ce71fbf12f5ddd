"""The recorder on real files: what it writes, and what becomes of it when the disk, the clock or the power fails."""

from __future__ import annotations

import errno
import json
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.recordings import library
from pebble.extensions.recordings.catalogue import look_at
from pebble.extensions.recordings.files.reader import RecordingFile
from pebble.extensions.recordings.files.recorded import Recorded, RecordingError
from pebble.extensions.recordings.recorder import background, lane, writing
from pebble.extensions.recordings.recorder import recorder as recorders
from pebble.extensions.recordings.recorder.folder import STATE, Folder
from pebble.extensions.recordings.recorder.intake import EVENTS, Clocks
from pebble.extensions.recordings.recorder.lane import Item, OpenFile, RawFile
from pebble.extensions.recordings.recorder.recorder import Recorder
from pebble.extensions.recordings.recorder.settings import Options
from tests.small_disk import SmallDisk
from tests.support import ROOT, beside, cases, needs_root, quickly, refused, until

BASE = "pebble/robots/goob"
ONLINE, CAMERA = f"{BASE}/outgoing/online", f"{BASE}/outgoing/front-camera"
STATUS = f"{BASE}/outgoing/status"
PICTURE = b"PBVD\x01\x05\x01" + bytes(12)
QUICK = Options(free_bytes=0)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """It writes, and makes durable, more often than usual."""
    monkeypatch.setattr(recorders, "FLUSH_S", 0.2)
    monkeypatch.setattr(background, "SYNC_S", 0.3)


def recorded(root: Path) -> list[Recorded]:
    """What is in the files so far; a recorder that runs has none before its first write."""
    return list(library.merged(library.files([root]))) if any(root.rglob("*.mcap*")) else []


def payloads(root: Path, topic: str = ONLINE) -> list[bytes]:
    return [message.payload for message in recorded(root) if message.channel.topic == topic]


def events(root: Path, name: str) -> list[dict[str, Any]]:
    found = [json.loads(message.payload) for message in recorded(root) if message.channel.topic == EVENTS]
    return [event for event in found if event["event"] == name]


class Running:
    """A recorder with a robot."""

    def __init__(self, root: Path, options: Options = QUICK, clocks: Clocks | None = None) -> None:
        self.root, self.recorder = root, Recorder(root, options, {"recorder": "test"}, clocks)
        self.sent = 0
        self.recorder.start()

    def send(self, count: int = 1, topic: str = ONLINE, payload: bytes = b"%d", *, retain: bool = False) -> None:
        for _ in range(count):
            self.recorder.receive(topic, payload.replace(b"%d", b"%d" % self.sent), 1, retain)
            self.sent += 1

    def written(self, count: int) -> bool:
        return until(lambda: self.recorder.counters["written"] >= count)

    def stop(self) -> None:
        self.recorder.stop()


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    one = Running(tmp_path / "rec")
    yield one
    one.stop()


def test_time_never_goes_back_in_a_file(tmp_path: Path) -> None:
    """A message that another thread has brought late bears the time of the one before it."""
    file = OpenFile(Folder(tmp_path), STATE, 1, {})
    for at_ns in (30, 20, 40):
        file.add(Item(1, ONLINE, b"1", 1, False, ""), at_ns)
    file.finish()
    assert [message.log_ns for message in recorded(tmp_path)] == [30, 30, 40]


class TestFiles:
    def test_all_is_written_in_order_with_its_flags(self, running: Running) -> None:
        running.send(500)
        running.recorder.receive(f"{BASE}/incoming/flags/mqtt-video", b"true", 1, retain=True, retained=True)
        running.recorder.receive("a/b", b"\x00\x01", None, retain=None)
        running.recorder.receive(EVENTS, b'{"event":"gap"}', 1, False)  # forged
        running.stop()
        found = recorded(running.root)
        assert payloads(running.root) == [b"%d" % number for number in range(500)]
        flags = {message.channel.topic: (message.channel.encoding, dict(message.channel.metadata)) for message in found}
        assert flags[ONLINE] == ("json", {"qos": "1", "retain": "0"})
        assert flags[f"{BASE}/incoming/flags/mqtt-video"] == ("json", {"qos": "1", "retain": "1", "retained": "1"})
        assert flags["a/b"] == ("application/octet-stream", {})
        assert [event["event"] for event in map(json.loads, payloads(running.root, EVENTS))] == ["start", "stop"]
        assert running.recorder.counters["refused"] == 1

    def test_each_robots_media_have_files_of_their_own(self, running: Running) -> None:
        running.send()
        running.send(topic=CAMERA, payload=PICTURE)
        running.send(topic=f"a/{'x' * 300}/b/cam", payload=PICTURE)
        for number in range(50):
            running.send(topic=f"pebble/robots/r{number}/outgoing/front-camera", payload=PICTURE)
        running.stop()
        names = sorted(path.name.split(".", 1)[1] for path in library.files([running.root]))
        assert {"state.mcap", "media.pebble.robots.goob.mcap", "media._other.mcap"} < set(names)
        assert len(names) == 33
        assert len(recorded(running.root)) == 2 + 1 + 1 + 1 + 50

    def test_state_has_its_file_however_many_send_pictures(
        self, running: Running, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(writing, "ROTATE_BYTES", 1 << 16)
        for number in range(40):
            running.send(topic=f"pebble/robots/r{number}/outgoing/front-camera", payload=PICTURE)
        running.send(topic=STATUS, payload=random.Random(1).randbytes(100_000))
        assert until(lambda: list(running.root.rglob("*.state.mcap")))  # it is rotated, and no other
        running.send(5)
        running.stop()
        state = [path for path in library.files([running.root]) if ".state." in path.name]
        assert len([m for m in library.merged(state) if m.channel.topic == ONLINE]) == 5

    def test_times_are_those_of_reception(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """However long the disk holds up the writer, and whatever happens to the recording meanwhile."""
        monkeypatch.setattr(RawFile, "write", _slowly(RawFile.write, 0.4))
        running, sent = Running(tmp_path / "rec"), []
        for _ in range(25):
            before = time.time_ns()
            running.send()
            sent.append((before - 10**6, time.time_ns() + 10**6))
            running.recorder.note("connected")
            time.sleep(0.02)
        running.stop()
        times = [message.log_ns for message in recorded(running.root) if message.channel.topic == ONLINE]
        assert all(begin <= at <= end for at, (begin, end) in zip(times, sent, strict=True))
        assert all(abs(event["t"] / 1000 - time.time()) < 60 for event in events(running.root, "connected"))

    def test_files_are_rotated_and_carry_the_newest_value_of_each_broker(self, tmp_path: Path) -> None:
        running = Running(tmp_path / "rec", Options(free_bytes=0, rotate_seconds=0.5))
        flag, gone, receive = f"{BASE}/incoming/flags/mqtt-video", f"{BASE}/outgoing/gone", running.recorder.receive
        receive(flag, b"true", None, True, retained=True)
        receive(flag, b"false", 1, None)
        receive(gone, b"1", 1, True)
        receive(gone, b"", 1, True)
        receive(ONLINE, b"one", 1, True, source="one")
        receive(ONLINE, b"two", 1, True, source="two")
        receive(STATUS, b"gone", None, True, retained=True, source="two")
        running.recorder.forget_retained("two")
        receive(ONLINE, b"three", None, True, retained=True, source="two")
        receive(STATUS, b"newer", 1, True, source="one")
        receive(STATUS, b"older", None, True, retained=True, source="one")  # fetched meanwhile by another connection
        for _ in range(30):
            running.send(topic=f"{BASE}/outgoing/live")
            time.sleep(0.05)
        running.stop()
        assert len(library.files([running.root])) >= 2
        carried = {m.payload for m in recorded(running.root) if m.channel.metadata.get("retained") == "carried"}
        assert carried == {b"false", b"one", b"three", b"newer"}
        assert payloads(running.root, f"{BASE}/outgoing/live") == [b"%d" % number for number in range(30)]

    def test_no_media(self, tmp_path: Path) -> None:
        running = Running(tmp_path / "rec", Options(free_bytes=0, media=False))
        running.send()
        running.send(topic=CAMERA, payload=PICTURE)
        running.stop()
        assert [path.name.split(".")[1] for path in library.files([tmp_path])] == ["state"]

    @pytest.mark.parametrize(("limit", "most"), [("_MOST_CHANNELS", 500), ("_MOST_INDEXED", 5)])
    def test_a_stranger_may_invent_topics(
        self, running: Running, monkeypatch: pytest.MonkeyPatch, limit: str, most: int
    ) -> None:
        """They cost no message, but begin files."""
        monkeypatch.setattr(lane, limit, most)
        running.send()
        assert running.written(1)
        for number in range(2000):
            running.recorder.receive(f"pebble/robots/evil{number % 7}/outgoing/{number}", b"%d" % number, 0, False)
        assert running.written(2001)
        running.send()
        running.stop()
        found = recorded(running.root)
        evil = {message.channel.topic: message.payload for message in found if "evil" in message.channel.topic}
        assert len(evil) == 2000
        assert all(topic.endswith(payload.decode()) for topic, payload in evil.items())
        assert len(payloads(running.root)) == 2
        assert len(library.files([running.root])) >= 2

    def test_the_folder_has_one_recorder(self, running: Running) -> None:
        with pytest.raises(RecordingError, match="a recorder writes here: stop it first"):
            Recorder(running.root, QUICK).start()
        assert Folder.is_in_use(running.root)
        running.stop()
        assert not Folder.is_in_use(running.root)


@contextmanager
def _unmounted(disk: SmallDisk) -> Iterator[None]:
    """Something else is mounted over it meanwhile."""
    disk.mount()
    yield
    disk.unmount()


#: What happens to the disk, and what the log says.
FAULTS: dict[str, tuple[Callable[[SmallDisk], AbstractContextManager[None]], str]] = {
    "unmounted": (_unmounted, "was removed, or is on another disk now"),
    "full": (SmallDisk.full, "the disk is full: nothing is recorded until that is mended"),
}


class TestDisk:
    def test_a_slow_disk_blocks_no_sender_and_costs_pictures_first(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(RawFile, "write", _slowly(RawFile.write, 0.3))
        monkeypatch.setattr(recorders, "QUEUE_BYTES", 300_000)
        running = Running(tmp_path / "rec")
        running.send()
        assert until(lambda: running.recorder.counters["written"])
        with quickly():
            for _ in range(150):
                running.send(topic=CAMERA, payload=PICTURE + bytes(5000))
                running.send()
        assert until(lambda: running.recorder.counters["event_dropped"])
        written = running.recorder.counters["written"]
        running.send()
        assert running.written(written + 150)  # the others of the queue, and then once more
        dropped = running.recorder.counters["dropped"]
        running.stop()
        assert 50 < dropped < 115, "pictures have three quarters of the queue"
        assert len(payloads(running.root)) == 152
        assert sum(event["messages"] for event in events(running.root, "dropped")) == dropped

    @pytest.mark.parametrize("fault", ["write", "open"])
    def test_a_fault_costs_only_what_comes_meanwhile_and_the_count_is_written_down(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
    ) -> None:
        broken, write, create = threading.Event(), RawFile.write, Folder.create

        def raw_write(self: Any, data: memoryview) -> int | None:
            if fault == "write" and broken.is_set():
                if len(data) < 50:
                    raise OSError(errno.ENOSPC, "No space left on device")
                return write(self, data[:40])  # a part of it still fits
            return write(self, data)

        def created(self: Folder, lane: str, now_ns: int) -> Any:
            if fault == "open" and broken.is_set():
                raise OSError(errno.EIO, "Input/output error")
            return create(self, lane, now_ns)

        monkeypatch.setattr(RawFile, "write", raw_write)
        monkeypatch.setattr(Folder, "create", created)
        running = Running(tmp_path / "rec")
        running.send(100)
        assert running.written(100)
        broken.set()
        running.send(50)
        running.send(topic=CAMERA, payload=PICTURE)
        assert until(lambda: bool(running.recorder.blocked))
        running.send(70)
        running.recorder.note("lost", why="meanwhile")
        assert until(lambda: running.recorder.counters["dropped"] == 70)
        broken.clear()
        failed_files = int(fault == "write")
        assert until(lambda: running.recorder.counters["event_recovered"] == failed_files)
        assert until(lambda: not running.recorder.blocked)
        running.send(10)
        running.stop()
        expected = [b"%d" % number for number in (*range(150), *range(221, 231))]
        assert sorted(payloads(running.root), key=int) == expected
        assert payloads(running.root, CAMERA) == [PICTURE]
        assert [event["messages"] for event in events(running.root, "gap")] == [70]
        assert [len(events(running.root, name)) for name in ("recovered", "lost")] == [failed_files, 1]

    def test_the_oldest_media_go_first_and_what_is_not_ours_stays(self, tmp_path: Path) -> None:
        root = tmp_path / "rec"
        foreign = root / "2026" / "mine.mcap"
        foreign.parent.mkdir(parents=True)
        foreign.write_bytes(bytes(100_000))
        options = Options(free_bytes=0, rotate_seconds=0.4, keep_bytes=60_000)
        running, rng = Running(root, options), random.Random(1)
        for _ in range(60):
            running.send(topic=CAMERA, payload=PICTURE + rng.randbytes(3000))
            running.send()
            time.sleep(0.05)
        running.stop()
        entries = Folder(root).entries()
        assert foreign.exists()
        assert sum(entry.size for entry in entries) < 60_000 + 60_000
        assert len(events(root, "pruned")) >= 2
        assert all("media" in event["file"] for event in events(root, "pruned")[:2])
        assert len(payloads(root)) == 60

    def test_files_that_are_too_old_go_one_in_a_minute(self, tmp_path: Path) -> None:
        """The clock may have been set wrong."""
        root, later_s = tmp_path / "rec", [0.0]
        (root / "2026").mkdir(parents=True)
        for number in range(1, 4):
            path = root / "2026" / f"20260101T000000Z-{number:06d}.media.pebble.robots.goob.mcap"
            path.write_bytes(b"")
            path.with_suffix(".parquet").write_bytes(b"")
            os.utime(path, (0, 0))

        def boot_ns() -> int:
            return time.monotonic_ns() + int(later_s[0] * 1e9)

        clocks = Clocks(boot_ns=boot_ns, awake_ns=boot_ns)
        running = Running(root, Options(free_bytes=0, keep_media_days=1.0), clocks)
        gone = [0]
        for jumps in range(1, 9):
            later_s[0] += 61
            assert until(lambda jumps=jumps: running.recorder.counters["event_clock"] == jumps)
            gone.append(running.recorder.counters["event_pruned"])
        running.stop()
        assert gone[-1] == 2
        assert [path.stem[17:23] for path in root.rglob("*.parquet")] == ["000003"]  # an index goes with its recording
        assert all(two - one <= 1 for one, two in pairwise(gone))

    @needs_root
    @pytest.mark.parametrize("fault", FAULTS)
    def test_a_disk_that_fails_for_a_while_costs_what_comes_meanwhile_and_no_more(
        self, tmp_path: Path, fault: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        (work, line), disk = FAULTS[fault], SmallDisk(tmp_path / "disk", mebibytes=1)
        disk.mount()
        root = disk.root / "rec"
        running = Running(root)
        ending = threading.Event()

        def send() -> None:
            while not ending.wait(0.01):
                running.send(payload=b"%d " + random.Random(running.sent).randbytes(500))

        try:
            with beside(send, ending):
                assert running.written(20)
                with work(disk):
                    assert until(lambda: line in caplog.text)
                assert until(lambda: not running.recorder.blocked and running.recorder.folder.in_place)
                done = running.recorder.counters["written"]
                assert running.written(done + 20)
                assert Folder.is_in_use(root)
        finally:
            running.stop()
            found = {int(payload.split()[0]) for payload in payloads(root)} if root.exists() else set()
            disk.close()
        assert {*range(20), running.sent - 1} <= found

    def test_what_a_full_disk_never_took_is_counted_at_the_end(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        running = Running(tmp_path / "rec")
        running.send(20)
        assert running.written(20)
        monkeypatch.setattr(RawFile, "write", refused(errno.ENOSPC))
        running.send(30)
        assert until(lambda: bool(running.recorder.blocked))
        running.send(40)
        running.stop()
        assert running.recorder.counters["dropped"] == 70
        assert len(payloads(running.root)) == 20

    def test_no_room_from_the_start(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("os.statvfs", lambda _: os.statvfs_result((4096, 4096, 9000, 9, 9, 9, 9, 9, 0, 255)))
        running = Running(tmp_path / "rec", Options())
        assert until(lambda: "the disk is full" in running.recorder.blocked)
        running.stop()


def _slowly(write: Any, seconds: float) -> Any:
    def slow(self: Any, data: memoryview) -> int | None:
        time.sleep(seconds)
        return int(write(self, data))

    return slow


class TestClock:
    @pytest.mark.parametrize("by_s", [-3600.0, 40 * 86_400.0])
    def test_a_jump_begins_a_new_file_and_time_never_goes_back_in_one(self, tmp_path: Path, by_s: float) -> None:
        shift = [0]
        running = Running(tmp_path / "rec", clocks=Clocks(wall_ns=lambda: time.time_ns() + shift[0]))
        running.send(20)
        assert running.written(20)
        shift[0] = int(by_s * 1e9)
        for _ in range(20):
            running.send()
            time.sleep(0.03)
        running.stop()
        files = library.files([running.root])
        assert len(files) == 2
        for path in files:
            with RecordingFile(path) as file:
                times = [message.log_ns for chunk in file.chunks for message in file.messages(chunk)]
            assert times == sorted(times)
        jump = events(running.root, "clock")
        assert [round(event["by_s"]) for event in jump] == [round(by_s)]
        assert len(payloads(running.root)) == 40

    def test_a_suspended_machine_is_a_gap(self, tmp_path: Path) -> None:
        asleep = [0]
        clocks = Clocks(wall_ns=lambda: time.time_ns() + asleep[0], boot_ns=lambda: time.monotonic_ns() + asleep[0])
        running = Running(tmp_path / "rec", clocks=clocks)
        running.send(5)
        assert running.written(5)
        time.sleep(0.5)
        asleep[0] = 8 * 3600 * 10**9
        running.send(5)
        assert until(lambda: running.recorder.counters["event_gap"] == 1)
        running.stop()
        (gap,) = events(running.root, "gap")
        assert gap["why"] == "suspended"
        assert gap["until"] - gap["since"] == pytest.approx(8 * 3600_000, abs=2000)
        assert len(payloads(running.root)) == 10


_CHILD = """
import sys, time
from pathlib import Path
from pebble.extensions.recordings.recorder.recorder import Recorder
from pebble.extensions.recordings.recorder.settings import Options
recorder = Recorder(Path(sys.argv[1]), Options(free_bytes=0))
recorder.start()
number = 0
while True:
    recorder.receive("pebble/robots/goob/outgoing/online", b"%d" % number, 1, False)
    recorder.receive("pebble/robots/goob/outgoing/front-camera", b"PBVD" + b"\\x00" * 15 + b"%d" % number, 0, False)
    print(number, flush=True)
    number += 1
    time.sleep(0.002)
"""


class TestEnds:
    def test_killed_at_any_moment_it_loses_a_second_at_most(self, tmp_path: Path) -> None:
        """What a killed recorder leaves is finished by the next one."""
        root, rng, lost, kills = tmp_path / "rec", random.Random(4), [], cases(2, 6)
        for _ in range(kills):
            with subprocess.Popen([sys.executable, "-c", _CHILD, root], stdout=subprocess.PIPE, text=True) as child:
                assert child.stdout is not None
                child.stdout.readline()
                time.sleep(rng.uniform(0.2, 2.5))
                child.kill()
                last = int(child.stdout.read().split()[-2])
            active = [entry.path for entry in Folder(root).entries() if entry.is_active]
            found = [
                int(message.payload)
                for path in active
                for message in library.merged([path])
                if message.channel.topic == ONLINE
            ]
            assert found == list(range(len(found)))
            lost.append(last + 1 - len(found))
        assert max(lost) <= 2.5 / 0.002  # a generous bound; 1.2 s are expected
        running = Running(root)
        assert until(
            lambda: not [entry for entry in Folder(root).entries() if entry.is_active and entry.number <= 2 * kills]
        )
        running.stop()
        assert not list(root.rglob("*.damaged"))
        for path in library.files([root]):
            assert look_at(path, whole=True).problem == ""

    def test_what_is_written_is_made_durable_every_few_seconds(
        self, running: Running, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """So a power cut leaves what a cut file has, and perhaps pages of zeros behind it."""
        synced: list[int] = []
        monkeypatch.setattr(os, "fdatasync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
        running.send(20)
        assert running.written(20)
        (path,) = running.root.rglob("*.active")
        assert until(lambda: synced[-1:] == [path.stat().st_size])


# A last block that lives keeps all pages below it, which hold nothing, at the process.
_MEMORY = """
import os
from tests.own_memory import own_mb
from pebble.extensions.recordings.recorder.background import return_free_pages

blocks = [bytes(2000) for _ in range(20_000)]
last = blocks.pop()
del blocks
before = own_mb(os.getpid())
return_free_pages()
print(before - own_mb(os.getpid()))
"""


@pytest.mark.skipif("CS_GNU_LIBC_VERSION" not in os.confstr_names, reason="needs glibc")
def test_free_pages_are_returned() -> None:
    command = [sys.executable, "-c", _MEMORY]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=30)
    assert float(done.stdout) > 30
