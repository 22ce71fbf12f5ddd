"""What root does in folders of other users, it does as they: their links lead it nowhere."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from pebble.errors import PebbleError
from pebble.extensions.fleet.as_owner import as_before, as_owner
from pebble.extensions.page.commands.people import opened
from tests.support import needs_root

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


def text(folder: Path) -> None:
    with as_owner(folder):
        (folder / "file").write_text("written")


@pytest.mark.parametrize("write", [people, text])
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
    with pytest.raises(PebbleError, match="link is a link"), as_owner(place / "link"):
        pass
