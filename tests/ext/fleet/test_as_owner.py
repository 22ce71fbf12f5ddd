"""What root does in folders of other users, it does as they: their links lead it nowhere."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from pebble import ownership
from pebble.config import load
from pebble.errors import PebbleError
from pebble.extensions.checks.new_file import write_new
from pebble.extensions.checks.report.report import make
from pebble.extensions.checks.report.secrets_here import secrets_of
from pebble.extensions.fleet import applying
from pebble.extensions.fleet.applying import pid_of
from pebble.extensions.fleet.folder import PID, Fleet, FleetError, Server
from pebble.extensions.fleet.folder import load as load_fleet
from pebble.extensions.fleet.people import People
from pebble.extensions.install.setup.answers import read_file
from pebble.extensions.lab.simulation.world import program
from pebble.extensions.operator.places import Places
from pebble.extensions.page.commands.people import opened
from pebble.extensions.recordings.commands.files import mend
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.recorder.folder import Folder
from pebble.extensions.recordings.recorder.metrics import STATUS
from pebble.launcher.launcher import Launcher
from pebble.ownership import owner_of
from pebble.runtime.as_owner import as_before, as_owner, require_own
from pebble.services.autonomy_manager.catalogue import Catalogue
from pebble.services.autonomy_manager.script import Script
from tests.support import Child, needs_root, until

NOBODY = 65534
pytestmark = needs_root


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that every user may enter; those of pytest are their owner's alone."""
    with TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


def people(folder: Path) -> None:
    with opened(folder / "file") as database:
        database.list()


def page(folder: Path) -> None:
    People(folder / "file").close()


def new(folder: Path) -> None:
    write_new(folder / "file", b"written")


def text(folder: Path) -> None:
    with as_owner(folder):
        (folder / "file").write_text("written")


@pytest.mark.parametrize("write", [people, page, text, new])
@pytest.mark.parametrize("there", [False, True])
def test_a_link_leads_it_nowhere(write: Callable[[Path], None], there: bool, place: Path) -> None:
    roots, folder = place / "roots", place / "theirs"
    roots.mkdir(0o755)
    folder.mkdir()
    if there:
        (roots / "file").write_text("of root")
        (roots / "file").chmod(0o644)
    os.chown(folder, NOBODY, NOBODY)
    (folder / "file").symlink_to(roots / "file")
    with pytest.raises((PebbleError, PermissionError)):
        write(folder)
    left = [(path.read_text(), path.stat().st_mode & 0o777) for path in roots.iterdir()]
    assert left == ([("of root", 0o644)] if there else [])
    assert os.geteuid() == 0
    assert {path.stat().st_uid for path in roots.iterdir()} <= {0}


def test_what_it_writes_is_theirs_and_a_link_is_no_folder(place: Path) -> None:
    folder = place / "theirs"
    folder.mkdir()
    os.chown(folder, NOBODY, 0)
    with opened(folder / "people.sqlite"), as_before():
        assert os.geteuid() == 0
    assert (folder / "people.sqlite").stat().st_uid == NOBODY
    (place / "link").symlink_to(folder)
    with as_owner(place / "link"):
        assert os.geteuid() == NOBODY, "a link of root's is followed"
        assert 0 not in (os.getegid(), *os.getgroups()), "the group of a folder may be that of the one above"
    assert os.geteuid() == 0
    with os.popen("true") as pipe:
        assert owner_of(Path(f"/dev/fd/{pipe.fileno()}"), there=True).uid == 0, "pebble check <(jq … robot.json)"


def test_a_number_in_a_folder_of_others_aims_no_signal(place: Path) -> None:
    with Child([sys.executable, "-c", "import time; time.sleep(60)", "/etc/mosquitto.conf"]) as process:
        (place / PID).write_text(str(process.pid))
        assert pid_of(place) is None
        process.kill()
    applying.make(place / "hall", Fleet(level="login", brokers=(Server(host="127.0.0.1"),)))
    shutil.copy("/bin/sleep", place / "mosquitto")
    with Child([str(place / "mosquitto"), "60"]) as process:  # SIGHUP would end it
        (place / "hall" / PID).write_text(str(process.pid))
        assert until(lambda: pid_of(place / "hall"))
        with pytest.raises(FleetError, match="would end by SIGHUP"):
            applying.apply(place / "hall", load_fleet(place / "hall"))
        assert process.poll() is None
        process.kill()


def linked(theirs: Path) -> Path:
    (theirs / "link").symlink_to(theirs.parent / "roots")
    return theirs / "link" / "deeper"


def circle(theirs: Path) -> Path:
    (theirs.parent / "roots" / "there").symlink_to("back")
    (back := theirs.parent / "roots" / "back").symlink_to("there")
    return back / "deeper"


def of_root(theirs: Path) -> Path:
    (theirs / "roots").mkdir()
    return theirs / "roots"


def shared(theirs: Path) -> Path:
    (theirs.parent / "roots").chmod(0o777)
    return theirs.parent / "roots" / "new"


def open_file(theirs: Path) -> Path:
    (file := theirs.parent / "roots" / "robot.json").touch()
    file.chmod(0o666)
    return file


def listed(theirs: Path) -> Path:
    """A folder of root's whose access control list lets nobody write: as setfacl -m u:nobody:rwx makes it."""
    entries = ((1, 7, -1), (2, 7, NOBODY), (4, 5, -1), (16, 7, -1), (32, 5, -1))  # user, one user, group, most, others
    packed = b"".join(struct.pack("<HHi", *entry) for entry in entries)
    try:
        os.setxattr(theirs.parent / "roots", "system.posix_acl_access", struct.pack("<I", 2) + packed)
    except OSError as error:
        if error.errno != errno.ENOTSUP:
            raise
        pytest.skip("this file system has no access control lists")
    return theirs.parent / "roots" / "new"


