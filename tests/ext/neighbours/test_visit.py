"""What of another robot's script moves this one: histories in virtual time, with the arbiter of the motor owners."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from pebble.contract.payloads import SCRIPT, Drive, EstopState
from pebble.motion.arbiter import PERSON, Arbiter
from pebble.motion.latch import Latch
from pebble.motion.lease import Lease
from pebble.services.neighbours.begun import begin
from pebble.services.neighbours.visit import Visit

NAMES = ("goob", "ann")
STEP_S, LONG_S = 0.05, 60.0


class Fred:
    """A robot with one motor owner; goob's script drives it. ``moved`` are the senders whose commands moved it."""

    def __init__(self, folder: Path) -> None:
        self.now, self.file = 10.0, folder / "state" / "runs.json"
        self.local: int | None = None  # the run of its own script
        self.moved: list[str] = []
        self._boots, self._runs = itertools.count(1), itertools.count(100)
        self.restart()
        self.start_owner()
        self.wait(3)

    def restart(self) -> None:
        self.visit = Visit(partial(begin, self.file, NAMES), self._number, self.publish, lambda: self.local is not None)

    def start_owner(self) -> None:
        latch = Latch(f"boot{next(self._boots)}", 8, self._diff)
        lease = Lease(self._ms, self._diff, lambda count: "0badf00d"[: 2 * count], 0)
        self.owner = Arbiter(latch, lease, self._ms, self._diff, 750)
        self.publish_state()

    @staticmethod
    def _diff(later: int, earlier: int) -> int:
        return later - earlier

    @property
    def _ms(self) -> int:
        return int(1000 * self.now)

    def _number(self, _barred: int, _received: int) -> int | None:
        return next(self._runs) if self.local is None else None

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_S
            self.owner.tick(self._ms)
            self.publish_state()
            self.visit.tick(self.now)

    def publish_state(self) -> None:
        latch = self.owner.latch
        state = EstopState(**latch.state(True), barred=self.owner.barred)
        self.visit.owners({"wheels": state}, self.now)

    def publish(self, drive: Drive, sender: str = "neighbour") -> bool:
        run = drive.run if drive.signed else PERSON
        if self.owner.judge(drive.moves, run, drive.valid_ms if isinstance(drive.valid_ms, int) else -1, self._ms) > 0:
            self.moved.append(sender)
        self.visit.received(drive, self.now)
        self.publish_state()
        return True

    # -- what happens

    def goob(self, run: int = 7, seconds: float = 1.0, *, name: str = "goob", z: float = 0.5) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.visit.command(name, Drive(z=z, source=SCRIPT, run=run), self.now)
            self.wait(STEP_S)

    def person(self, z: float = 0.0) -> None:
        self.publish(Drive(z=z), "person")

    def drives_and_lets_go(self) -> None:
        self.person(0.3)
        self.wait(0.2)
        self.person()

    def script(self) -> None:
        """Its own is started: as the manager does it."""
        self.local = next(self._runs)
        self.publish(Drive(source=SCRIPT, run=self.local))

    def script_drives(self) -> None:
        assert self.local is not None
        self.publish(Drive(z=0.2, source=SCRIPT, run=self.local), "own script")

    def script_ended(self) -> None:
        self.script()
        self.wait(1)
        self.local = None

    def stopped_and_reset(self) -> None:
        self.owner.stop("0" * 16, "ann", "", 0)
        self.publish_state()
        self.wait(0.5)
        latch = self.owner.latch
        assert latch.reset(latch.boot, latch.count, 0, self._ms)
        self.publish_state()

    def unwritable(self) -> None:
        self.file.unlink()
        self.file.mkdir()

    def restart_unread(self) -> None:
        self.file.write_text("{")
        self.restart()


Happens = Callable[[Fred], None]


@pytest.fixture
def fred(tmp_path: Path) -> Fred:
    return Fred(tmp_path)


