"""``pebble setup --backup``: what is restored from it is the same robot; what is not whole is refused in one line."""

from __future__ import annotations

import io
import os
import stat
import subprocess
import sys
import tarfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.fleet import applying, certificates
from pebble.extensions.fleet.folder import load as load_fleet
from pebble.extensions.fleet.people import People
from pebble.extensions.install.commands import setup as command
from pebble.extensions.install.setup.backup import ABOUT, BackupError, make, packed, read, unpacked
from pebble.extensions.operator.places import Places
from pebble.extensions.scripts.perception.camera_model import CameraModel
from pebble.motion.latch import Latch
from pebble.motors.state_file import StateFile
from tests.commands.command_line import Run
from tests.ext.checks.installed import BROKER, MQTT, PAGE, PEOPLE, ROBOT, config_of, installed
from tests.support import ROOT


class Backup(Run):
    """``pebble setup --backup FILE`` on the machine below a root."""

    def of(self, root: Path, file: Path) -> int:
        self._monkeypatch.setattr(command, "Places", lambda: Places(root))
        return self("setup", "--backup", file)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Backup:
    return Backup(monkeypatch, capsys)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Places]:
    with installed(tmp_path_factory.mktemp("root")) as one:
        yield one


@pytest.fixture(scope="module")
def restored(places: Places, tmp_path_factory: pytest.TempPathFactory) -> Places:
    """Another root, with what is in the backup and nothing else."""
    new = Places(tmp_path_factory.mktemp("new"))
    for name, saved in unpacked(packed(make(places)), "goob.tar").files.items():
        file = new.root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(saved.content)
        file.chmod(saved.mode)
    return new


def _logs_in(places: Places) -> object:
    with closing(People(places.root / PEOPLE)) as people:
        return people.check("ann", PAGE, "10.0.0.1")


def _stop(places: Places) -> object:
    latch = Latch("new", 8, int.__sub__)
    latch.restore(StateFile(config_of(places).state_file("estop-serial")).load())
    return latch.latched, latch.saved()


def _accounts(places: Places) -> object:
    folder = places.root / BROKER
    return load_fleet(folder), applying.passwords_of(folder)


def _camera(places: Places) -> object:
    return CameraModel.find([places.etc]).matrix(640, 480).tolist()


NEEDED: dict[str, Callable[[Places], object]] = {
    "its config, with its password": lambda places: config_of(places).services.mqtt_bridge.remote_mqtt,
    "the page's own login": lambda places: str(config_of(places).web_interface.mqtt.password),
    "people log in": _logs_in,
    "the stop": _stop,
    "the page's certificate": lambda places: certificates.show(places.etc / "tls/server.pem").sha256,
    "the page's key": lambda places: (places.etc / "tls/server.key").read_bytes(),
    "the key of its authority": lambda places: (places.etc / "tls/ca.key").read_bytes(),
    "accounts at its broker": _accounts,
    "the broker's certificate": lambda places: certificates.show(places.root / BROKER / "server.pem").sha256,
    "the broker's configuration": lambda places: places.broker.read_text(),
    "the camera's calibration": _camera,
    "the wheels' calibration": lambda places: (places.etc / "auto_tune_state.json").read_text(),
}


@pytest.mark.parametrize("what", NEEDED)
def test_a_restored_robot_has(what: str, places: Places, restored: Places) -> None:
    before, after = NEEDED[what](places), NEEDED[what](restored)
    assert before
    assert repr(after).replace(str(restored.root), str(places.root)) == repr(before)


def test_what_is_not_in_it(places: Places) -> None:
    made = make(places)
    assert not [name for name in made.files if name.endswith((".mcap", "-wal", "-shm"))]
    assert made.left_out == {str(places.state / "recordings"): "recordings"}
    assert all(not name.startswith(("/", "..")) for name in made.files)


