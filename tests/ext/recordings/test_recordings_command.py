"""``pebble recordings``: what it prints, and what it does to files."""

from __future__ import annotations

import errno
import json
import os
import re
from pathlib import Path

import pytest

from pebble.extensions.recordings import library
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.recorder.recorder import Recorder
from pebble.extensions.recordings.recorder.settings import Options
from pebble.extensions.recordings.traffic.index import index_path
from tests.commands.command_line import Run
from tests.ext.recordings.playing import THEN_NS
from tests.support import refused

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """What a recorder has recorded of two robots."""
    recorder = Recorder(tmp_path / "rec", Options(free_bytes=0))
    recorder.start()
    for number in range(100):
        for robot in (GOOB, FRED):
            recorder.receive(f"{robot}/outgoing/online", b'{"t":%d}' % number, 1, retain=False)
    recorder.receive(
        f"{GOOB}/outgoing/logs", json.dumps({"level": "WARNING", "message": "low \n battery"}).encode(), 1, retain=False
    )
    recorder.note("gap", since=1000, until=61_000, why="no connection")
    recorder.stop()
    return tmp_path / "rec"


def messages(folder: Path) -> int:
    return sum(1 for one in library.merged(library.files([folder])) if not one.channel.topic.startswith("$"))


def test_list_and_info(folder: Path, run: Run) -> None:
    assert run("recordings", "list", folder) == 0
    assert re.search(r"state +201 ", run.out)
    assert "1 file, 201 messages, " in run.out
    assert run("recordings", "info", folder) == 0
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d to 20", run.out)
    assert re.search(r"201 messages and 3 notes of the recorder, .* in 1 file\n", run.out)
    assert "pebble/robots/goob: 101 messages" in run.out
    assert "100  outgoing/online" in run.out
    assert "gap: why no connection, lasted 60.0 s" in run.out


def test_search(folder: Path, run: Run) -> None:
    run("recordings", "search", folder, "--robot", "goob", "--topic", "outgoing/logs", "--text", "battery")
    (line,) = run.out.splitlines()
    assert re.match(r"20\d\d-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}  pebble", line)
    assert line.endswith('{"level": "WARNING", "message": "low \\n battery"}')
    assert run.err == "1 message\n"
    run("recordings", "search", folder, "-t", f"{FRED}/#", "-n", "3")
    assert len(run.out.splitlines()) == 3


def test_lines_there_and_back(folder: Path, tmp_path: Path, run: Run) -> None:
    lines, again = tmp_path / "a.jsonl", tmp_path / "again.mcap"
    (tmp_path / f".a.jsonl.{os.getpid()}").symlink_to(tmp_path / "of-another")
    assert run("recordings", "export", folder, lines) == 0
    assert not (tmp_path / "of-another").exists()
    assert run("recordings", "import", lines, again) == 0
    assert messages(again) == messages(folder) == 201
    assert run("recordings", "export", folder, lines) == 1
    assert run.err == f"pebble: {lines} exists already\n"


def test_an_import_in_another_order_is_read_in_that_of_time(tmp_path: Path, run: Run) -> None:
    lines, made = tmp_path / "a.jsonl", tmp_path / "a.mcap"
    numbers = [3, 1, 2, *range(20_000, 10, -1)]
    line = '{"timestamp": %d, "topic": "pebble/robots/goob/outgoing/online", "payload_b64": ""}'
    lines.write_text("\n".join(line % number for number in numbers))
    assert run("recordings", "import", lines, made) == 0
    read = [one.log_ns for one in library.merged([made])]
    assert read == sorted(number * 10**9 for number in numbers)


def test_one_robot_is_deleted(folder: Path, run: Run) -> None:
    assert run("recordings", "rm", folder, "--robot", "fred", "--yes") == 0
    assert run.out == "100 messages deleted\n"
    assert messages(folder) == 101
    assert run("recordings", "info", folder) == 0
    assert "fred" not in run.out


@pytest.mark.parametrize(
    ("option", "words", "deleted"),
    [
        ("--since", "from 2000-01-01 00:00:00 UTC to the end", 100),
        ("--until", "from the beginning to 2000-01-01 00:00:00 UTC", 0),
    ],
)
def test_the_period_of_a_deletion_is_named(folder: Path, run: Run, option: str, words: str, deleted: int) -> None:
    assert run("recordings", "rm", folder, "--robot", "fred", option, "2000-01-01T00:00:00Z", "--yes") == 0
    assert run.out.startswith(f"{FRED} from ")  # in local time; where that is not UTC, in both
    assert run.out.endswith(f"{words}\n{deleted} messages deleted\n")


def test_a_robot_is_found_by_a_name_that_looks_the_same(tmp_path: Path, run: Run) -> None:
    recorder = Recorder(tmp_path / "rec", Options())
    recorder.start()
    recorder.receive("pebble/robots/ba\u0308r/outgoing/online", b'{"t":1}', 1, retain=False)
    recorder.stop()
    assert run("recordings", "search", tmp_path / "rec", "--robot", "b\u00e4r") == 0
    assert "outgoing/online" in run.out
    assert run("recordings", "rm", tmp_path / "rec", "--robot", "b\u00e4r", "--yes") == 0
    assert run.out == "1 message deleted\n"


