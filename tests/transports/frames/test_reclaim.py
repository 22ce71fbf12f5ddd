"""A reader reclaims the memory of dead writers, once it has no references to it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.transports import segments
from pebble.transports.frames import Frame, FrameReader, reclaim, views
from pebble.transports.frames import reader as frame_reader
from tests.locking import needs_shared_memory
from tests.support import until
from tests.transports.frames.frames_net import FramesNet

LARGE = 1_000_000
POOL = 6 * LARGE


@pytest.fixture
def net(tmp_path: Path) -> Iterator[FramesNet]:
    net = FramesNet(tmp_path / "run")
    yield net
    net.close()


def _frame(reader: FrameReader) -> Frame:
    for _ in range(50):  # a reader that a busy machine holds up copies one now and then
        frame = reader.read(10)
        assert frame is not None
        if frame.shared:
            break
    return frame


def _pools() -> int:
    return sum(end - start >= POOL for start, end, _ in segments.mappings())


@needs_shared_memory
def test_the_pools_of_killed_writers_do_not_add_up(net: FramesNet) -> None:
    with FrameReader(net.folder, "camera", views=True) as reader:
        held: dict[int, Any] = {}
        for life in range(3):
            writer = net.writer(size=LARGE)
            assert until(lambda life=life: reader.read(1) and reader.counters["writers"] == life + 1)
            frame = _frame(reader)
            assert not frame.data.flags.writeable, (reader.problem, views.why_unavailable(), reader.counters.snapshot())
            held[life] = frame.data[:100]
            del frame
            before = held[life].tobytes()
            writer.kill()
            assert until(lambda: not reader.writers and reader.read(0) is None)
            assert held[life].tobytes() == before
        assert _pools() == 3  # all are looked at
        held.clear()
        time.sleep(reclaim.GRACE_S)
        assert until(lambda: reader.read(0) is None and _pools() == 0)
        net.writer(size=LARGE)
        assert _frame(reader).shared
        assert _pools() == 1
    assert not any("zenoh" in path and "deleted" in path for path in _open_files())


@needs_shared_memory
def test_a_living_writers_pool_is_not_given_back_when_its_link_broke(net: FramesNet) -> None:
    with FrameReader(net.folder, "camera") as reader:
        writer = net.writer(size=LARGE)
        _frame(reader)
        for life, pool in list(reader.running.items()):
            del reader.running[life], pool
        time.sleep(reclaim.GRACE_S + 0.1)
        reclaim.reclaim()
        assert _pools() == 1
        writer.kill()
        assert until(lambda: reclaim.reclaim() >= 0 and _pools() == 0), "it is looked at again"


@needs_shared_memory
def test_a_writer_that_was_taken_for_dead_sends_bytes(net: FramesNet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reclaim, "GRACE_S", 0.0)
    writer = net.writer(size=LARGE)
    with FrameReader(net.folder, "camera") as reader:
        assert _frame(reader).shared
        for pool in reader.running.values():
            pool.lock_path.unlink()
        del pool
    assert until(reclaim.reclaim)
    with FrameReader(net.folder, "camera") as reader:
        assert until(lambda: not _frame(reader).shared)
        assert "taken for dead" in reader.problem
        assert until(lambda: writer.ask()["readers"] == 1)


@needs_shared_memory
def test_past_a_limit_frames_come_as_bytes_and_the_reader_reports_it(
    net: FramesNet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_reader, "LEFT_MAPPED_LIMIT", 1)
    with FrameReader(net.folder, "camera") as reader:
        net.writer(size=LARGE)
        assert until(lambda: not _frame(reader).shared)
        assert "until this process is restarted" in reader.problem


def _open_files() -> list[str]:
    links = Path("/proc/self/fd").iterdir()
    return [str(link.readlink()) for link in links if link.exists()]
