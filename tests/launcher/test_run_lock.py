from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pebble.config import LAUNCHER_LOCK
from pebble.errors import PebbleError
from pebble.launcher.run_lock import RunLock
from tests.support import refused


@pytest.mark.parametrize("mode", [None, 0o755])
def test_the_folder_is_for_this_user_alone(tmp_path: Path, mode: int | None) -> None:
    run = tmp_path / "a" / "b"
    if mode is not None:
        run.mkdir(mode, parents=True)
    with RunLock(run, "x/y/z", tmp_path / "state.lock") as lock:
        assert run.stat().st_mode & 0o777 == 0o700
        assert lock.path.read_text() == f"{os.getpid()}\nx/y/z\n"


def test_what_is_not_ours_to_lock_or_to_close_is_named(tmp_path: Path) -> None:
    (tmp_path / "lock" / LAUNCHER_LOCK).mkdir(parents=True)
    with pytest.raises(PebbleError, match=f"{LAUNCHER_LOCK} cannot be locked: Is a directory; remove it"):
        RunLock(tmp_path / "lock", "x/y/z", tmp_path / "state.lock").take()
    (run := tmp_path / "run").mkdir()
    run.chmod(0o1777)
    with pytest.raises(PebbleError, match="others may write there, name a folder of this user"):
        RunLock(run, "x/y/z", tmp_path / "state.lock").take()
    assert run.stat().st_mode & 0o7777 == 0o1777


def test_another_run_directory_does_not_make_another_robot(tmp_path: Path) -> None:
    lock = tmp_path / "state" / "launcher-x+y+z.lock"
    with RunLock(tmp_path / "by systemd", "x/y/z", lock):
        with pytest.raises(PebbleError, match=re.escape(f"x/y/z already runs: process {os.getpid()} holds {lock};")):
            RunLock(tmp_path / "by a shell", "x/y/z", lock).take()
        with RunLock(tmp_path / "by a shell", "x/y/another", tmp_path / "state" / "launcher-x+y+another.lock"):
            pass
    with RunLock(tmp_path / "by a shell", "x/y/z", lock):
        pass


@pytest.mark.parametrize("refuses", ["a state directory", "a disk with room"])
def test_a_robot_starts_all_the_same_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuses: str) -> None:
    state_lock = tmp_path / "state.lock"
    if refuses == "a state directory":
        (tmp_path / "file").touch()
        state_lock = tmp_path / "file" / "state.lock"
    else:
        monkeypatch.setattr(os, "pwrite", refused(errno.ENOSPC))
    unknown = pytest.raises(PebbleError, match=r"x/y/z already runs: process .* holds")
    with RunLock(tmp_path, "x/y/z", state_lock), unknown:
        RunLock(tmp_path, "x/y/z", state_lock).take()


@pytest.mark.parametrize("remove", [lambda run: shutil.rmtree(run), lambda run: (run / LAUNCHER_LOCK).unlink()])
def test_a_removed_lock_is_taken_again(tmp_path: Path, remove: Callable[[Path], object]) -> None:
    run, state_lock = tmp_path / "run", tmp_path / "state.lock"
    with RunLock(run, "x/y/z", state_lock) as lock:
        assert not lock.keep()
        remove(run)
        assert lock.keep()
        assert not lock.keep()
        assert lock.path.read_text() == f"{os.getpid()}\nx/y/z\n"
        with pytest.raises(PebbleError, match=f"holds {lock.path}"):
            RunLock(run, "x/y/other", tmp_path / "other.lock").take()


def test_a_lock_that_cannot_be_taken_again_is_reported_once_and_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = tmp_path / "run"
    with RunLock(run, "x/y/z", tmp_path / "state.lock") as lock:
        shutil.rmtree(run)
        run.write_text("in the way")
        assert not lock.keep()
        assert not lock.keep()
        assert [record.levelname for record in caplog.records] == ["ERROR"]
        run.unlink()
        assert lock.keep()
        assert lock.path.exists()


def test_a_robot_whose_lock_another_has_taken_stops(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with RunLock(run, "x/y/z", tmp_path / "state.lock") as lock:
        shutil.rmtree(run)
        with RunLock(run, "x/y/other", tmp_path / "other.lock"), pytest.raises(PebbleError, match="this robot stops"):
            lock.keep()
