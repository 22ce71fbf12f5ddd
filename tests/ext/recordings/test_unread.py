"""What other programs wrote is read completely, or named; and no file is replaced by a part of it."""

from __future__ import annotations

import errno
import io
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from pebble.extensions.recordings.files import rewrite as rewriting
from pebble.extensions.recordings.files.reader import RecordingFile
from pebble.extensions.recordings.files.recorded import RecordingError
from pebble.extensions.recordings.files.records import MAGIC
from pebble.extensions.recordings.files.rewrite import rewrite
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.library import problems
from pebble.extensions.recordings.replay.source import ReplaySource
from pebble.extensions.recordings.seek.archive import Archive
from pebble.extensions.recordings.seek.days import Days
from pebble.extensions.recordings.traffic.sources import sources
from tests.commands.command_line import Run
from tests.ext.recordings.playing import STEP_NS, THEN_NS, contents, read, write_random
from tests.support import cases, refused

GOOB, FRED = "pebble/robots/goob/outgoing/online", "pebble/robots/fred/outgoing/online"
COUNT: Final = 40
SCHEMA: Final = ("Online", "jsonschema", b'{"type": "object"}')
NONE, LZ4, ZSTD = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD


def payload(number: int) -> bytes:
    return b'{"t": %d, "rest": "%s"}' % (number, b"x" * 20)


def by_package(
    *, interleaved: bool = False, beside: bool = False,
    sequence: Callable[[int], int] = lambda number: number, library: str = "other",
    **options: Any,
) -> bytes:  # fmt: skip
    """The message ``number`` is of goob, or each fourth of fred; its time grows with its number."""
    out = io.BytesIO()
    writer = Writer(out, **{"compression": NONE, "chunk_size": 400, **options})
    writer.start(library=library)
    if beside:
        writer.add_metadata("about", {"place": "hall"})
        writer.add_metadata("about", {"place": "yard"})
        writer.add_attachment(1, 2, "plan.txt", "text/plain", b"walls")
    number = writer.register_schema(*SCHEMA)
    goob, fred = (writer.register_channel(topic, "json", number) for topic in (GOOB, FRED))
    for one in [*range(0, COUNT, 2), *range(1, COUNT, 2)] if interleaved else range(COUNT):
        writer.add_message(fred if one % 4 == 3 else goob, THEN_NS + one * STEP_NS, payload(one), 0, sequence(one))
    writer.finish()
    return out.getvalue()


#: All hold the same messages.
VALID: Final[dict[str, bytes]] = {
    "zstd": by_package(compression=ZSTD),
    "lz4": by_package(compression=LZ4),
    "chunks overlap": by_package(interleaved=True),
    "one chunk in another order": by_package(interleaved=True, chunk_size=1 << 20),
    "a library like ours": by_package(library="pebble rosbag2-recorder", sequence=lambda number: 1000 - number),
    "metadata and attachments": by_package(beside=True),
}
#: Files that are not read at all: what another program wrote needs an index of all its messages.
REFUSED: Final[dict[str, bytes]] = {
    "no chunks": by_package(use_chunking=False),
    "no index of messages": by_package(index_types=IndexType.ALL & ~IndexType.MESSAGE),
    "summary without channels": by_package(repeat_channels=False, repeat_schemas=False),
    "cut off": by_package()[:-30],
}


def flipped(data: bytes, at: int, bit: int = 0) -> bytes:
    raw = bytearray(data)
    raw[at] ^= 1 << bit
    return bytes(raw)


def _of(op: int, data: bytes) -> int:
    """Where the first record of this kind begins."""
    at = len(MAGIC)
    while data[at] != op:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return at