def test_the_command(places: Places, tmp_path: Path, run: Backup) -> None:
    file = tmp_path / "goob.tar"
    before = os.umask(0)
    try:
        assert run.of(places.root, file) == 0
    finally:
        os.umask(before)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert "It holds passwords and private keys" in run.err
    assert f"not in it: {places.state / 'recordings'}: recordings" in run.out
    assert not [one for one in (PAGE, MQTT, ROBOT) if one in run.out + run.err]
    about = read(file).about
    assert (about.format, about.id) == (1, "goob")
    first = file.read_bytes()
    assert run.of(places.root, file) == 2
    assert "exists: name another file" in run.err
    assert file.read_bytes() == first
    listed = subprocess.run(["tar", "tf", file], capture_output=True, text=True, check=True).stdout.splitlines()
    assert (listed[0], "etc/pebble/robot.json" in listed) == (ABOUT, True)


def test_others_cannot_read_it_from_its_first_byte_on(places: Places, tmp_path: Path) -> None:
    """The call that makes the file makes it so."""
    file, log = tmp_path / "goob.tar", tmp_path / "calls"
    audit = (
        "import sys, os, pathlib\n"
        "from pebble.extensions.install.commands.setup import back_up\n"
        "from pebble.extensions.operator.places import Places\n"
        f"log = open({str(log)!r}, 'w')\n"
        f"sys.addaudithook(lambda name, arguments: name == 'open' and arguments[0] == {str(file)!r}\n"
        "    and print(arguments[2], os.umask(os.umask(0)), os.path.exists(arguments[0]), file=log))\n"
        f"back_up(pathlib.Path({str(file)!r}), Places(pathlib.Path({str(places.root)!r})))\n"
    )
    subprocess.run([sys.executable, "-c", audit], cwd=ROOT, check=True, capture_output=True)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    flags, _, existed = log.read_text().splitlines()[0].split()
    assert (int(flags) & os.O_EXCL != 0, existed) == (True, "False")


def test_nothing_is_left_of_one_that_cannot_be_made(tmp_path: Path, run: Backup) -> None:
    file = tmp_path / "goob.tar"
    with installed(tmp_path / "root") as broken:
        pass  # its database is closed
    (broken.root / PEOPLE).write_bytes(b"SQLite format 3\0" + bytes(4000))
    assert run.of(broken.root, file) == 1
    assert "people.sqlite: is" in run.err
    assert len(run.err.splitlines()) == 1
    assert run.of(tmp_path / "elsewhere", file) == 1
    assert "no robot is installed there" in run.err
    assert run.of(tmp_path / "elsewhere", tmp_path / "no" / "folder") == 1
    assert not file.exists()


def _tar(*members: tuple[str, bytes], kind: bytes = tarfile.REGTYPE) -> bytes:
    output = io.BytesIO()
    with tarfile.open(fileobj=output, mode="w") as tar:
        for name, content in members:
            one = tarfile.TarInfo(name)
            one.size, one.type, one.linkname = (len(content) if kind == tarfile.REGTYPE else 0), kind, "/etc/passwd"
            one.type = tarfile.REGTYPE if name == ABOUT else kind
            one.size = len(content)
            tar.addfile(one, io.BytesIO(content))
    return output.getvalue()


ABOUT_IT = (ABOUT, b'{"format": 1, "version": "0.1", "id": "goob"}')
FOREIGN: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "is no backup of Pebble"),
    "a picture": (b"\xff\xd8\xff" * 5000, "is no backup of Pebble"),
    "zeros": (bytes(20_000), "is no backup of Pebble"),
    "another tar": (_tar(("etc/passwd", b"x")), "does not begin with backup.json"),
    "not JSON": (_tar((ABOUT, b"{")), "is not of a backup"),
    "no id": (_tar((ABOUT, b'{"format": 1, "version": "0.1"}')), "is not of a backup"),
    "a later format": (_tar((ABOUT, b'{"format": 2, "version": "0.9", "id": "x"}')), "of Pebble 0.9: update Pebble"),
    "absolute": (_tar(ABOUT_IT, ("/etc/shadow", b"x")), "'/etc/shadow' is not what a backup has"),
    "beyond the root": (_tar(ABOUT_IT, ("etc/../../x", b"x")), "is not what a backup has"),
    "a link": (_tar(ABOUT_IT, ("etc/x", b""), kind=tarfile.SYMTYPE), "is not what a backup has"),
    "a device": (_tar(ABOUT_IT, ("etc/x", b""), kind=tarfile.CHRTYPE), "is not what a backup has"),
    "twice": (_tar(ABOUT_IT, ("etc/x", b"1"), ("etc/x", b"2")), "is in it twice"),
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
