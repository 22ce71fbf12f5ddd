"""The control comparison: what a slice counts, order of the slices, and a short real run that leaves nothing."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.control import ONE_WAY, ROUND_TRIP, VARIANTS, Participants
from pebble.extensions.lab.bench.control_ends import (
    REPLIES,
    Connection,
    EndInbox,
    Handler,
    Sender,
    Slice,
    SliceSpec,
    echo,
)
from pebble.extensions.lab.bench.results import load
from pebble.extensions.lab.rig.processes import children
from tests.support import ROOT


class Loop:
    """A connection to an echo in this process; ``spoil`` changes the replies."""

    def __init__(self, spoil: Callable[[bytes], list[bytes]] = lambda payload: [payload]) -> None:
        self._handlers: dict[str, Handler] = {}
        self._spoil = spoil
        self.sizes: list[int] = []
        self.connection = Connection(self._handlers.__setitem__, self.publish, lambda: None)

    def publish(self, topic: str, payload: bytes) -> None:
        self.sizes.append(len(payload))
        for one in self._spoil(payload) if topic == REPLIES else [payload]:
            self._handlers[topic](one)


def exchanged(loop: Loop, spec: SliceSpec) -> Slice:
    echo(loop.connection)
    sender = Sender(loop.connection, EndInbox())
    assert sender.warm_up(2, 5.0)
    done = sender.run(spec)
    assert all(one.sent_ns <= one.echoed_ns <= one.received_ns for one in done.exchanges)
    return done


def test_a_slice_counts_what_it_sends_after_the_first_tenth_of_a_second() -> None:
    loop = Loop()
    done = exchanged(loop, SliceSpec(size=64, rate=500, seconds=0.1))
    assert (done.sent, len(done.exchanges)) == (50, 50)
    assert len(loop.sizes) == 2 * (2 + 50 + 50)
    assert set(loop.sizes[4:]) == {64}


def test_what_comes_twice_counts_once_and_what_does_not_come_is_lost() -> None:
    def spoil(payload: bytes) -> list[bytes]:
        number = int.from_bytes(payload[:8], "little")
        return [payload, payload] if number < 10 or number % 2 else []

    done = exchanged(Loop(spoil), SliceSpec(size=40, rate=1000, seconds=0.05))
    assert (done.sent, len(done.exchanges)) == (50, 25)


def command(*options: str) -> list[str]:
    return [sys.executable, "-m", "pebble.cli", "bench", "control", *options]


@pytest.mark.thorough
@pytest.mark.parametrize(("variants", "loads"), [([*VARIANTS], ["none", "hog"]), (["mqtt", "zenoh-p2p"], ["media"])])
def test_variants_alone_and_beside_a_load(
    variants: list[str], loads: list[str], temporary: Path, tmp_path: Path
) -> None:
    options = ("--sizes", "40", "--rates", "200", "--seconds", "0.1", "--rounds", "1", "--output", str(tmp_path / "o"))
    ended = subprocess.run(
        command(*options, "--variants", ",".join(variants), "--loads", ",".join(loads)),
        env={**os.environ, "TMPDIR": str(temporary)}, cwd=ROOT, capture_output=True, text=True, timeout=100,
        check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    results = load(tmp_path / "o" / "control.json")
    for variant, load_ in product(variants, loads):
        assert variant in ended.stdout
        there, back = (results.find(variant, measure, load=load_) for measure in (ONE_WAY, ROUND_TRIP))
        assert there is not None
        assert back is not None
        assert all(0 < a < b for a, b in zip(there.samples, back.samples, strict=True))
        assert (there.middle("pictures_hz") > 0) == (load_ == "media")
    assert list(temporary.iterdir()) == []


def test_a_process_that_dies_is_named() -> None:
    with Participants(["mqtt"]) as participants:
        lines = {pid: Path(f"/proc/{pid}/cmdline").read_text() for pid in children(os.getpid())}
        os.kill(next(pid for pid, line in lines.items() if "\0sender\0" in line), signal.SIGKILL)
        with pytest.raises(PebbleError, match="mqtt: sender ended with code -9"):
            participants.run("mqtt", SliceSpec(size=40, rate=100.0, seconds=0.1), "none")


def test_the_broker_gets_the_lines_of_its_variant() -> None:
    with Participants(["mqtt-nodelay"]) as participants:
        assert "set_tcp_nodelay true" in next(participants.folder.glob("*/broker.conf")).read_text().splitlines()
