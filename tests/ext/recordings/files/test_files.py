"""MCAP files: as other readers want them, and in any state of damage."""

from __future__ import annotations

import os
import random
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from pebble.extensions.recordings.catalogue import look_at
from pebble.extensions.recordings.files.reader import RecordingFile
from pebble.extensions.recordings.files.recorded import UNNAMED, RecordingError
from pebble.extensions.recordings.files.rewrite import rewrite
from tests.ext.recordings.playing import DRIVE, MEDIA, STEP_NS, THEN_NS, contents, read, write_random
from tests.kit.npm import package
from tests.support import cases


class Counted(NamedTuple):
    """Messages of a file."""

    statistics: int
    indexed: int
    streamed: int


def by_mcap(path: Path) -> Counted:
    """The messages as the package ``mcap`` reads them."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        indexed = sum(1 for _ in reader.iter_messages())
        file.seek(0)
        names = [type(record).__name__ for record in StreamReader(file, validate_crcs=True).records]
        return Counted(summary.statistics.message_count, indexed, names.count("Message"))


def by_mcap_core(paths: list[Path]) -> list[Counted]:
    """The messages of each file as npm's ``@mcap/core`` reads them."""
    package("@mcap/core")
    command = ["node", Path(__file__).with_name("mcap_core.cjs"), *paths]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    return [Counted(*map(int, line.split())) for line in done.stdout.splitlines()]


TIMES = cases(1, 6)


def is_part_of(some: list[tuple[str, bytes]], whole: list[tuple[str, bytes]]) -> bool:
    """Whether ``some`` are in ``whole``, in its order."""
    rest = iter(whole)
    return all(one in rest for one in some)


class TestWhole:
    @pytest.mark.parametrize("count", [2000, 0])
    def test_other_readers_read_it(self, tmp_path: Path, count: int) -> None:
        path = tmp_path / "a.mcap"
        written = write_random(path, count)
        assert [by_mcap(path), *by_mcap_core([path])] == [Counted(count, count, count)] * 2
        found, damage = read(path)
        assert (found, damage.report()) == (written, "")

    @pytest.mark.parametrize("finish", [True, False])
    def test_a_period_and_some_channels_are_read(self, tmp_path: Path, finish: bool) -> None:
        path = tmp_path / "a.mcap"
        written = write_random(path, finish=finish)
        since, until = THEN_NS + 500 * STEP_NS, THEN_NS + 700 * STEP_NS
        assert contents(path, since_ns=since, until_ns=until) == written[500:700]
        topic = "pebble/robots/r3/outgoing/t3"
        chosen = contents(path, chooses=lambda channel: channel.topic == topic)
        assert chosen == [message for message in written if message[0] == topic]

    def test_one_that_is_written_is_read_so_far_as_it_is(self, tmp_path: Path) -> None:
        """Byte by byte: the last chunk, and the indexes behind it, are often there only in part."""
        source, path = tmp_path / "a.mcap", tmp_path / "growing.mcap.active"
        written = write_random(source, 300, each=50, finish=False)
        data, lengths = source.read_bytes(), list[int]()
        path.write_bytes(data[:40])
        with RecordingFile(path) as file:
            for end in range(40, len(data) + 1, 149):
                path.write_bytes(data[:end])
                file.refresh()
                lengths.append(sum(len(file.messages(chunk)) for chunk in file.chunks))
            path.write_bytes(data)
            file.refresh()
            assert [(one.channel.topic, one.payload) for one in file.read()] == written
            assert file.damage.parts == set()
        assert sorted(set(lengths)) == [0, 50, 100, 150, 200, 250, 300]
        assert lengths == sorted(lengths)


@pytest.mark.parametrize(("path", "messages", "channels"), [(DRIVE, 1047, 67), (MEDIA, 197, 4)])
def test_files_of_the_last_version_are_read_as_the_package_reads_them(path: Path, messages: int, channels: int) -> None:
    with RecordingFile(path) as file, path.open("rb") as data:
        found = list(file.read())
        records = list(StreamReader(data, validate_crcs=True).records)
        assert (file.damage.report(), len(file.channels)) == ("", channels)
    wanted = [record for record in records if type(record).__name__ == "Message"]
    topics = {record.id: record.topic for record in records if type(record).__name__ == "Channel"}
    assert len(found) == messages
    assert [(one.channel.topic, one.log_ns, one.publish_ns, one.payload) for one in found] == [
        (topics[one.channel_id], one.log_time, one.publish_time, one.data) for one in wanted
    ]


def cut(raw: bytearray, rng: random.Random) -> None:
    del raw[rng.randrange(len(raw)) :]


def flip(raw: bytearray, rng: random.Random, bits: int = 8) -> None:
    for _ in range(bits):
        raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(8)


def zero_a_page(raw: bytearray, rng: random.Random) -> None:
    begin = rng.randrange(len(raw))
    raw[begin : begin + 4096] = bytes(len(raw[begin : begin + 4096]))


