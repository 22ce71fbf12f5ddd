"""Views look into shared memory; they are certain about it, or they are not used."""

from __future__ import annotations

import gc
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zenoh
import zenoh.shm

from pebble.errors import TransportError
from pebble.extensions.media.frames import FrameInfo, FrameReader, FrameWriter, views
from tests.locking import needs_shared_memory
from tests.support import ROOT, Child, until

LARGE = 500_000  # bytes: the allocator's margin holds no such frame


@pytest.fixture(autouse=True)
def untested(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test begins like a new process."""
    monkeypatch.setattr(views, "self_test", views.SelfTest())


def test_what_a_view_writes_is_in_the_buffer_and_the_other_way_round() -> None:
    assert views.why_unavailable() == ""
    pool = zenoh.shm.ShmProvider.default_backend(1 << 22)
    for size in (1, 7, 4096, 65_537, 3_000_001):
        buffer = pool.alloc(size, policy=zenoh.shm.GarbageCollect())
        view = views.array(buffer, size, writable=True, owner=pool)
        assert view is not None
        view[:] = 7
        view[-1] = 9
        assert bytes(buffer) == b"\7" * (size - 1) + b"\x09"
        buffer[:] = bytes(size)
        assert not view.any()


def test_a_readers_view_cannot_be_made_writable() -> None:
    pool = zenoh.shm.ShmProvider.default_backend(1 << 20)
    buffer = pool.alloc(100)
    buffer[:] = bytes(range(100))
    view = views.array(zenoh.ZBytes(buffer).as_shm(), 100)
    assert view is not None
    assert view.tobytes() == bytes(range(100))
    with pytest.raises(ValueError, match="read-only"):
        view[0] = 1
    with pytest.raises(ValueError, match="WRITEABLE"):
        view.flags.writeable = True


def test_an_array_keeps_its_memory() -> None:
    pool = zenoh.shm.ShmProvider.default_backend(1 << 20)
    buffer = pool.alloc(500_000)
    buffer[:] = b"x" * 500_000
    view = views.array(zenoh.ZBytes(buffer).as_shm(), 500_000)
    assert view is not None
    corner = view.reshape(500, 1000)[400:, ::3]
    del view, buffer
    gc.collect()
    with pytest.raises(zenoh.ZError):
        pool.alloc(600_000, policy=zenoh.shm.GarbageCollect())
    assert corner.tobytes() == b"x" * corner.size
    del corner
    pool.garbage_collect()
    assert pool.alloc(600_000)


def _unprintable(buffer: object) -> int:
    raise views.UnexpectedLayoutError("ZShmMut does not print its address")


MISMATCHES = {
    "another version": ("KNOWN_VERSIONS", frozenset({"1.9.0"}), "1.9.0"),
    "the address is nowhere": ("_printed", lambda _: 1, "none of its words"),
    "nothing is printed": ("_printed", _unprintable, "does not print"),
    "it is a word further": ("_only", lambda found: min(found[0]) + 8, "has moved"),
    "buffers are smaller": ("_only", lambda _: 4096, "too small"),
}


@pytest.mark.parametrize(("name", "value", "reason"), MISMATCHES.values(), ids=MISMATCHES)
def test_on_any_mismatch_it_reports_why(
    name: str, value: object, reason: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(views, name, value)
    assert reason in views.why_unavailable()
    assert reason in caplog.text
    assert views.array(object(), 100) is None


def test_without_views_frames_are_copied(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(views, "KNOWN_VERSIONS", frozenset())
    with (
        FrameWriter(tmp_path, "camera", capacity=50_000) as writer,
        FrameReader(tmp_path, "camera", views=True) as reader,
    ):
        assert until(lambda: writer.wanted)
        assert writer.slot(50_000) is None
        assert writer.write(np.full(50_000, 3, np.uint8), FrameInfo())
        frame = reader.read(5)
        assert frame is not None
        assert frame.shared
        assert frame.valid()
        frame.data[0] = 4  # a copy of our own
        assert frame.data.tobytes() == b"\4" + b"\3" * 49_999


def test_a_released_frame_is_not_to_be_used_and_what_was_taken_from_it_stays(tmp_path: Path) -> None:
    with (
        FrameWriter(tmp_path, "camera", capacity=50_000) as writer,
        FrameReader(tmp_path, "camera", views=True) as reader,
    ):
        assert until(lambda: writer.wanted)
        slot = writer.slot(30_000)
        assert slot is not None
        retained = slot.array
        retained[:] = 5
        assert slot.send(FrameInfo(format="bgr24", width=100, height=100))
        with pytest.raises(TransportError, match="sent or dropped"):
            _ = slot.array
        with pytest.raises(TransportError, match="sent or dropped"):
            slot.send(FrameInfo())
        slot.drop()
        frame = reader.read(5)
        assert frame is not None
        picture = frame.picture()
        assert np.shares_memory(picture, frame.data)
        frame.release()
        frame.release()
        assert not frame.valid()
        with pytest.raises(TransportError, match="released"):
            _ = frame.data
        assert picture.min() == picture.max() == 5
    assert picture.sum() == 5 * 30_000  # both ends are closed, and it is still there
    retained[:] = 6  # forbidden, and harmless
    assert picture.sum() == 6 * 30_000


def test_slots_that_are_dropped_or_forgotten_are_free_again(tmp_path: Path) -> None:
    with FrameWriter(tmp_path, "camera", capacity=50_000) as writer, FrameReader(tmp_path, "camera"):
        assert until(lambda: writer.wanted)
        for _ in range(50):
            slot = writer.slot(50_000)
            assert slot is not None
            slot.array[:] = 1
            slot.drop()
        assert [writer.slot(50_000) is not None for _ in range(20)] == [True] * 20


HOLDER = """
import sys; from pathlib import Path; from pebble.extensions.media.frames import *
with FrameReader(Path(sys.argv[1]), "camera", views=True) as reader:
    frame = reader.read(10); data = frame.data
    print(frame.valid(), set(data.tolist()), flush=True); sys.stdin.readline()
    print(frame.valid(), set(data.tolist()), flush=True)
"""


@needs_shared_memory
def test_a_frame_that_was_held_too_long_is_invalid(tmp_path: Path) -> None:
    """Its process is stopped, so that the writer takes the memory back; afterwards it looks at its frame again."""
    with FrameWriter(tmp_path, "camera", capacity=LARGE, slots=2) as writer:
        holder = Child(
            [sys.executable, "-X", "dev", "-c", HOLDER, str(tmp_path)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert until(lambda: writer.wanted)
            assert writer.write(b"\1" * LARGE, FrameInfo())
            assert holder.stdout is not None
            assert holder.stdout.readline() == "True {1}\n"
            holder.send_signal(signal.SIGSTOP)
            with FrameReader(tmp_path, "camera") as reader:
                assert until(
                    lambda: writer.write(b"\2" * LARGE, FrameInfo()) and writer.counters["reclaimed"], step=0.02
                )
                assert until(
                    lambda: (
                        writer.write(b"\2" * LARGE, FrameInfo()) and reader.read(1) and reader.counters["shared"] > 3
                    ),
                    step=0.02,
                )
            holder.send_signal(signal.SIGCONT)
            valid, found = holder.communicate("\n", timeout=10)[0].split(maxsplit=1)
            assert (valid, "2" in found) == ("False", True)
        finally:
            holder.kill()
            holder.wait()
