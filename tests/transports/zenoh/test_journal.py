"""The hub's memory on disk: torn ends, damage, growth, and disks that are full or missing."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pebble.transports.zenoh.hub import journal as journal_module
from pebble.transports.zenoh.hub.journal import Journal
from tests.support import until

RECORDS = [b"one", b"", b"\x00" * 5000, b"four"]


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


def written(path: Path, records: list[bytes]) -> None:
    journal = Journal(path)
    journal.rewrite(records[:1])
    for record in records[1:]:
        journal.append(record)
    journal.close()


def read(path: Path) -> list[bytes]:
    records = Journal(path).load()
    assert records is not None
    return records


def test_what_was_appended_is_loaded_in_order(tmp_path: Path) -> None:
    written(tmp_path / "deep" / "journal", RECORDS)
    assert read(tmp_path / "deep" / "journal") == RECORDS
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["journal"]


def test_no_file_is_an_empty_journal(tmp_path: Path) -> None:
    assert read(tmp_path / "journal") == []


def test_every_torn_end_leaves_what_was_whole(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    written(path, [b"first", b"second"])
    whole = path.read_bytes()
    boundary = len(whole) // 2  # b"second" is one byte longer
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert read(path) == [b"first", b"second"][: (size >= boundary) + (size == len(whole))]


def test_damage_ends_the_journal_with_a_warning_and_what_follows_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "journal"
    written(path, RECORDS)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert read(path) == RECORDS[:2]
    assert f"journal {path} is damaged at byte" in caplog.text
    aside = tmp_path / "journal.bad"
    assert data.endswith(aside.read_bytes())
    assert len(aside.read_bytes()) > 5000
    assert aside.stat().st_mode & 0o777 == 0o600


def test_it_asks_for_a_rewrite_when_it_has_grown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "_SLACK_BYTES", 100)
    path = tmp_path / "journal"
    journal = Journal(path)
    journal.rewrite([b"start"])
    asked = []
    for _ in range(5):
        journal.append(b"x" * 20)
        asked.append(journal.rewrite_due)
    assert asked == [False] * 4 + [True]
    journal.rewrite([b"all"])
    journal.append(b"more")
    assert not journal.rewrite_due
    journal.close()
    assert read(path) == [b"all", b"more"]


def test_it_reaches_the_disk_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr(journal_module, "SYNC_S", 0.01)
    journal = Journal(tmp_path / "journal")
    journal.rewrite([])
    monkeypatch.setattr(os, "fdatasync", synced.append)
    journal.append(b"x")
    assert until(lambda: synced)
    journal.close()


def test_after_a_moment_of_full_disk_everything_is_written_again(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    clock, path = Clock(), tmp_path / "journal"
    journal = Journal(path, clock=clock)
    journal.rewrite([b"old"])
    (opened,) = (int(link.name) for link in Path("/proc/self/fd").iterdir() if os.path.realpath(link) == str(path))
    with Path("/dev/full").open("wb") as full:
        os.dup2(full.fileno(), opened)
    for _ in range(2):
        journal.append(b"new")
    assert caplog.text.count("No space left on device") == 1
    assert (journal.rewrite_due, journal.wait_s) == (False, 30)
    clock.now += 30
    assert (journal.rewrite_due, journal.wait_s) == (True, 0)
    journal.rewrite([b"new"])
    journal.append(b"later")
    assert not journal.rewrite_due
    journal.close()
    assert read(path) == [b"new", b"later"]


def test_a_disk_that_fails_to_sync_is_tried_again(
    caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_descriptor: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    clock = Clock()
    monkeypatch.setattr(journal_module, "SYNC_S", 0.01)
    journal = Journal(tmp_path / "journal", clock=clock)
    journal.rewrite([])
    with monkeypatch.context() as broken:
        broken.setattr(os, "fdatasync", fail)
        journal.append(b"x")
        assert until(lambda: "Input/output error" in caplog.text)
    clock.now += 30
    assert journal.rewrite_due
    journal.close()


def test_a_rewrite_that_fails_leaves_the_file_as_it_was_and_takes_no_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    clock, path = Clock(), tmp_path / "journal"
    journal = Journal(path, clock=clock)
    journal.rewrite([b"one"])
    monkeypatch.setattr(os, "fdatasync", fail)
    for _ in range(2):
        journal.rewrite([b"one", b"two"])
    assert caplog.text.count("No space left on device") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["journal"]
    journal.append(b"three")
    assert not journal.rewrite_due
    journal.close()
    assert read(path) == [b"one", b"three"]


@pytest.mark.parametrize("back", [True, False])
@pytest.mark.parametrize(
    "remove",
    [
        lambda folder: shutil.rmtree(folder),
        lambda folder: folder.rename(folder.with_name("unmounted")),
        lambda folder: (folder / "journal").unlink(),
        lambda folder: (folder / "journal").rename(folder / "kept"),
    ],
)
def test_a_file_that_was_removed_is_written_anew(
    tmp_path: Path, remove: Callable[[Path], object], back: bool, caplog: pytest.LogCaptureFixture
) -> None:
    clock, path = Clock(), tmp_path / "state" / "journal"
    journal = Journal(path, clock=clock)
    journal.rewrite([b"one"])
    remove(path.parent)
    if not back:
        shutil.rmtree(path.parent, ignore_errors=True)
        path.parent.write_text("in the way")
    journal.append(b"two")
    assert journal.rewrite_due
    journal.rewrite([b"one", b"two"])
    if not back:
        assert not journal.rewrite_due
        path.parent.unlink()
        clock.now += 30
        assert journal.rewrite_due
        journal.rewrite([b"one", b"two"])
    journal.append(b"three")
    assert not journal.rewrite_due
    assert [record.levelname for record in caplog.records].count("WARNING" if back else "ERROR") == 1
    journal.close()
    assert read(path) == [b"one", b"two", b"three"]


@pytest.mark.parametrize("path", ["/proc/nowhere/journal", "/dev/null/journal"])
def test_a_place_that_cannot_be_written_is_tried_again(path: str, caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    journal = Journal(Path(path), clock=clock)
    assert not journal.load()
    journal.rewrite([])
    journal.append(b"not stored")
    assert caplog.text.count(path) == 1
    clock.now += 30
    assert journal.rewrite_due
    journal.close()


def test_a_file_that_cannot_be_read_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    path.mkdir()
    assert Journal(path).load() is None
