"""The writer's side of a GStreamer socket, and readers that stop, die, and send nonsense."""

from __future__ import annotations

import os
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from pebble.errors import DeviceError, TransportError
from pebble.services.gstreamer_mirror.shm_pipe import MOST_READERS, STARVED_S, ShmPipe
from tests.kit.shm_reader import ShmReader
from tests.support import until

SLOT, SLOTS = 1000, 12
SHARE = SLOTS // 4


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "v.sock"


@pytest.fixture
def pipe(path: Path) -> Iterator[ShmPipe]:
    with ShmPipe(path, SLOT, SLOTS) as pipe:
        yield pipe


def connect(pipe: ShmPipe) -> ShmReader:
    """A reader that the pipe has admitted."""
    readers: list[ShmReader] = []
    thread = threading.Thread(target=lambda: readers.append(ShmReader(pipe.path)))
    thread.start()
    while thread.is_alive():
        pipe.wait(0.01)
    return readers[0]


def put(pipe: ShmPipe, number: int, size: int = SLOT) -> bool:
    """Send a buffer full of ``number``, after what readers have done was handled."""

    def draw(room: np.ndarray) -> bool:
        room[:] = number
        return True

    pipe.wait()
    return pipe.put(size, draw)


def test_every_reader_gets_every_buffer(pipe: ShmPipe) -> None:
    assert not put(pipe, 0), "without a reader nothing is sent"
    first, second = connect(pipe), connect(pipe)
    for number in range(1, 3 * SLOTS):
        assert put(pipe, number, SLOT - number)
        assert first.read() == second.read() == bytes([number]) * (SLOT - number)


def test_what_is_not_whole_is_sent_to_none(pipe: ShmPipe) -> None:
    reader = connect(pipe)
    assert not pipe.put(SLOT, lambda _room: False)
    assert put(pipe, 1)
    assert reader.read() == bytes([1]) * SLOT


def test_readers_that_stop_hold_a_share_and_harm_no_other(pipe: ShmPipe) -> None:
    stopped = [connect(pipe) for _ in range(3)]
    reader = connect(pipe)
    for number in range(1, 200):
        assert put(pipe, number)
        assert reader.read() == bytes([number]) * SLOT
    assert pipe.counters["full"] == 0
    for one in stopped:  # what they hold is as it was sent
        assert [one.take() for _ in range(SHARE)] == [bytes([number]) * SLOT for number in range(1, 1 + SHARE)]
        assert one.take(0) is None
    stopped[0].release()
    assert put(pipe, 201)
    assert stopped[0].take() == bytes([201]) * SLOT


def test_where_no_reader_would_get_a_buffer_none_is_wanted(pipe: ShmPipe) -> None:
    assert not pipe.wanted
    reader = connect(pipe)
    assert [put(pipe, number) for number in range(SHARE)] == [True] * SHARE
    assert not pipe.wanted
    reader.take()
    reader.release()
    pipe.wait()
    assert pipe.wanted


def test_one_that_holds_what_all_others_need_is_disconnected(pipe: ShmPipe) -> None:
    stopped = []
    for group in range(4):  # each holds slots of its own
        stopped.append(connect(pipe))
        assert [put(pipe, 10 * group + number) for number in range(SHARE)] == [True] * SHARE
    reader = connect(pipe)
    began = time.monotonic()
    assert until(lambda: put(pipe, 99), 5)
    assert time.monotonic() - began >= STARVED_S
    assert reader.read() == bytes([99]) * SLOT
    assert (pipe.readers, pipe.counters["expelled"]) == (4, 1)
    for _ in range(SHARE):
        stopped[0].take()
    with pytest.raises(EOFError):
        stopped[0].take()


def test_what_a_killed_reader_held_is_free_again(pipe: ShmPipe) -> None:
    for _ in range(3 * SLOTS):
        reader = connect(pipe)
        assert put(pipe, 7)
        reader.socket.close()  # as the kernel does when it kills a process
    assert until(lambda: pipe.wait() or not pipe.readers)
    assert pipe.counters["full"] == 0


