"""MCAP files: as other readers want them, and in any state of damage."""

from __future__ import annotations

import contextlib
import math
import os
import random
import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import BinaryIO

import pytest

from pebble.recordings.files.finish import Finished, finish
from pebble.recordings.files.mcap import FILE_TOPIC, HEAD, Op, Packer, RecordingError
from pebble.recordings.files.reader import Summary, mapped
from pebble.recordings.files.scan import Damage, blocks
from pebble.recordings.files.writer import McapWriter
from tests.recordings.files.other_readers import Counted, by_mcap, by_mcap_core
from tests.recordings.messages import START_NS, STEP_NS, contents, is_part_of, write
from tests.support import cases, some

MESSAGES = 2000
#: How many times as many files are damaged as usual.
TIMES = int(os.environ.get("PEBBLE_DAMAGES", cases(1, 6)))


class TestWhole:
    @pytest.mark.parametrize("level", [0, 3])
    def test_other_readers_read_it(self, tmp_path: Path, level: int) -> None:
        path = tmp_path / "a.mcap"
        written = write(path, level=level)
        assert [by_mcap(path), *by_mcap_core([path])] == [Counted(MESSAGES, MESSAGES, MESSAGES)] * 2
        damage = Damage()
        assert contents(path, damage) == written
        assert (damage.found, damage.finished) == (False, True)

    def test_an_empty_one(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        write(path, 0)
        assert [by_mcap(path), *by_mcap_core([path])] == [Counted(0, 0, 0)] * 2
        assert finish(path) == Finished(0, 0, 0, 0)

    def test_only_the_chunks_of_a_period_are_read(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        written = write(path)
        since, until = START_NS + 500 * STEP_NS, START_NS + 700 * STEP_NS
        assert contents(path, since_ns=since, until_ns=until) == written[500:700]

    def test_only_the_chosen_channels_are_read(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        topic = "pebble/robots/r3/outgoing/t3"
        expected = [one for one in write(path) if one[0] == topic]
        assert contents(path, chooses=lambda channel: channel.topic == topic) == expected


def cut(raw: bytearray, rng: random.Random) -> None:
    del raw[rng.randrange(len(raw)) :]


def flip(raw: bytearray, rng: random.Random, bits: int = 8) -> None:
    for _ in range(bits):
        raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(8)


def zero_a_page(raw: bytearray, rng: random.Random) -> None:
    begin = rng.randrange(len(raw))
    raw[begin : begin + 4096] = bytes(len(raw[begin : begin + 4096]))


def end_in_garbage(raw: bytearray, rng: random.Random) -> None:
    cut(raw, rng)
    raw += rng.randbytes(rng.randrange(5000))


def end_in_zeros(raw: bytearray, rng: random.Random) -> None:
    cut(raw, rng)
    raw += bytes(rng.randrange(20_000))


def lose_a_part(raw: bytearray, rng: random.Random) -> None:
    begin = rng.randrange(len(raw))
    del raw[begin : begin + rng.randrange(60_000)]


DAMAGES = [cut, flip, zero_a_page, end_in_garbage, end_in_zeros, lose_a_part]


def _indexes(data: bytes) -> list[int]:
    """Where the records begin that index chunks."""
    found = []
    for block in blocks(data, Damage()):
        at = block.record_end
        while at < block.end:
            found.append(at)
            at += HEAD.size + HEAD.unpack_from(data, at)[1]
    return found


class TestDamaged:
    @pytest.mark.parametrize(("damage", "finished", "level"), some(product(DAMAGES, [False, True], [0, 3]), 3))
    def test_all_that_is_left_is_read_and_what_is_missing_is_known(
        self, tmp_path: Path, damage: Callable[[bytearray, random.Random], None], finished: bool, level: int
    ) -> None:
        rng, path = random.Random(f"{damage.__name__}{finished}{level}"), tmp_path / "a.mcap"
        again: dict[Path, Counted] = {}
        written = write(path, finish=finished, level=level)
        whole = path.read_bytes()
        for number in range(2 * TIMES):
            raw, path = bytearray(whole), tmp_path / f"{number}.mcap"
            damage(raw, rng)
            path.write_bytes(raw)
            found = Damage()
            read = contents(path, found)
            if not found.orphans:
                assert is_part_of(read, written)
            try:
                made = finish(path)
            except RecordingError:
                assert not read
                continue
            assert contents(path) == read
            again[path] = by_mcap(path)
            assert again[path] == Counted(made.messages, len(read), len(read))
            assert made.messages == len(read)
            assert finish(path) == made
            if made.damaged_bytes == 0 and made.torn_bytes == 0:
                assert read == written
            elif finished and damage in (flip, zero_a_page) and Summary.of(raw) is not None:
                assert made.missing == len(written) - len(read)
        if damage is not lose_a_part:  # where bytes are gone a chunk's index may have no room, which this reader needs
            assert by_mcap_core(list(again)) == list(again.values())

    @pytest.mark.parametrize("op", some([Op.CHUNK, Op.DATA_END, Op.METADATA, Op.PADDING], 2))
    def test_an_index_that_became_another_record_is_written_anew(self, tmp_path: Path, op: Op) -> None:
        written = write(tmp_path / "a.mcap", finish=False)
        whole = (tmp_path / "a.mcap").read_bytes()
        made = []
        for at in _indexes(whole)[::37]:
            raw, path = bytearray(whole), tmp_path / f"{at}.mcap"
            raw[at] = op
            path.write_bytes(raw)
            finish(path)
            assert contents(path) == written
            made.append(path)
        assert len(made) > 3
        assert by_mcap_core(made) == [Counted(MESSAGES, MESSAGES, MESSAGES)] * len(made)

    @pytest.mark.parametrize("level", [0, 3])
    def test_one_bit_costs_two_chunks_at_most(self, tmp_path: Path, level: int) -> None:
        rng, path = random.Random(level), tmp_path / "a.mcap"
        written = write(path, finish=False, level=level)
        whole = path.read_bytes()
        for _ in range(25 * TIMES):
            raw = bytearray(whole)
            flip(raw, rng, 1)
            path.write_bytes(raw)
            found = Damage()
            read = contents(path, found)
            assert len(written) - len(read) <= 200
            assert found.missing + 200 >= len(written) - len(read)

    def test_bits_of_what_has_no_checksum(self, tmp_path: Path) -> None:
        """A bit of opcodes and lengths of each record: a wrong one must not hide the others."""
        rng, path, step = random.Random(3), tmp_path / "a.mcap", cases(9, 1)
        written = write(path, 600, finish=False)
        whole = path.read_bytes()
        for begin in _records(whole):
            for at in range(begin + rng.randrange(step), begin + 9, step):
                raw = bytearray(whole)
                raw[at] ^= 1 << rng.randrange(8)
                path.write_bytes(raw)
                assert len(contents(path)) >= len(written) - 100, at

    @pytest.mark.parametrize("damage", some(DAMAGES, 2))
    def test_finishing_may_be_killed_at_any_byte(
        self, tmp_path: Path, damage: Callable[[bytearray, random.Random], None]
    ) -> None:
        rng, path, killed = random.Random(damage.__name__), tmp_path / "a.mcap", dict[Path, Counted]()
        write(path, finish=False)
        raw = bytearray(path.read_bytes())
        damage(raw, rng)
        path.write_bytes(raw)
        read, size = contents(path), _finish_until_killed(path, math.inf)
        made = finish(path)
        assert size > 1000
        for number in range(4 * TIMES):
            path = tmp_path / f"{number}.mcap"
            path.write_bytes(raw)
            _finish_until_killed(path, rng.randrange(size))
            again = finish(path)
            assert (again.messages, again.missing) == (made.messages, made.missing)
            assert contents(path) == read
            killed[path] = Counted(len(read), len(read), len(read))
            assert by_mcap(path) == killed[path]
        assert by_mcap_core(list(killed)) == list(killed.values())

    @pytest.mark.parametrize("level", [0, 3])
    def test_a_recording_inside_a_payload_is_not_taken_for_one_of_the_file(self, tmp_path: Path, level: int) -> None:
        inner, path = tmp_path / "inner.mcap", tmp_path / "a.mcap"
        write(inner, 500, level=0)
        foreign = inner.read_bytes()
        rng = random.Random(7)
        with path.open("wb", buffering=0) as file:
            writer = McapWriter(file, library="pebble test", packer=Packer(level))
            channel = writer.channel("pebble/robots/goob/incoming/file", "application/octet-stream", {})
            for number in range(20):
                writer.add(channel, START_NS + number * STEP_NS, foreign if number % 5 == 2 else rng.randbytes(50_000))
                writer.flush()
        whole = path.read_bytes()
        for _ in range(60):
            raw = bytearray(whole)
            zero_a_page(raw, rng)
            path.write_bytes(raw)
            assert {topic for topic, _ in contents(path)} <= {"pebble/robots/goob/incoming/file"}

    def test_nothing_but_garbage(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        for garbage in (b"", bytes(5000), random.Random(1).randbytes(5000), b"\x89MCAP0\r\n"):
            path.write_bytes(garbage)
            assert contents(path) == []
            with pytest.raises(RecordingError):
                finish(path)
            assert path.read_bytes() == garbage


class _KilledError(BaseException):
    pass


def _finish_until_killed(path: Path, budget: float) -> int:
    """Finish a file, but no further than after so many bytes, as its file is not buffered; returns how many."""
    written = 0

    def write(file: BinaryIO, data: bytes) -> None:
        nonlocal written
        part = data[: int(min(len(data), budget - written))]
        written += file.write(part)
        if written >= budget:
            raise _KilledError

    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(_KilledError):
        patch.setattr("pebble.recordings.files.finish._write", write)
        finish(path)
    return written


def _records(raw: bytes) -> list[int]:
    found, at = [], 8
    while at < len(raw):
        found.append(at)
        at += 9 + int.from_bytes(raw[at + 1 : at + 9], "little")
    return found[1:]


def test_each_file_has_a_name_of_its_own(tmp_path: Path) -> None:
    names = set()
    for number in range(2):
        path = tmp_path / f"{number}.mcap"
        write(path, 5)
        with mapped(path) as data:
            summary = Summary.of(data)
        assert summary is not None
        names |= {channel.metadata["file"] for channel in summary.channels.values() if channel.topic == FILE_TOPIC}
    assert len(names) == 2


READER = """
import sys, time
from pathlib import Path
from pebble.recordings.files.reader import mapped

with mapped(Path(sys.argv[1])) as data:
    print("mapped", flush=True)
    sys.stdin.readline()
    print(sum(data[at] for at in range(0, len(data), 512)), flush=True)
"""


def test_a_file_is_not_cut_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader of memory behind the end of its file is ended by SIGBUS."""
    path = tmp_path / "x.mcap.active"
    write(path, finish=False)
    with path.open("ab") as file:
        file.write(bytes(5_000_000))
    reader = subprocess.Popen(
        [sys.executable, "-c", READER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert reader.stdout is not None
    assert reader.stdout.readline() == "mapped\n"
    monkeypatch.setattr("pebble.recordings.files.finish.READERS_S", 0.3)
    with pytest.raises(OSError, match="is being read: try again later"):
        finish(path)
    reader.communicate("\n", 10)
    assert reader.returncode == 0
    assert finish(path).torn_bytes >= 5_000_000
