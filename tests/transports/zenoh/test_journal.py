"""The hub's memory on disk: kills, damage, and disks that are full or missing."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pebble.transports.zenoh.hub import journal as journal_module
from pebble.transports.zenoh.hub.journal import Journal
from tests.small_disk import SmallDisk
from tests.support import Clock, needs_root, until

RECORDS = [("a", b"one"), ("b", b""), ("c", b"\x00" * 5000), ("d", b"four")]
BYTES = [record for _, record in RECORDS]


def begun(path: Path, clock: Clock | None = None) -> Journal:
    journal = Journal(path, clock=clock or Clock())
    assert journal.load() == []
    journal.rewrite([])
    return journal


def read(path: Path) -> list[bytes]:
    journal = Journal(path)
    try:
        return journal.load()
    finally:
        journal.close()


def test_what_was_put_is_loaded_in_order_and_what_was_removed_is_not(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "journal"
    journal = begun(path)
    for name, record in [("a", b"old"), ("gone", b"x"), *RECORDS]:
        journal.put(name, record)
    journal.put("gone", None)
    assert read(path) == BYTES, "before it is closed: the hub may be killed"
    journal.close()
    assert read(path) == BYTES
    assert [(file.name, file.stat().st_mode & 0o777) for file in path.parent.iterdir()] == [("journal", 0o600)]


@pytest.mark.parametrize(
    "damage",
    [
        lambda _whole: b"\x00\x00\x00\x05\x12\x34\x56\x78of an earlier version",
        lambda whole: whole[:5000],
        lambda whole: whole[:4096] + b"\xff" * (len(whole) - 4096),
    ],
)
def test_a_damaged_file_is_set_aside_with_a_warning(
    tmp_path: Path, damage: Callable[[bytes], bytes], caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "journal"
    journal = begun(path)
    journal.rewrite(RECORDS)
    journal.close()
    damaged = damage(path.read_bytes())
    path.write_bytes(damaged)
    journal = begun(path)
    assert f"journal {path} is damaged" in caplog.text
    assert (tmp_path / "journal.bad").read_bytes() == damaged
    journal.put("a", b"new")
    journal.close()
    assert read(path) == [b"new"]


@needs_root
def test_after_a_moment_of_full_disk_everything_is_written_again(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level("INFO")
    disk, clock = SmallDisk(tmp_path / "disk"), Clock()
    disk.mount()
    try:
        journal = begun(disk.root / "journal", clock)
        with disk.full():
            for name in "ab":
                journal.put(name, bytes(100_000))
            assert caplog.text.count("is full") == 1
            assert journal.rewrite_at == clock.now + 30
            journal.rewrite([("a", bytes(100_000))])
            assert caplog.text.count("is full") == 1
        journal.rewrite([("a", b"new")])
        journal.put("b", b"later")
        assert journal.rewrite_at == float("inf")
        assert "is written again" in caplog.text
        journal.close()
        assert read(disk.root / "journal") == [b"new", b"later"]
    finally:
        disk.unmount()


def test_a_file_that_was_removed_is_written_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "SYNC_S", 0.01)
    path = tmp_path / "state" / "journal"
    journal = begun(path)
    shutil.rmtree(path.parent)
    journal.put("b", b"two")
    assert until(lambda: journal.rewrite_at == 1030)
    journal.rewrite([("a", b"one"), ("b", b"two")])
    journal.close()
    assert read(path) == [b"one", b"two"]


def test_a_place_that_cannot_be_written_is_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    journal = begun(Path(path := "/dev/null/journal"))
    journal.put("a", b"not stored")
    assert caplog.text.count(path) == 1
    assert journal.rewrite_at == 1030
    journal.close()


def test_what_could_not_be_read_stays(tmp_path: Path) -> None:
    path, away = tmp_path / "journal", tmp_path / "away"
    journal = begun(path)
    journal.rewrite([("a", b"old"), ("b", b"old")])
    journal.close()
    path.rename(away)
    path.mkdir()
    journal = begun(path)
    path.rmdir()
    away.rename(path)
    journal.rewrite([("b", b"new")])
    journal.close()
    assert read(path) == [b"old", b"new"]
