"""Who is alive in a run directory."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from pebble.errors import TransportError
from pebble.extensions.media.frames import FrameReader, FrameWriter
from pebble.transports import ZenohSettings, create
from pebble.transports.peers import FileLock, PeerRegistry, prepare_run_dir
from pebble.transports.zenoh.hub import ZenohHub
from tests.support import refused


def test_newcomers_are_connected_to_at_once_and_waited_for_when_ready(tmp_path: Path) -> None:
    registry = PeerRegistry(tmp_path)
    first, second = registry.register("first"), registry.register("second")
    assert set(registry.sockets()) == {first.socket, second.socket}
    assert registry.ready() == {}
    first.ready()
    assert registry.ready() == {first.name: "first"}
    assert registry.ready(but=first.name) == {}
    assert registry.sockets(but=first.name) == [second.socket]
    first.release()
    second.release()
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_lock_file_is_no_process(tmp_path: Path) -> None:
    (tmp_path / "folder.seat").mkdir()
    os.mkfifo(tmp_path / "pipe.seat")
    (tmp_path / "link.seat").symlink_to(tmp_path / "nowhere")
    assert PeerRegistry(tmp_path).sockets() == []


def test_a_lock_has_one_owner_and_comes_back(tmp_path: Path) -> None:
    first = FileLock.take(tmp_path / "lock")
    assert first is not None
    assert FileLock.take(tmp_path / "lock") is None
    first.release()
    again = FileLock.take(tmp_path / "lock")
    assert again is not None
    again.release()


def test_a_socket_path_that_is_too_long_is_an_error_that_names_the_setting(tmp_path: Path) -> None:
    longest = tmp_path / ("x" * (107 - len(f"{tmp_path}//12345678.sock")))
    prepare_run_dir(longest)
    assert longest.stat().st_mode & 0o777 == 0o700
    longer = tmp_path / f"{longest.name}x"
    with pytest.raises(TransportError, match=r"too long for a unix socket .*transport.run_dir"):
        prepare_run_dir(longer)
    assert not longer.exists()


USERS: dict[str, Callable[[Path], object]] = {
    "peer": lambda folder: create("zenoh", "peer", ZenohSettings(run_dir=folder)).open(0.0),
    "hub": lambda folder: ZenohHub(ZenohSettings(run_dir=folder)).open(),
    "reader": lambda folder: FrameReader(folder, "camera").open(),
    "writer": lambda folder: FrameWriter(folder, "camera", slots=2, capacity=100).open(),
}


@pytest.mark.parametrize("use", USERS.values(), ids=USERS)
def test_a_folder_that_another_user_made_is_used_by_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Callable[[Path], object]
) -> None:
    (tmp_path / "run").mkdir(mode=0o700)
    monkeypatch.setattr(os, "getuid", lambda: (tmp_path / "run").stat().st_uid + 1)
    with pytest.raises(TransportError, match=f"{tmp_path}/run(:| is not) .* user"):
        use(tmp_path / "run")


def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run").chmod(0o770)
    with pytest.raises(TransportError, match="others may write there"):
        prepare_run_dir(tmp_path / "run")
    assert (tmp_path / "run").stat().st_mode & 0o777 == 0o770, "it may be any folder, and not a robot's"


def test_a_full_disk_keeps_no_process_from_being_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registry = PeerRegistry(tmp_path)
    lock = registry.register("first")
    monkeypatch.setattr(os, "pwrite", refused(errno.ENOSPC))
    lock.ready()
    assert registry.ready() == {lock.name: "?"}
    lock.release()
    assert list(tmp_path.iterdir()) == []
