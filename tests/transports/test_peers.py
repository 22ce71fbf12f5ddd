"""Who is alive in a run directory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pebble.errors import TransportError
from pebble.transports.peers import FileLock, PeerRegistry, prepare_run_dir
from tests.support import ROOT

SIT = """
import sys, pathlib
from pebble.transports.peers import PeerRegistry
lock = PeerRegistry(pathlib.Path(sys.argv[1])).register("sitter")
lock.socket.touch()
lock.ready()
print(lock.name, flush=True)
sys.stdin.readline()
"""


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


def test_the_dead_are_cleared_away(tmp_path: Path) -> None:
    sitter = subprocess.Popen(
        [sys.executable, "-c", SIT, str(tmp_path)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert sitter.stdout is not None
    name = sitter.stdout.readline().strip()
    (tmp_path / f"{name}.sock.lock").touch()
    assert PeerRegistry(tmp_path).ready() == {name: "sitter"}
    sitter.kill()
    sitter.communicate(timeout=10)
    assert PeerRegistry(tmp_path).ready() == {}
    assert list(tmp_path.iterdir()) == []


def test_a_lock_has_one_owner_and_comes_back(tmp_path: Path) -> None:
    first = FileLock.take(tmp_path / "lock")
    assert first is not None
    assert FileLock.take(tmp_path / "lock") is None
    first.release()
    again = FileLock.take(tmp_path / "lock")
    assert again is not None
    again.release()


def folder_for_socket_path(tmp_path: Path, length: int) -> Path:
    return tmp_path / ("x" * (length - len(f"{tmp_path}//12345678.sock")))


def test_the_longest_socket_path(tmp_path: Path) -> None:
    run_dir = folder_for_socket_path(tmp_path, 107)
    prepare_run_dir(run_dir)
    assert run_dir.stat().st_mode & 0o777 == 0o700


def test_a_longer_socket_path_is_an_error_that_names_the_setting(tmp_path: Path) -> None:
    run_dir = folder_for_socket_path(tmp_path, 108)
    with pytest.raises(TransportError, match=r"too long for a unix socket .*transport.run_dir"):
        prepare_run_dir(run_dir)
    assert not run_dir.exists()
