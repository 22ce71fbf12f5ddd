"""The audit log never blocks, and counts what it drops."""

from __future__ import annotations

import sqlite3
import threading
import time
from pathlib import Path

from pebble.fleet.audit import Audit
from tests.support import until


def test_entries_are_read_with_the_newest_last(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    before = time.time()
    for number in range(5):
        log.write(f"drive {number}", ref="pebble/robots/goob", user="alice", device="phone", address="::1", detail="x")
    assert until(lambda: len(log.read(10)) == 5)
    assert [entry.what for entry in log.read(2)] == ["drive 3", "drive 4"]
    entry = log.read(1)[0]
    assert (entry.ref, entry.user, entry.device, entry.address, entry.detail) == (
        "pebble/robots/goob",
        "alice",
        "phone",
        "::1",
        "x",
    )
    assert before <= entry.at <= time.time()
    log.close()


def test_entries_survive_and_are_written_at_the_end(tmp_path: Path) -> None:
    for number in range(2):
        log = Audit(tmp_path / "people.sqlite")
        for entry in range(100):
            log.write(f"run {number}", user=f"{entry}")
        log.close()
    log = Audit(tmp_path / "people.sqlite")
    assert len(log.read(1000)) == 200
    log.close()


def test_writing_never_blocks_and_what_does_not_fit_is_counted(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    blocker = sqlite3.connect(tmp_path / "people.sqlite", isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    start = time.monotonic()
    for number in range(3000):
        log.write(f"flood {number // 50}", ref=f"{number % 50}")
    assert time.monotonic() - start < 1.0
    assert log.dropped >= 500
    blocker.execute("ROLLBACK")
    blocker.close()
    log.close()
    log = Audit(tmp_path / "people.sqlite")
    assert sum(entry.count for entry in log.read(10_000)) == 3000
    assert "audit-dropped" in {entry.what for entry in log.read(10_000)}
    log.close()


def test_long_and_odd_texts_are_stored(tmp_path: Path) -> None:
    log = Audit(None)
    log.write("x" * 100_000, detail="\ud800 '; DROP TABLE audit; --")
    assert until(lambda: log.read(1))
    assert len(log.read(1)[0].what) == 200
    assert log.read(1)[0].detail == "? '; DROP TABLE audit; --"
    log.close()


def test_many_threads_write(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    threads = [threading.Thread(target=lambda: [log.write("x") for _ in range(500)]) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    log = Audit(tmp_path / "people.sqlite")
    assert sum(entry.count for entry in log.read(1000)) == 4000
    log.close()