_FILE = by_package(compression=ZSTD, library="pebble 1.0")
#: Files that cannot be read completely, and a part of what is said of them.
DAMAGED: Final[dict[str, tuple[bytes, str]]] = {
    "a chunk": (flipped(_FILE, _of(6, _FILE) + 70), "damaged part"),
    "the kind of a chunk": (flipped(_FILE, _of(6, _FILE), 7), "messages missing"),
    "the begin": (flipped(_FILE, 3), "does not begin as MCAP"),
    "the summary": (flipped(_FILE, _of(11, _FILE) + 20), "its end is missing or damaged"),
    "cut off in a chunk": (_FILE[: _of(6, _FILE) + 90], "at its end cannot be read"),
    "empty": (b"", "is empty"),
}  # fmt: skip


EXPECTED = [(FRED if number % 4 == 3 else GOOB, payload(number)) for number in range(COUNT)]
pytest.importorskip("duckdb")
pytest.importorskip("matplotlib")
NAME = "20261122T100030Z-000001.state.mcap"


def stored(folder: Path, data: bytes, name: str = NAME) -> Path:
    path = folder / "rec" / "2026" / "11" / "22" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("name", VALID)
def test_a_file_of_another_program_is_read_in_the_order_of_time(tmp_path: Path, run: Run, name: str) -> None:
    path, copy = stored(tmp_path, VALID[name]), tmp_path / "copy.mcap"
    messages, damage = read(path)
    assert (messages, damage.report()) == (EXPECTED, "")
    assert run("recordings", "export", path, copy) == 0
    assert exported(copy) == [(*SCHEMA, *one) for one in EXPECTED]
    archive = Archive(tmp_path / "rec")
    shown = archive.messages("pebble/robots/goob", 0, 1 << 63)
    assert [(one.channel.topic, one.payload) for one in shown] == [one for one in EXPECTED if one[0] == GOOB]
    assert archive.unread() == {}
    archive.close()
    replayed = ReplaySource([path])
    assert [(one.channel.topic, one.payload) for one in replayed.messages()] == EXPECTED
    assert problems(replayed.damages) == []
    found = sources([path], tmp_path)
    assert (found.robots, found.unread) == (["pebble/robots/fred", "pebble/robots/goob"], [])


@pytest.mark.parametrize("name", REFUSED)
def test_one_without_an_index_is_refused_with_one_line(tmp_path: Path, run: Run, name: str) -> None:
    path = stored(tmp_path, REFUSED[name])
    assert run("recordings", "search", path) == 1
    assert run.err.startswith(f"pebble: {path}: another program wrote it, and its end is missing")
    assert run.err.count("\n") == 1


def test_a_deletion_leaves_it_as_it_is(tmp_path: Path, run: Run) -> None:
    """It may hold what only that program knows."""
    path = stored(tmp_path, VALID["metadata and attachments"])
    assert run("recordings", "rm", tmp_path / "rec", "--robot", "fred", "--yes") == 1
    assert "another program wrote it" in run.err
    assert path.read_bytes() == VALID["metadata and attachments"]


