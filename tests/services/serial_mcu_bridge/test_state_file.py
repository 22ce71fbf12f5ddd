"""The file that survives a power cut: replaced in one step, by a thread of its own."""

import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pebble.motors.state_file import StateFile, Unreadable
from tests.support import WAIT_S, until


class Saved:
    """A file, and the results of its writes."""

    def __init__(self, path: Path) -> None:
        self.results: list[tuple[int, bool]] = []
        self.file = StateFile(path, lambda number, succeeded: self.results.append((number, succeeded)))


def test_what_was_saved_is_there_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "estop.json"
    saved = Saved(path)
    assert saved.file.can_save()
    assert saved.file.load() is None
    number = saved.file.save({"latched": True})
    assert until(lambda: saved.results == [(number, True)])
    assert Saved(path).file.load() == {"latched": True}
    assert [file.name for file in path.parent.iterdir()] == ["estop.json"]
    assert path.parent.stat().st_mode & 0o77 == 0


def test_only_the_newest_of_many_values_is_written_and_closing_waits_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved, may_write = Saved(tmp_path / "estop.json"), threading.Event()
    dumps, written = json.dumps, []

    def slowly(value: Any) -> str:
        assert may_write.wait(WAIT_S)
        written.append(value)
        return dumps(value)

    monkeypatch.setattr(json, "dumps", slowly)
    for value in range(100):
        saved.file.save(value)
    threading.Timer(0.1, may_write.set).start()
    saved.file.close()
    assert written[-1] == saved.file.load() == 99
    assert len(written) <= 2
    assert saved.results[-1] == (100, True)
    Saved(tmp_path / "estop.json").file.close()  # nothing was saved: there is no thread
    below = Saved(tmp_path / "estop.json" / "robot" / "estop.json")
    assert not below.file.can_save(), "a place below a file cannot be written"
    assert below.file.load() is None or isinstance(below.file.load(), Unreadable)


@pytest.mark.parametrize("content", [b"{", b"\xff", b"[" * 10_000, b"null", b'"' + b"x" * 20_000 + b'"', None])
def test_a_damaged_file_differs_from_none(tmp_path: Path, content: bytes | None) -> None:
    """A folder in its place is one, too, and a failed write."""
    path = tmp_path / "estop.json"
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    saved = Saved(path)
    assert isinstance(saved.file.load(), Unreadable)
    number = saved.file.save({})
    assert until(lambda: saved.results == [(number, content is not None)])


@pytest.mark.timeout(10)
@pytest.mark.parametrize("place", [os.mkfifo, lambda path: path.symlink_to(path.with_name("other"))])
def test_a_fifo_in_its_place_is_a_damaged_file_and_a_link_is_not_followed(
    tmp_path: Path, place: Callable[[Path], object]
) -> None:
    path, other = tmp_path / "estop.json", tmp_path / "other"
    other.write_text("kept")
    os.mkfifo(path)
    place(tmp_path / ".estop.json.new")
    saved = Saved(path)
    assert isinstance(saved.file.load(), Unreadable)
    saved.file.save({"latched": True})
    saved.file.close()
    assert (other.read_text(), Saved(path).file.load()) == ("kept", {"latched": True})


def test_a_folder_that_cannot_be_looked_into_does_not_end_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stat = Path.stat

    def refuse(path: Path, **options: Any) -> os.stat_result:
        if "closed" in path.parts:  # as for other users than root
            raise PermissionError
        return stat(path, **options)

    monkeypatch.setattr(Path, "stat", refuse)
    assert Saved(tmp_path / "closed" / "state" / "estop.json").file.can_save()  # root may make it
