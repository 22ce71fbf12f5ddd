"""What commands do as root: nothing by a path below a folder of another user, who could put a link there."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from pebble.extensions.install.commands import setup as command
from pebble.extensions.install.setup import system
from pebble.extensions.install.setup.system import MOSQUITTO, ROBOT, System
from pebble.extensions.operator.places import Places
from tests.commands.command_line import Run
from tests.ext.install.setup.rig import answers_in, machine_root
from tests.support import needs_root

OWNERS = {ROBOT: (65534, 65534), MOSQUITTO: (1, 1)}
_ACTS = (
    "open",
    "sqlite3.connect",
    "os.chmod",
    "os.chown",
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.symlink",
)
_watched: list[str] = []  # folders
_acts: set[str] = set()


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if _watched and event in _ACTS and os.geteuid() == 0:
        paths = [str(path).removeprefix("file://") for path in arguments[:2]]
        _acts.update(f"{event} {path}" for path in paths if path.startswith(tuple(_watched)))


@contextmanager
def watched(*roots: Path) -> Iterator[None]:
    _acts.clear()
    _watched[:] = [f"{folder}/" for root in roots for folder in (Places(root).state, Places(root).broker_folder)]
    try:
        yield
    finally:
        _watched.clear()


@needs_root
def test_in_folders_of_others_root_is_their_owner(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sys.addaudithook(_watch)
    run = Run(monkeypatch, capsys)
    with TemporaryDirectory() as name:
        place = Path(name)
        place.chmod(0o755)
        here, other = (machine_root(place / folder) for folder in ("here", "other"))
        for root in (here, other):
            os.chown(Places(root).state, *OWNERS[ROBOT])
        people, hall = Places(here).people, Places(here).broker_folder

        def at(root: Path) -> None:
            monkeypatch.setattr(system, "System", lambda: System(Places(root), run=print, owner=OWNERS.get))
            monkeypatch.setattr(command, "Places", lambda: Places(root))

        at(here)
        with watched(here, other):
            run("setup", "--answers", answers_in(place))
            run("setup", "--answers", answers_in(place, camera="none", user="bob"))
            for words in (("list",), ("add", "ann", "--role", "viewer"), ("role", "ann", "driver")):
                assert run("fleet", *words, "--folder", hall) == 0, run.err
            for words in (
                ("add", "p", "--role", "page", "--people", people),
                ("certificate", "ann"),
                ("password", "ann"),
            ):
                assert run("fleet", *words, "--folder", hall) == 0, run.err
            run("fleet", "check", "--folder", hall)
            run("fleet", "remove", "ann", "--folder", hall)
            assert "ann is removed from the people of p and logged out there" in run.out, run.err
            assert run("web", "user", "list", "--people", people) == 0, run.err
            assert run.out.split() == ["bob", "admin"]
            assert run("web", "audit", "--people", people) == 0
            assert run("fleet", "audit", Places(here).config) == 0
            for words in (("init", "a.local"), ("renew",), ("show",)):
                assert run("cert", *words, "--folder", people.parent / "tls") == 0, run.err
            assert run("recordings", "mend", people.parent) == 0, run.err
            assert run("setup", "--backup", place / "goob.tar") == 0, run.err
            at(other)
            run("setup", "--from", place / "goob.tar")
        assert not _acts
        assert (people.parent / "tls/ca.key").stat().st_uid == OWNERS[ROBOT][0]
        assert Places(other).people.stat().st_uid == OWNERS[ROBOT][0]
        assert {path.lstat().st_uid for path in Places(other).broker_folder.iterdir()} == {OWNERS[MOSQUITTO][0]}