def end_in_zeros(raw: bytearray, rng: random.Random) -> None:
    cut(raw, rng)
    raw += bytes(rng.randrange(20_000))


def lose_a_part(raw: bytearray, rng: random.Random) -> None:
    begin = rng.randrange(len(raw))
    del raw[begin : begin + rng.randrange(60_000)]


class TestDamaged:
    @pytest.mark.parametrize(
        ("damage", "finished"), [(flip, True), (zero_a_page, False), (end_in_zeros, False), (lose_a_part, True)]
    )
    def test_all_that_is_left_is_read_mended_and_what_is_missing_is_known(
        self, tmp_path: Path, damage: Callable[[bytearray, random.Random], None], finished: bool
    ) -> None:
        rng, path = random.Random(f"{damage.__name__}{finished}"), tmp_path / "a.mcap"
        mended: dict[Path, Counted] = {}
        written = write_random(path, finish=finished)
        whole = path.read_bytes()
        for number in range(2 * TIMES):
            raw, path = bytearray(whole), tmp_path / f"{number}.mcap"
            damage(raw, rng)
            path.write_bytes(raw)
            found, report = read(path)
            assert is_part_of([one for one in found if not one[0].startswith(UNNAMED)], written)
            if damage in (flip, zero_a_page) and not report.torn:  # a torn end may have held more
                assert report.missing == len(written) - len(found)
            copy = tmp_path / f"{number}-mended.mcap"
            made = rewrite(path, copy)
            assert path.read_bytes() == raw
            assert (made.messages, made.missing, contents(copy)) == (len(found), report.missing, found)
            mended[copy] = by_mcap(copy)
            assert mended[copy] == Counted(len(found), len(found), len(found))
        assert by_mcap_core(list(mended)) == list(mended.values())

    def test_one_bit_costs_a_chunk_at_most(self, tmp_path: Path) -> None:
        rng, path = random.Random(1), tmp_path / "a.mcap"
        written = write_random(path)
        whole = path.read_bytes()
        for _ in range(25 * TIMES):
            raw = bytearray(whole)
            flip(raw, rng, 1)
            path.write_bytes(raw)
            found, damage = read(path)
            assert is_part_of(found, written)
            assert len(written) - len(found) == damage.missing in (0, 100)

    def test_bits_of_what_has_no_checksum(self, tmp_path: Path) -> None:
        """A bit of opcodes and lengths of each record: a wrong one must not hide the others."""
        rng, path, step = random.Random(3), tmp_path / "a.mcap", cases(27, 1)
        written = write_random(path, 600, finish=False)
        whole = path.read_bytes()
        for begin in _records(whole):
            for at in range(begin + rng.randrange(step), begin + 9, step):
                raw = bytearray(whole)
                raw[at] ^= 1 << rng.randrange(8)
                path.write_bytes(raw)
                found = contents(path)
                assert is_part_of(found, written), at
                assert len(found) >= len(written) - 100, at

    @pytest.mark.parametrize("garbage", [b"", random.Random(1).randbytes(5000)])
    def test_nothing_but_garbage(self, tmp_path: Path, garbage: bytes) -> None:
        path = tmp_path / "a.mcap"
        path.write_bytes(garbage)
        found, damage = read(path)
        assert (found, damage.finished) == ([], False)
        assert damage.report()


def _records(raw: bytes) -> list[int]:
    found, at = [], 8
    while at < len(raw):
        found.append(at)
        at += 9 + int.from_bytes(raw[at + 1 : at + 9], "little")
    return found[1:]


# -- copies: mended, or without some messages


def test_without_some_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written = write_random(path)
    path.chmod(0o640)
    os.utime(path, (1_000_000_000, 1_000_000_000))
    made = rewrite(path, path, keeps=lambda message: "/r3/" not in message.channel.topic)
    rest = [one for one in written if "/r3/" not in one[0]]
    assert contents(path) == rest
    assert (made.messages, made.left_out) == (len(rest), len(written) - len(rest))
    assert (path.stat().st_mode & 0o777, path.stat().st_mtime) == (0o640, 1_000_000_000)
    assert by_mcap(path) == Counted(len(rest), len(rest), len(rest))
    assert not list(tmp_path.glob(".*"))


def test_what_is_missing_stays_known(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_random(path, finish=False)
    raw = bytearray(path.read_bytes())
    zero_a_page(raw, random.Random(3))
    path.write_bytes(raw)
    missing = look_at(path).missing
    assert missing > 0
    for number in range(2):
        copy = tmp_path / f"{number}.mcap"
        assert rewrite(path, copy).missing == missing
        assert (look_at(copy).missing, look_at(copy).damaged) == (missing, True)
        path = copy


def test_more_topics_than_a_file_can_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, copy = tmp_path / "a.mcap", tmp_path / "copy.mcap"
    write_random(path)
    monkeypatch.setattr("pebble.extensions.recordings.files.rewrite.MOST_CHANNELS", 19)
    with pytest.raises(RecordingError, match="one file has no room for more topics"):
        rewrite(path, copy)
    assert not copy.exists()
