"""What root does in folders of other users, it does as they: their links lead it nowhere."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from pebble.errors import PebbleError
from pebble.extensions.fleet.applying import pid_of
from pebble.extensions.fleet.folder import PID
from pebble.extensions.fleet.people import People
from pebble.extensions.page.commands.people import opened
from pebble.runtime.as_owner import as_before, as_owner
from tests.support import Child, needs_root

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


def text(folder: Path) -> None:
    with as_owner(folder):
        (folder / "file").write_text("written")


@pytest.mark.parametrize("write", [people, page, text])
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
    os.chown(folder, NOBODY, NOBODY)
    with opened(folder / "people.sqlite"), as_before():
        assert os.geteuid() == 0
    assert (folder / "people.sqlite").stat().st_uid == NOBODY
    (place / "link").symlink_to(folder)
    with as_owner(place / "link"):
        assert os.geteuid() == NOBODY, "a link of root's is followed"
    assert os.geteuid() == 0


def test_a_number_in_a_folder_of_others_aims_no_signal(place: Path) -> None:
    with Child([sys.executable, "-c", "import time; time.sleep(60)", "/etc/mosquitto.conf"]) as process:
        (place / PID).write_text(str(process.pid))
        assert pid_of(place) is None


def linked(theirs: Path) -> Path:
    (theirs / "link").symlink_to(theirs.parent / "roots")
    return theirs / "link" / "deeper"


def of_root(theirs: Path) -> Path:
    (theirs / "roots").mkdir()
    return theirs / "roots"


def shared(theirs: Path) -> Path:
    (theirs.parent / "roots").chmod(0o777)
    return theirs.parent / "roots" / "new"


@pytest.mark.parametrize(
    ("path_of", "why"),
    [(linked, "is a link of user 65534"), (of_root, "lies in a folder of user 65534"), (shared, "others may write")],
)
def test_where_others_could_put_a_folder_it_does_nothing(
    path_of: Callable[[Path], Path], why: str, place: Path
) -> None:
    roots, folder = place / "roots", place / "theirs"
    roots.mkdir(0o755)
    folder.mkdir()
    os.chown(folder, NOBODY, NOBODY)
    with pytest.raises(PebbleError, match=why), as_owner(path_of(folder)):
        pass
