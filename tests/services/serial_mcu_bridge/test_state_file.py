"""The file that survives a power cut: replaced in one step, by a thread of its own."""

import json
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from pebble.motors.state_file import StateFile, Unreadable
from tests.support import until


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


def test_only_the_newest_of_many_values_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved, may_write = Saved(tmp_path / "estop.json"), threading.Event()
    dumps, written = json.dumps, []

    def slowly(value: Any) -> str:
        assert may_write.wait(5)
        written.append(value)
        return dumps(value)

    monkeypatch.setattr(json, "dumps", slowly)
    for value in range(100):
        saved.file.save(value)
    may_write.set()
    saved.file.close()
    assert written[-1] == 99
    assert len(written) <= 2
    assert saved.results[-1] == (100, True)


def test_closing_waits_for_the_newest_value(tmp_path: Path) -> None:
    saved = Saved(tmp_path / "estop.json")
    for value in range(50):
        saved.file.save(value)
    saved.file.close()
    assert Saved(tmp_path / "estop.json").file.load() == 49
    Saved(tmp_path / "estop.json").file.close()  # nothing was saved: there is no thread


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff", b'{"latched": tr', b"[" * 10_000, b"null", b'"' + b"x" * 20_000 + b'"', None]
)
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
def test_a_fifo_in_its_place_is_a_damaged_file_and_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "estop.json"
    os.mkfifo(path)
    os.mkfifo(tmp_path / ".estop.json.new")
    saved = Saved(path)
    assert isinstance(saved.file.load(), Unreadable)
    saved.file.save({"latched": True})
    saved.file.close()
    assert Saved(path).file.load() == {"latched": True}


def test_a_link_in_place_of_the_new_file_is_not_followed(tmp_path: Path) -> None:
    path, other = tmp_path / "estop.json", tmp_path / "other"
    other.write_text("kept")
    (tmp_path / ".estop.json.new").symlink_to(other)
    saved = Saved(path)
    saved.file.save({})
    saved.file.close()
    assert (other.read_text(), Saved(path).file.load()) == ("kept", {})


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


def test_a_place_below_a_file_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    saved = Saved(tmp_path / "file" / "robot" / "estop.json")
    assert not saved.file.can_save()
    assert saved.file.load() is None or isinstance(saved.file.load(), Unreadable)
