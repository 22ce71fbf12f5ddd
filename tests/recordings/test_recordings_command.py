"""``pebble recordings``: what it prints, and what it does to files."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.recordings import library
from pebble.recordings.files.writer import McapWriter
from pebble.recordings.recorder.recorder import Recorder
from pebble.recordings.recorder.settings import Options
from tests.recordings.messages import START_NS

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
    recorder.events.note("gap", since=1000, until=61_000, why="no connection")
    recorder.stop()
    return tmp_path / "rec"


def recordings(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pebble", "recordings", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def messages(folder: Path) -> int:
    return sum(1 for one in library.merged(library.files([folder])) if not one.channel.topic.startswith("$"))


def test_list_and_info(folder: Path) -> None:
    listed = recordings("list", folder)
    assert re.search(r"state +204 ", listed.stdout)
    shown = recordings("info", folder).stdout
    assert "pebble/robots/goob: 101 messages" in shown
    assert "100  outgoing/online" in shown
    assert "gap: why no connection, lasted 60.0 s" in shown


def test_search(folder: Path) -> None:
    found = recordings("search", folder, "--robot", "goob", "--topic", "outgoing/logs", "--text", "battery")
    (line,) = found.stdout.splitlines()
    assert line.endswith('{"level": "WARNING", "message": "low \\n battery"}')
    assert found.stderr == "1 messages\n"
    assert len(recordings("search", folder, "-t", f"{FRED}/#", "-n", 3).stdout.splitlines()) == 3


def test_lines_there_and_back(folder: Path, tmp_path: Path) -> None:
    lines, again = tmp_path / "a.jsonl", tmp_path / "again.mcap"
    assert recordings("export", folder, lines).returncode == 0
    assert recordings("import", lines, again).returncode == 0
    assert messages(again) == messages(folder) == 201
    assert recordings("export", folder, lines).stderr == f"pebble: {lines} exists already\n"


def test_an_import_in_another_order_is_read_in_that_of_time(tmp_path: Path) -> None:
    lines, made = tmp_path / "a.jsonl", tmp_path / "a.mcap"
    numbers = [3, 1, 2, *range(40_000, 10, -1)]
    line = '{"timestamp": %d, "topic": "pebble/robots/goob/outgoing/online", "payload_b64": ""}'
    lines.write_text("\n".join(line % number for number in numbers))
    assert recordings("import", lines, made).returncode == 0
    read = [one.log_ns for one in library.merged([made])]
    assert read == sorted(number * 10**9 for number in numbers)


def test_one_robot_is_deleted(folder: Path) -> None:
    done = recordings("rm", folder, "--robot", "fred", "--yes")
    assert done.stdout == "100 messages deleted\n"
    assert messages(folder) == 101
    assert "fred" not in recordings("info", folder).stdout


def test_what_a_recorder_uses_is_left_alone(folder: Path) -> None:
    recorder = Recorder(folder, Options(free_bytes=0))
    recorder.start()
    try:
        for command in (("rm", folder, "--robot", "fred", "--yes"), ("finish", folder)):
            done = recordings(*command)
            assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
            assert "a recorder writes here" in done.stderr
        assert recordings("compact", folder).returncode == 0
    finally:
        recorder.stop()
    assert messages(folder) == 201


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("list", "nowhere"), "nowhere: No such file or directory"),
        (("info", "{tmp}"), "there is no recording"),
        (("list", "{tmp}/text"), "is not a recording (MCAP)"),
        (("export", "{rec}", "{tmp}/a.xyz"), "add --as"),
        (("export", "{rec}", "{tmp}/a.mkv"), "add --robot (pebble/robots/fred, pebble/robots/goob)"),
        (("rm", "{rec}"), "what to delete is missing"),
        (("search", "{rec}", "--since", "soon"), "--since"),
        (("compact", "{tmp}/none"), "there is no such folder"),
    ],
)
def test_mistakes_are_one_line(folder: Path, tmp_path: Path, arguments: tuple[str, ...], problem: str) -> None:
    (tmp_path / "text").write_text("text")
    empty = tmp_path / "empty"
    empty.mkdir()
    filled = [
        one.replace("{tmp}/", f"{tmp_path}/").replace("{tmp}", str(empty)).replace("{rec}", str(folder))
        for one in arguments
    ]
    done = recordings(*filled)
    assert done.returncode != 0
    assert problem in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_foreign_file_cannot_forge_lines(tmp_path: Path) -> None:
    path = tmp_path / "[red]evil.mcap"
    with path.open("wb", buffering=0) as file:
        writer = McapWriter(file, library="evil")
        channel = writer.channel("a/b/c/outgoing/x\n2026 forged\x1b[31m", "json", {"qos": "?"})
        writer.metadata("pebble.damage", {"missing_messages": "many"})
        events = writer.channel("$recorder/events", "json", {})
        for payload in (
            b'{"event":"gap","t":"x","since":"a","until":1e400}',
            b"[" * 9000,
            b'{"event":"gap","since":1,"until":-9}',
        ):
            writer.add(events, START_NS, payload)
        writer.add(channel, START_NS, b"\x1b[2J\n")
        writer.finish()
    for command in ("info", "list", "search"):
        done = recordings(command, path)
        assert (done.returncode, "Traceback" in done.stderr) == (0, False)
        assert "\x1b" not in done.stdout
        assert not any(line.startswith("2026 forged") for line in done.stdout.splitlines())
    assert "[red]evil" in recordings("list", path).stdout
