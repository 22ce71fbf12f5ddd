"""The hub's memory on disk: torn ends, damage, growth and full disks."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pebble.errors import TransportError
from pebble.transports.zenoh.hub import journal as journal_module
from pebble.transports.zenoh.hub.journal import Journal
from tests.support import until

RECORDS = [b"one", b"", b"\x00" * 5000, b"four"]


def written(path: Path, records: list[bytes]) -> None:
    journal = Journal(path)
    journal.rewrite(records[:1])
    for record in records[1:]:
        journal.append(record)
    journal.close()


def read(path: Path) -> list[bytes]:
    return list(Journal(path).load())


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


def test_damage_ends_the_journal_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "journal"
    written(path, RECORDS)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert read(path) == RECORDS[:2]
    assert f"journal {path} is damaged at byte" in caplog.text


def test_it_asks_for_a_rewrite_when_it_has_grown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "_SLACK_BYTES", 100)
    path = tmp_path / "journal"
    journal = Journal(path)
    journal.rewrite([b"start"])
    asked = [journal.append(b"x" * 20) for _ in range(5)]
    assert asked == [False] * 4 + [True]
    journal.rewrite([b"all"])
    assert not journal.append(b"more")
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


def test_a_full_disk_ends_the_journal_and_nothing_else(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal")
    journal.rewrite([b"x"])
    assert journal._file is not None
    with Path("/dev/full").open("wb") as full:
        os.dup2(full.fileno(), journal._file)
    assert not journal.append(b"lost")
    assert not journal.append(b"lost")
    assert caplog.text.count("nothing more will be stored") == 1
    journal.close()


@pytest.mark.parametrize("path", ["/proc/nowhere/journal", "/dev/null/journal"])
def test_a_place_that_cannot_be_written_is_an_error(path: str) -> None:
    with pytest.raises(TransportError, match="journal"):
        Journal(Path(path)).rewrite([])
