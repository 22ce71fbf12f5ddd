"""Hall samples in the shared memory where the original's wheel-odometry looks for them: bytes, restarts, refusals."""

from __future__ import annotations

import os
import signal
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pebble.services.serial_mcu_bridge.text.hall_memory import HallMemory
from tests.kit.hall_reader import HallReader

SLOTS = 64
SECOND = 1_000_000_000


@pytest.fixture
def path() -> Iterator[Path]:
    """Where there is nothing yet."""
    path = Path("/dev/shm") / f"pebble-test-{os.getpid()}-{time.monotonic_ns()}"
    yield path
    path.unlink(missing_ok=True)


@pytest.fixture
def memory(path: Path) -> Iterator[HallMemory]:
    memory = HallMemory(path.name, SLOTS)
    yield memory
    memory.close()


def fill(memory: HallMemory, count: int, at_ns: int = SECOND) -> None:
    for number in range(count):
        memory.write(at_ns + number, (number, -1, 2), None)


@contextmanager
def always_written(memory: HallMemory) -> Iterator[None]:
    """Another process writes samples as fast as it can."""
    child = os.fork()
    while child == 0:
        fill(memory, 1000)
    yield
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)


def test_every_byte_is_where_the_original_has_it(path: Path, memory: HallMemory) -> None:
    assert not path.exists(), "before the first sample"
    memory.write(5, (512, -498, 7), True)
    memory.write(6, (1, 2, 3), False)
    memory.write(7, (4, 5, 6), None)
    raw = path.read_bytes()
    assert len(raw) == 24 + 32 * SLOTS
    assert raw[:24] == b"PBODRAW1" + struct.pack("<HHIQ", 1, SLOTS, 0, 3)
    rows = [(1, 5, 512, -498, 7, 1), (2, 6, 1, 2, 3, 0), (3, 7, 4, 5, 6, -1)]
    assert raw[24:].rstrip(b"\0") == b"".join(struct.pack("<QQiiii", *row) for row in rows)
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_reader_sees_each_sample_once_and_the_newest_ones_if_it_is_late(path: Path, memory: HallMemory) -> None:
    fill(memory, 1)
    reader = HallReader(path.name)
    fill(memory, 10)
    assert [sample.a0 for sample in reader.read()] == list(range(10))
    fill(memory, 3 * SLOTS)
    assert [sample.a0 for sample in reader.read()] == list(range(2 * SLOTS, 3 * SLOTS))


def test_the_newest_number_never_goes_back(path: Path, memory: HallMemory) -> None:
    """A reader on another processor that saw a 0 in between would take all samples once more."""
    fill(memory, 1)
    reader, seen = HallReader(path.name), [0]
    with always_written(memory):
        while len(set(seen)) < 1000:
            seen += [reader.newest for _ in range(5000)]
    assert seen == sorted(seen)


def test_numbers_go_on_where_the_last_writer_ended_and_a_removed_one_is_made_again_within_a_second(
    path: Path, memory: HallMemory
) -> None:
    fill(memory, 100)
    reader = HallReader(path.name)
    memory.close()
    assert path.exists(), "readers wait for the next one"
    again = HallMemory(f"/{path.name}", SLOTS)
    fill(again, 5)
    assert [sample.number for sample in reader.read()] == [101, 102, 103, 104, 105]
    path.unlink()
    again.write(2 * SECOND, (1, 2, 3), None)
    assert HallReader(path.name).newest == 106
    again.close()


def second_writer(path: Path) -> object:
    other = HallMemory(path.name, SLOTS)
    other.write(1, (1, 1, 1), None)
    return other


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "another size": (lambda path: path.write_bytes(bytes(100)), "has 100 bytes, and 64 slots need 2072"),
    "another writer": (second_writer, "is written by another process"),
    "a link": (lambda path: path.symlink_to("/etc/passwd"), "Too many levels of symbolic links"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_not_its_own_stays_as_it_is(
    path: Path, memory: HallMemory, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    prepare, text = REFUSED[what]
    _open = prepare(path)
    before = path.read_bytes()
    for second in range(1, 4):
        fill(memory, 3, second * SECOND)
    assert path.read_bytes() == before
    assert [record.message.partition(f"{path} ")[2][: len(text)] for record in caplog.records] == [text], "once"