@pytest.mark.parametrize(
    ("path_of", "why"),
    [
        (linked, "is a link of user 65534"),
        (circle, "leads back to itself: remove it"),
        (of_root, "lies in a folder of user 65534"),
        (shared, "others may write"),
        (open_file, "others may write"),
        (listed, "others may write"),
    ],
)
def test_where_others_could_put_a_folder_it_does_nothing(
    path_of: Callable[[Path], Path], why: str, place: Path
) -> None:
    roots, folder = place / "roots", place / "theirs"
    roots.mkdir(0o755)
    folder.mkdir()
    os.chown(folder, NOBODY, NOBODY)
    path = path_of(folder)
    with pytest.raises(PebbleError, match=why), as_owner(path):
        pass
    with pytest.raises(PebbleError, match=why):
        write_new(path, b"")


def config(theirs: Path, **services: object) -> Path:
    """Return a config of a user, and of this user all else that is there."""
    file = theirs / "robot.json"
    file.write_text(json.dumps({"robot": {"id": "goob"}, "services": services}))
    for path in (theirs, *theirs.rglob("*")):
        os.chown(path, NOBODY, NOBODY)
    return file


def password(theirs: Path, secret: Path) -> object:
    return load(config(theirs, mqtt_bridge={"remote_mqtt": {"username": "a", "password_file": str(secret)}}))


def answers(theirs: Path, secret: Path) -> object:
    (file := config(theirs)).write_text(json.dumps({"broker_password_file": str(secret)}))
    return read_file(file)[1].broker_password


def robot(theirs: Path, _: Path) -> object:
    return Launcher(load(config(theirs))).run()


def script(theirs: Path, _: Path) -> object:
    (theirs / "autonomy/walk").mkdir(parents=True)
    (theirs / "autonomy/walk/run.py").touch()
    found: list[dict[str, Script]] = []
    Catalogue(load(config(theirs))).scan(found.append)
    return found[-1]["walk"].broken


def report(theirs: Path, secret: Path) -> object:
    (theirs.parent / "var/lib").mkdir(parents=True)
    theirs.rename(theirs.parent / "var/lib/pebble")
    (theirs.parent / "var/lib/pebble/password").symlink_to(secret)
    known = secrets_of(Places(theirs.parent), None)
    return f"denied: {known.unread}, {known.known}" if known.unread else known.known


def container(theirs: Path, _: Path) -> object:
    os.chown(theirs, 100_999, 100_999)  # of no user, but of one in a container
    require_own(theirs)
    return "root goes on"


def everybody(theirs: Path, _: Path) -> object:
    theirs.chmod(0o1777)
    os.chown(theirs, 0, 0)
    return People(theirs / "people.sqlite")


def world(theirs: Path, _: Path) -> object:
    theirs.rename(theirs.with_name("pebble-world-room"))  # in the folder for temporary files
    return program.run(program.ROOM)


def recordings(theirs: Path, secret: Path) -> object:
    (theirs / f".{STATUS}.part").symlink_to(secret)
    return Folder(theirs).take()


def holes(theirs: Path, _: Path) -> object:
    (theirs / "fleet.json").touch()
    os.truncate(theirs / "fleet.json", 1 << 40)
    return load_fleet(theirs)


def lines(theirs: Path, _: Path) -> object:
    applying.make(theirs / "x\nuser root", Fleet(level="login", brokers=(Server(host="127.0.0.1"),)))
    return "made"


def copy(theirs: Path, _: Path) -> object:
    with (theirs / "a.mcap").open("wb", buffering=0) as file:
        RecordingWriter(file).finish()
    config(theirs)
    mend(theirs / "a.mcap", theirs / "b.mcap")
    owner = (theirs / "b.mcap").stat().st_uid
    return f"belongs to user {owner}" if owner else "a link in its place would lead root"


@pytest.mark.parametrize(
    "act", [password, answers, robot, script, report, container, everybody, world, recordings, holes, lines, copy]
)
def test_what_a_user_names_root_neither_reads_nor_runs(
    act: Callable[[Path, Path], object], place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (secret := place / "secret").write_text("of root")
    secret.chmod(0o600)
    (theirs := place / "theirs").mkdir()
    os.chown(theirs, NOBODY, NOBODY)
    (place / "subuid").write_text("ann:100000:65536\n")
    monkeypatch.setattr(ownership, "SUBUIDS", place / "subuid")
    monkeypatch.setattr(program, "EndSignal", lambda: None)
    monkeypatch.setattr("tempfile.tempdir", str(place))
    try:
        told = str(act(theirs, secret))
    except PebbleError as error:
        told = str(error)
    assert re.search("denied|belongs to (user|all)|too large|cannot stand", told)
    assert "of root" not in told
    assert os.geteuid() == 0


def test_who_asks_as_a_user_has_no_variables_of_roots(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    monkeypatch.setenv("TOKEN_OF_ROOT", "x")
    monkeypatch.setattr("pebble.extensions.checks.report.report.output_of", lambda *_, **how: asked.append(how))
    (place / "theirs").mkdir()
    os.chown(place / "theirs", NOBODY, NOBODY)
    text = json.dumps({"robot": {"id": "goob"}, "transport": {"kind": "mqtt", "run_dir": str(place / "theirs")}})
    (place / "robot.json").write_text(text)
    make(Places(place), place / "robot.json")
    assert ["TOKEN_OF_ROOT" in how["env"] for how in asked if "user" in how] == [False]