@pytest.mark.parametrize("data", [b"\0" * 24, b"x" * 5000], ids=["another command", "noise"])
def test_a_reader_that_sends_nonsense_is_disconnected(pipe: ShmPipe, data: bytes) -> None:
    reader = connect(pipe)
    reader.socket.send(data)
    assert until(lambda: pipe.wait() or not pipe.readers)


def test_more_readers_than_the_limit_are_refused(pipe: ShmPipe) -> None:
    readers = [connect(pipe) for _ in range(MOST_READERS)]
    late = socket.socket(socket.AF_UNIX)
    late.connect(os.fspath(pipe.path))
    assert until(lambda: pipe.wait() or pipe.counters["refused"])
    assert late.recv(1) == b""
    assert pipe.readers == len(readers)


def test_memory_is_taken_as_it_is_used(pipe: ShmPipe) -> None:
    reader = connect(pipe)
    assert len(reader.memory) == SLOT * SLOTS
    for number in range(50):
        put(pipe, number)
        reader.read()
    assert reader.segment.stat().st_blocks * 512 <= 4096


def test_its_user_and_group_may_use_it_and_it_leaves_nothing(path: Path) -> None:
    with ShmPipe(path, SLOT, SLOTS) as pipe:
        reader = connect(pipe)
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
        assert stat.S_IMODE(reader.segment.stat().st_mode) == 0o640
        assert reader.segment.exists()
    assert not path.exists()
    assert not reader.segment.exists()


def test_what_a_killed_run_left_is_replaced(path: Path) -> None:
    killed = ShmPipe(path, SLOT, SLOTS).open()
    reader = connect(killed)
    left = socket.socket(socket.AF_UNIX)
    path.unlink()
    left.bind(os.fspath(path))  # never listens: what a killed process leaves refuses connections, too
    with ShmPipe(path, SLOT, SLOTS) as pipe:
        assert not reader.segment.exists()
        assert put(pipe, 1) is (connect(pipe).read(0) is not None)
    killed.close()


def serves(path: Path) -> object:
    server = socket.socket(socket.AF_UNIX)
    server.bind(os.fspath(path))
    server.listen(1)
    return server


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "served by another program": (serves, "another program serves"),
    "a file": (lambda path: path.write_text("mine"), "is a file and no socket"),
    "a link": (lambda path: path.symlink_to("/etc/passwd"), "is a file and no socket"),
    "no folder": (lambda path: path.parent.rmdir(), "make the folder"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_it_may_not_replace_is_refused_and_stays(tmp_path: Path, what: str) -> None:
    (tmp_path / "run").mkdir()
    path = tmp_path / "run" / "v.sock"
    prepare, text = REFUSED[what]
    _open = prepare(path)
    before = path.lstat().st_ino if path.parent.exists() else None
    with pytest.raises(DeviceError, match=text), ShmPipe(path, SLOT, SLOTS):
        raise AssertionError("it was opened")
    assert (path.lstat().st_ino if path.parent.exists() else None) == before


def test_a_path_that_no_socket_can_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TransportError, match="too long"), ShmPipe(tmp_path / ("x" * 100), SLOT, SLOTS):
        raise AssertionError("it was opened")


def test_what_was_removed_is_noticed(pipe: ShmPipe) -> None:
    reader = connect(pipe)
    assert pipe.in_place
    reader.segment.unlink()
    assert not pipe.in_place
    pipe.close()
    pipe.open()
    assert pipe.in_place
    pipe.path.unlink()
    assert not pipe.in_place


def test_a_wait_can_be_ended_from_another_thread(pipe: ShmPipe) -> None:
    threading.Timer(0.05, pipe.wake).start()
    began = time.monotonic()
    pipe.wait(10)
    assert time.monotonic() - began < 5
