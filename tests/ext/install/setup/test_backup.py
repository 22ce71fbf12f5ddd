"""``pebble setup --backup``: what is restored from it is the same robot; what is not whole is refused in one line."""

from __future__ import annotations

import os
import stat
import subprocess
import tarfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.fleet.people import People
from pebble.extensions.install.setup.backup import ABOUT, BackupError, make, packed, read, unpacked
from pebble.extensions.operator.places import Places
from tests.commands.command_line import Run
from tests.ext.checks.installed import MQTT, PAGE, PEOPLE, ROBOT, installed
from tests.ext.install.setup.conftest import at
from tests.ext.install.setup.rig import tar_of


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Places]:
    with installed(tmp_path_factory.mktemp("root")) as one:
        yield one


def test_all_files_but_recordings_are_in_it_as_they_are(places: Places, tmp_path: Path) -> None:
    """Config, passwords, keys, certificates, accounts at the broker, people, the stop, calibrations."""
    made = make(places)
    files = unpacked(packed(made), "goob.tar").files
    there = {str(path.relative_to(places.root)): path for path in places.root.rglob("*") if path.is_file()}
    left_out = {name for name in there if name.endswith((".mcap", "-wal", "-shm"))}
    assert made.left_out == {str(places.state / "recordings"): "recordings"}
    assert files.keys() == there.keys() - left_out
    database = tmp_path / "people.sqlite"
    database.write_bytes(files.pop(str(PEOPLE)).content)
    with closing(People(database)) as people:
        assert people.check("ann", PAGE, "10.0.0.1"), "though it is open, with changes in its journal"
    for name, saved in files.items():
        assert (saved.content, saved.mode) == (there[name].read_bytes(), stat.S_IMODE(there[name].stat().st_mode)), name


def test_the_command(places: Places, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    at(places.root, monkeypatch)
    file = tmp_path / "goob.tar"
    before = os.umask(0)
    try:
        assert run("setup", "--backup", file) == 0
    finally:
        os.umask(before)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert not [one for one in (PAGE, MQTT, ROBOT) if one in run.out + run.err]
    assert read(file).about.id == "goob"
    first = file.read_bytes()
    assert run("setup", "--backup", file) == 2
    assert "exists: name another file" in run.err
    assert file.read_bytes() == first
    (link := tmp_path / "link.tar").symlink_to(tmp_path / "of-another")
    assert run("setup", "--backup", link) == 1
    assert not link.exists(), "what another put there leads nowhere"
    listed = subprocess.run(["tar", "tf", file], capture_output=True, text=True, check=True).stdout.splitlines()
    assert (listed[0], "etc/pebble/robot.json" in listed) == (ABOUT, True)


def test_nothing_is_left_of_one_that_cannot_be_made(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "goob.tar"
    with installed(tmp_path / "other") as broken:
        pass  # its database is closed
    (broken.root / PEOPLE).write_bytes(b"SQLite format 3\0" + bytes(4000))
    at(broken.root, monkeypatch)
    assert run("setup", "--backup", file) == 1
    assert "people.sqlite: is" in run.err
    at(tmp_path / "elsewhere", monkeypatch)
    assert run("setup", "--backup", file) == 1
    assert "no robot is installed there" in run.err
    assert not file.exists()


ABOUT_IT = (ABOUT, b'{"format": 1, "version": "0.1", "id": "goob"}')
FOREIGN: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "is no backup of Pebble"),
    "a picture": (b"\xff\xd8\xff" * 5000, "is no backup of Pebble"),
    "another tar": (tar_of(("etc/passwd", b"x")), "does not begin with backup.json"),
    "no id": (tar_of((ABOUT, b'{"format": 1, "version": "0.1"}')), "is not of a backup"),
    "a later format": (tar_of((ABOUT, b'{"format": 2, "version": "0.9", "id": "x"}')), "of Pebble 0.9: update Pebble"),
    "absolute": (tar_of(ABOUT_IT, ("/etc/shadow", b"x")), "'/etc/shadow' is not what a backup has"),
    "beyond the root": (tar_of(ABOUT_IT, ("etc/../../x", b"x")), "is not what a backup has"),
    "a link": (tar_of(ABOUT_IT, ("etc/x", b""), kind=tarfile.SYMTYPE), "is not what a backup has"),
    "a hole": (tar_of(ABOUT_IT, ("etc/x", b""), kind=tarfile.GNUTYPE_SPARSE), "is not what a backup has"),
    "a device": (tar_of(ABOUT_IT, ("etc/x", b""), kind=tarfile.CHRTYPE), "is not what a backup has"),
    "a broken name": (tar_of(ABOUT_IT, ("etc/./x", b"x")), "is not what a backup has"),
    "twice": (tar_of(ABOUT_IT, ("etc/x", b"1"), ("etc/x", b"2")), "is in it twice"),
}


@pytest.mark.parametrize("what", FOREIGN)
def test_what_is_no_backup_is_refused_in_one_line(what: str) -> None:
    raw, why = FOREIGN[what]
    with pytest.raises(BackupError, match=r"\Ax\.tar: [^\n]+\Z") as refused:
        unpacked(raw, "x.tar")
    assert why in str(refused.value)


def test_a_torn_or_damaged_one_is_never_taken_for_whole(places: Places) -> None:
    """Cut at any block, or with a byte changed in any header or file."""
    whole = packed(make(places))
    wanted = unpacked(whole, "x.tar").files
    end = len(whole.rstrip(b"\0"))
    for cut in range(0, end + 512, 509):
        with pytest.raises(BackupError):
            unpacked(whole[:cut], "x.tar")
    for place in range(600, end, 401):
        damaged = whole[:place] + bytes([whole[place] ^ 0x5A]) + whole[place + 1 :]
        assert _files_of(damaged) in (None, wanted), place  # a header has fields that mean nothing here


def _files_of(raw: bytes) -> Any:
    try:
        return unpacked(raw, "x.tar").files
    except BackupError:
        return None