def test_what_a_recorder_uses_is_left_alone(folder: Path, run: Run) -> None:
    recorder = Recorder(folder, Options(free_bytes=0))
    recorder.start()
    try:
        for command in (("rm", folder, "--robot", "fred", "--yes"), ("mend", folder)):
            assert (run("recordings", *command), len(run.err.splitlines())) == (1, 1)
            assert "a recorder writes here" in run.err
    finally:
        recorder.stop()
    assert messages(folder) == 201


def test_a_share_without_locks_sizes_and_times_is_recorded_to(
    folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    left = folder / "2026/11/20/20261120T232921Z-000999.state.mcap.active"
    left.parent.mkdir(parents=True, exist_ok=True)
    left.write_bytes(b"")
    monkeypatch.setattr("fcntl.flock", refused(errno.ENOLCK))
    monkeypatch.setattr("os.utime", refused(errno.EPERM))
    monkeypatch.setattr("os.statvfs", lambda _: os.statvfs_result((512, 512, 0, 0, 0, 0, 0, 0, 0, 255)))
    recorder = Recorder(folder, Options())
    recorder.start()
    recorder.receive(f"{GOOB}/outgoing/online", b'{"t":1}', 1, retain=False)
    recorder.stop()
    assert f"recorder.lock cannot be locked ({os.strerror(errno.ENOLCK)})" in caplog.text
    assert (messages(folder), left.exists()) == (202, True)  # what may be another recorder's stays
    assert run("recordings", "rm", left, "--yes") == 1
    assert run("recordings", "rm", folder, "--robot", "fred", "--yes") == 1
    assert f"pebble: {folder}/recorder.lock cannot be locked" in run.err
    assert messages(folder) == 102


READING = [
    ("search", "{rec}"), *(("export", "{rec}", f"{{tmp}}/a.{end}") for end in ("jsonl", "mkv")),
]  # fmt: skip
NO_ROBOT = f"no robot pebble/robots/nosuch in {{rec}}; there are: {FRED}, {GOOB}\n"


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("list", "nowhere"), "nowhere: No such file or directory"),
        (("info", "{tmp}"), "there is no recording"),
        (("info", "{tmp}/pipe.mcap"), "pipe.mcap: is no plain file"),
        (("list", "{tmp}/text"), "is not a recording (MCAP)"),
        (("export", "{rec}", "{tmp}/a.xyz"), "add --as"),
        (("export", "{rec}", "{tmp}/a.mkv"), "add --robot (pebble/robots/fred, pebble/robots/goob)"),
        *(((*command, "-r", "nosuch"), NO_ROBOT) for command in READING),
        (("rm", "{rec}", "--yes", "-r", "nosuch", "--since", "2000-01-01"), NO_ROBOT),
        *(((*command, "-t", "outgoing/none"), "no topic outgoing/none in {rec}; there are: ") for command in READING),
        (("search", "{rec}", "-r", "fred", "-t", "outgoing/logs"), f"; there are: {FRED}/outgoing/online\n"),
        (("rm", "{rec}"), "what to delete is missing"),
        (("search", "{rec}", "--since", "soon"), "--since"),
        (("mend", "{tmp}/none"), "none: No such file or directory"),
    ],
)
def test_mistakes_are_one_line(
    folder: Path, tmp_path: Path, run: Run, arguments: tuple[str, ...], problem: str
) -> None:
    (tmp_path / "text").write_text("text")
    os.mkfifo(tmp_path / "pipe.mcap")
    empty = tmp_path / "empty"
    empty.mkdir()

    def filled(text: str) -> str:
        return text.replace("{tmp}/", f"{tmp_path}/").replace("{tmp}", str(empty)).replace("{rec}", str(folder))

    before = sorted(tmp_path.rglob("*"))
    assert run("recordings", *map(filled, arguments)) != 0
    assert filled(problem) in run.err
    assert sorted(tmp_path.rglob("*")) == before
    assert len(run.err.strip().splitlines()) == 1


@pytest.mark.parametrize("arguments", [["{file}"], ["{rec}", "-r", "fred"]])
def test_what_cannot_be_deleted_is_one_line(folder: Path, run: Run, arguments: list[str]) -> None:
    files = list(folder.rglob("*.mcap"))
    for path in files:
        index_path(path).mkdir()
    named = {"{file}": files[0], "{rec}": folder}
    assert run("recordings", "rm", *(named.get(word, word) for word in arguments), "--yes") == 1
    assert ("Is a directory" in run.err, run.err.count("\n")) == (True, 1)


def test_a_foreign_file_cannot_forge_lines(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "[red]evil.mcap"
    with path.open("wb", buffering=0) as file:
        writer = RecordingWriter(file, library="evil")
        channel = writer.channel("a/b/c/outgoing/x\n2026 forged\x1b[31m", "json", {"qos": "?"})
        writer.metadata("pebble.damage", {"missing_messages": "many"})
        events = writer.channel("$recorder/events", "json", {})
        for payload in (
            b'{"event":"gap","t":"x","since":"a","until":1e400}',
            b"[" * 9000,
            b'{"event":"gap","since":1,"until":-9}',
        ):
            writer.add(events, THEN_NS, payload)
        writer.add(channel, THEN_NS, b"\x1b[2J\n")
        writer.finish()
    for command in ("info", "list", "search"):
        assert (run("recordings", command, path), run.err.count("\n") <= 1) == (0, True)
        assert "\x1b" not in run.out
        assert not any(line.startswith("2026 forged") for line in run.out.splitlines())
        assert command != "list" or "[red]evil" in run.out