def exported(path: Path) -> list[tuple[Any, ...]]:
    """The records as the package reads them: name, encoding and data of the schema, topic, payload."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages()
        return [
            (schema.name, schema.encoding, schema.data, channel.topic, message.data)
            for schema, channel, message in found
        ]


READERS = [
    ["list"], ["info"], ["search"], ["export", "{out}.jsonl"], ["export", "{out}.mcap"],
    ["export", "{out}.wav", "-r", "goob"], ["analyse", "--output", "{out}"],
]  # fmt: skip
WRITERS = [["rm", "--robot", "fred", "--yes"], ["rm", "--since", "2000-01-01", "--yes"]]


def on(folder: Path, command: list[str], out: Path) -> list[str | Path]:
    group = [] if command[0] == "analyse" else ["recordings"]
    return [*group, command[0], folder, *(one.replace("{out}", str(out)) for one in command[1:])]


@pytest.mark.parametrize("name", DAMAGED)
def test_what_cannot_be_read_is_named_and_not_touched(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr("pebble.extensions.recordings.traffic.report.figures", lambda _: [])  # which take longest
    data, wanted = DAMAGED[name]
    path = stored(tmp_path, data)
    unread = [line for day in Days(Archive(tmp_path / "rec")).all() for line in day.unread]
    only_in_messages = name in ("a chunk", "the kind of a chunk")  # a summary says nothing of it
    assert any(wanted in line for line in unread) != only_in_messages
    each = cases(4, 1)  # of the commands, for a damage others than for the next one
    for number, command in enumerate([*READERS, *WRITERS][[*DAMAGED].index(name) % each :: each]):
        code = run(*on(tmp_path / "rec", command, tmp_path / str(number)))
        assert (code, NAME in run.err, wanted in run.err) == (1, True, True), (command, run.out, run.err)
        assert path.read_bytes() == data
    assert run("recordings", "rm", path, "--yes") == 0
    assert (run.out, path.exists()) == (f"{path.name}: deleted\n", False)


def test_a_flipped_bit_anywhere_costs_no_message_at_a_deletion(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_random(path, 60, channels=2, each=20)
    data, chance = path.read_bytes(), random.Random(1)
    expected = [one for one in contents(path) if "/r0/" not in one[0]]
    left = 0
    for at in range(chance.randrange(7), len(data), cases(41, 7)):
        raw = flipped(data, at, chance.randrange(8))
        path.write_bytes(raw)
        try:
            rewrite(path, path, keeps=lambda one: "/r0/" not in one.channel.topic)
        except RecordingError:
            assert path.read_bytes() == raw
            left += 1
        else:
            assert contents(path) == expected, at
    assert left > 8


def test_without_the_package_the_extra_is_named(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    path = stored(tmp_path, by_package())
    monkeypatch.setattr("pebble.extensions.recordings.files.recorded.find_spec", lambda _: None)
    assert run(*on(tmp_path / "rec", WRITERS[0], tmp_path / "out")) == 1
    assert 'recordings need the package mcap: pip install "pebble-robot[record]"' in run.err
    assert path.read_bytes() == by_package()


class TestInterrupted:
    """A deletion that does not come to its end leaves the file as it was, and nothing beside it."""

    @pytest.fixture
    def path(self, tmp_path: Path) -> Path:
        path = stored(tmp_path, b"")
        write_random(path, 100, channels=2)
        return path

    @pytest.mark.parametrize(
        ("fails", "problem"),
        [
            ((rewriting.os, "fsync", refused(errno.ENOSPC)), "No space left on device"),
            ((RecordingWriter, "finish", lambda _writer: None), "cannot be read again"),
            (
                (rewriting.shutil, "disk_usage", lambda _folder: SimpleNamespace(free=9, total=9)),
                "there is no room",
            ),
        ],
    )
    def test_a_copy_that_cannot_be_made(
        self, path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, fails: tuple[Any, str, Any], problem: str
    ) -> None:
        before = path.read_bytes()
        monkeypatch.setattr(*fails)
        assert run("recordings", "rm", path.parents[3], "--robot", "r0", "--yes") == 1
        assert problem in run.err
        assert path.read_bytes() == before
        assert list(path.parent.iterdir()) == [path]

    def test_a_kill_before_the_copy_takes_its_place(self, path: Path, run: Run) -> None:
        kill, before = "rewriting._check = lambda *_: os.kill(os.getpid(), signal.SIGKILL)", path.read_bytes()
        rest = [one for one in contents(path) if "/r0/" not in one[0]]
        code = (
            f"import os, signal, sys; from pebble.extensions.recordings.files import rewrite as rewriting; {kill};"
            "from pebble.cli import main; sys.argv = ['pebble', *sys.argv[1:]]; main()"
        )
        arguments = ["recordings", "rm", str(path.parents[3]), "--robot", "r0", "--yes"]
        killed = subprocess.run([sys.executable, "-c", code, *arguments], check=False, timeout=60)
        assert killed.returncode == -signal.SIGKILL
        assert path.read_bytes() == before
        assert len(list(path.parent.iterdir())) == 2
        assert run(*arguments) == 0
        assert list(path.parent.iterdir()) == [path]
        assert contents(path) == rest


class TestNames:
    """Links, files that are not finished, and names that are taken."""

    def test_what_a_deletion_does_not_look_into_is_named(self, tmp_path: Path, run: Run) -> None:
        whole_ = stored(tmp_path, b"")
        write_random(whole_, 100, channels=2)
        left = [
            stored(tmp_path, VALID["zstd"], f"{NAME.replace('001', '002')}{end}") for end in (".active", ".damaged")
        ]
        assert run("recordings", "rm", tmp_path / "rec", "--robot", "r0", "--yes") == 1
        assert not [topic for topic, _ in contents(whole_) if "/r0/" in topic]
        wanted = run.err
        for path in left:
            assert path.name in wanted
            assert path.read_bytes() == VALID["zstd"]
            assert run("recordings", "rm", path, "--yes") == path.name.endswith(".active")
            assert path.exists() == path.name.endswith(".active")

    def test_a_link(self, tmp_path: Path, run: Run) -> None:
        target, path = tmp_path / "rest.mcap", stored(tmp_path, b"")
        written, before = write_random(target, 100, channels=2), target.read_bytes()
        path.unlink()
        path.symlink_to(target)
        run("recordings", "rm", tmp_path / "rec", "--robot", "r0", "--yes")
        assert target.read_bytes() == before
        assert contents(path) == written
        assert run("recordings", "rm", path, "--yes") == 1

    @pytest.mark.parametrize("command", [("rm", "notes.txt", "--yes"), ("export", NAME, NAME), ("mend", NAME, NAME)])
    def test_no_other_file_is_deleted_or_replaced(self, tmp_path: Path, run: Run, command: tuple[str, ...]) -> None:
        path = stored(tmp_path, VALID["zstd"])
        path.with_name("notes.txt").write_text("notes")
        assert run("recordings", *(path.with_name(one) if "." in one else one for one in command)) == 1
        assert path.read_bytes() == VALID["zstd"]
        assert path.with_name("notes.txt").exists()

    def test_mending_takes_no_name_that_is_taken(self, tmp_path: Path, run: Run) -> None:
        whole_ = stored(tmp_path, VALID["zstd"])
        active = whole_.with_name(f"{NAME}.active")
        write_random(active, 100, finish=False)
        before = active.read_bytes()
        assert run("recordings", "mend", tmp_path / "rec") == 1
        assert "exists already" in run.err
        assert whole_.read_bytes() == VALID["zstd"]
        assert active.read_bytes() == before


class TestMending:
    """What becomes of a file that a recorder has left."""

    def test_what_is_missing_is_counted_and_the_damaged_file_stays(self, tmp_path: Path, run: Run) -> None:
        path = stored(tmp_path, b"", f"{NAME}.active")
        written = write_random(path, 100, finish=False, each=20, channels=1)
        with RecordingFile(path) as file:
            second = file.chunks[1]
        damaged = flipped(path.read_bytes(), second.at + second.length // 2)
        path.write_bytes(damaged)
        assert run("recordings", "mend", tmp_path / "rec") == 1
        assert run.out == f"{NAME}: 80 messages, 20 missing\n"
        assert contents(path.with_name(NAME)) == written[:20] + written[40:]
        assert path.with_name(f"{NAME}.damaged").read_bytes() == damaged
        assert not path.exists()
        assert run("recordings", "list", tmp_path / "rec", columns=200) == 0
        assert "20 missing" in run.out

    @pytest.mark.parametrize("data", [b"", _FILE[: _of(6, _FILE)]])
    def test_a_file_without_messages_goes(self, tmp_path: Path, run: Run, data: bytes) -> None:
        path = stored(tmp_path, data, f"{NAME}.active")
        assert run("recordings", "mend", tmp_path / "rec") == 0
        assert list(path.parent.iterdir()) == []