#: What ends goob's run at fred; whether a new start of its script moves fred after it.
ENDS: dict[str, tuple[Happens, bool]] = {
    "a person's zero": (Fred.person, True),
    "a person's zero between two commands, long after the last": (lambda fred: (fred.wait(1), fred.person())[1], True),
    "a person who drives and lets go": (Fred.drives_and_lets_go, True),
    "a person whose connection is lost": (lambda fred: fred.person(0.3), True),
    "an emergency stop and its reset": (Fred.stopped_and_reset, True),
    "a restart of the motor owner": (Fred.start_owner, True),
    "a restart of neighbours": (Fred.restart, True),
    "a script of fred's own": (Fred.script, False),
    "a script of fred's own that has ended": (Fred.script_ended, True),
    "a newer run of goob": (lambda fred: fred.goob(run=8), True),
    "a run of another robot": (lambda fred: fred.goob(run=3, name="ann"), True),
    "a damaged file at a restart": (Fred.restart_unread, False),
}


@pytest.mark.parametrize("what", ENDS)
def test_what_ends_a_run_ends_it_for_good_and_a_new_start_drives(fred: Fred, what: str) -> None:
    happens, drives_again = ENDS[what]
    fred.goob()
    assert set(fred.moved) == {"neighbour"}
    happens(fred)
    fred.moved.clear()
    fred.goob(seconds=LONG_S)
    assert fred.moved == []
    assert fred.visit.refused(fred.now)["goob"].run == 7
    fred.goob(run=9)
    assert bool(fred.moved) == drives_again


def test_fred_s_own_script_is_never_barred(fred: Fred) -> None:
    """Whichever started first, and however often goob's is started."""
    fred.goob()
    fred.script()
    for run in range(8, 20):
        fred.goob(run=run, seconds=0.2)
        fred.moved.clear()
        fred.script_drives()
        assert fred.moved == ["own script"]


#: What begins no run: a command of goob, and what happens before.
BEGINS_NOT: dict[str, tuple[Happens, Drive]] = {
    "no script": (lambda _: None, Drive(z=0.5)),
    "a script without a number": (lambda _: None, Drive(z=0.5, source=SCRIPT)),
    "a zero": (lambda _: None, Drive(source=SCRIPT, run=7)),
    "an older run": (lambda fred: fred.goob(run=8, seconds=STEP_S), Drive(z=0.5, source=SCRIPT, run=7)),
    "while a person drives": (lambda fred: fred.person(0.3), Drive(z=0.5, source=SCRIPT, run=7)),
    "while a script of its own runs": (Fred.script, Drive(z=0.5, source=SCRIPT, run=7)),
    "while what has begun cannot be written": (
        lambda fred: (fred.goob(run=6, seconds=STEP_S), fred.unwritable())[1],
        Drive(z=0.5, source=SCRIPT, run=7),
    ),
}


@pytest.mark.parametrize("what", BEGINS_NOT)
def test_what_begins_no_run(fred: Fred, what: str) -> None:
    happens, command = BEGINS_NOT[what]
    happens(fred)
    fred.moved.clear()
    assert not fred.visit.command("goob", command, fred.now)
    assert fred.moved == []


def test_a_zero_of_the_driver_stops_at_once_and_a_command_lasts_no_longer_than_a_third_of_a_second(fred: Fred) -> None:
    sent: list[Drive] = []
    number = itertools.count(1)
    visit = Visit(lambda *_: "", lambda *_: next(number), lambda one: not sent.append(one), lambda: False)
    for drive in (Drive(z=0.5, source=SCRIPT, run=7, valid_ms=5000, key="0badf00d"), Drive(source=SCRIPT, run=7)):
        assert visit.command("goob", drive, fred.now)
    assert [(one.z, one.run, one.valid_ms, one.key) for one in sent] == [
        (0.5, 1, 300, sent[0].key), (0.0, 1, 300, sent[0].key)
    ]  # fmt: skip
    assert not isinstance(sent[0].key, str)
