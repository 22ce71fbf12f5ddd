"""The guard of a Linux robot's motors: what it publishes, saves and refuses. The rules themselves: tests/motion."""

import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec import structs

from pebble.config import Security
from pebble.contract.payloads import ControlRequest, Drive, EstopCommand, EstopReset, EstopState
from pebble.motors.control import Control
from pebble.motors.motor_guard import MotorGuard
from pebble.motors.state_file import StateFile
from pebble.transports.counters import Counters
from tests.support import WAIT_S, until

A, B = "00000000000000aa", "00000000000000bb"
SCRIPT = Drive(z=0.5, source="autonomy", run=7)


class Rig:
    """A guard on a clock that the test moves; writes end when the test waits for them."""

    def __init__(self, path: Path, owners: tuple[str, ...] = (), **security: Any) -> None:
        self.now = 100.0
        self.states: list[EstopState] = []
        self.counters = Counters()
        self._results: list[tuple[int, bool]] = []
        self.file = StateFile(path, lambda number, succeeded: self._results.append((number, succeeded)))
        self.barred_file = StateFile(path.with_name("barred.json"))
        self.control = Control(Security(**security), lambda _state: None, self.now, "serial", owners)
        self.guard = MotorGuard(
            self.file, self.barred_file, self.states.append, self.counters, self.control, watchdog_s=0.75, now=self.now
        )
        self.guard.begin(self.now)

    def stop(self, name: str = A, **texts: str) -> None:
        self.guard.stop(EstopCommand(stop=name, **texts), self.now)

    def reset(self, state: EstopState, age_s: float = 0.0) -> None:
        self.guard.reset(EstopReset(boot=state.boot, count=state.count), age_s, self.now)

    def written(self) -> bool:
        """Wait until the file's thread has written, and pass the result on."""
        assert until(lambda: self._results)
        succeeded = self._results[-1][1]
        self.guard.on_saved(*self._results.pop(), self.now)
        self._results.clear()
        return succeeded

    def advance(self, seconds: float) -> None:
        self.now += seconds
        self.guard.tick(self.now)

    def close(self) -> None:
        self.file.close()
        self.barred_file.close()

    @property
    def state(self) -> EstopState:
        return self.guard.state()


Make = Callable[..., Rig]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "estop-serial.json"


@pytest.fixture
def make(path: Path) -> Iterator[Make]:
    """A guard as the one of a process that starts now."""
    with ExitStack() as ends:

        def made() -> Rig:
            rig = Rig(path)
            ends.callback(rig.close)
            return rig

        yield made


@pytest.fixture
def rig(make: Make) -> Rig:
    rig = make()
    rig.advance(3)
    return rig


def test_a_zero_of_a_script_that_starts_with_the_robot_bars_older_runs_silently(
    path: Path, caplog: pytest.LogCaptureFixture, make: Make
) -> None:
    """A manager publishes it at its start, mostly before the motor owner admits scripts: its predecessor's may run."""
    rig = make()
    assert rig.guard.judge(Drive(source="autonomy", run=8), rig.now) is None
    assert (rig.state.barred, caplog.text) == (7, "")
    rig.advance(3)
    assert rig.guard.judge(SCRIPT, rig.now) is None
    assert "refused a drive command: run 7 has ended" in caplog.text


def test_a_stop_is_published_at_once_and_again_when_it_is_saved(
    rig: Rig, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rig.stop(A, by="eve", why="a test")
    assert (rig.states[-1].latched, rig.states[-1].recent, rig.states[-1].persisted) == (True, [A], False)
    assert rig.states[-1].since == pytest.approx(1000 * time.time(), abs=60_000)
    assert rig.written()
    assert (rig.states[-1].latched, rig.states[-1].persisted, rig.states[-1].by) == (True, True, "eve")
    assert json.loads(path.read_text())["latched"] is True
    assert rig.guard.judge(Drive(z=1), rig.now) is None
    assert rig.counters["latched"] == 1
    rig.guard.stop(EstopCommand(), rig.now)
    rig.guard.stop(EstopCommand(), rig.now)
    assert len(set(rig.state.recent)) == rig.state.count == 3, "a stop without a name gets one"
    assert {len(name) for name in rig.state.recent} == {16}
    for sender in ("eve (a test)", "an unnamed sender"):
        assert f"emergency stop by {sender}" in caplog.text


def test_the_end_of_an_older_write_is_not_published(rig: Rig) -> None:
    for name in (A, B):
        rig.stop(name)
    rig.advance(1)
    before = len(rig.states)
    rig.guard.on_saved(1, True, rig.now)
    assert (rig.states[before:], rig.state.persisted) == ([], False)
    rig.guard.on_saved(2, False, rig.now)
    assert (rig.states[before:], rig.state.persisted) == ([rig.state], False)


def test_its_sender_is_published_and_saved_once_that_was_checked(rig: Rig, path: Path) -> None:
    rig.stop(A, by="otto?")
    rig.stop(A, by="ann")
    assert rig.states[-1].by == "ann"
    assert until(lambda: rig.written() and rig.states[-1].persisted), "each stop is written by itself"
    assert (rig.states[-1].by, rig.state.count, rig.states[-1].persisted) == ("ann", 1, True)
    assert json.loads(path.read_text())["by"] == "ann"


def test_at_most_four_states_a_second_and_the_last_one_is_published(rig: Rig) -> None:
    before = len(rig.states)
    for number in range(90):
        rig.stop(f"{number:016x}")
        rig.advance(0.01)
    assert len(rig.states) - before == 4
    assert rig.guard.due is not None
    rig.advance(1)
    assert rig.states[-1].count == 90
    assert rig.states[-1].recent == [f"{number:016x}" for number in range(89, 81, -1)]


def test_a_repetition_is_answered_a_quarter_of_a_second_after_the_last_state(rig: Rig) -> None:
    rig.stop(A)
    assert rig.written()
    rig.advance(1)
    rig.guard.repeat_state(rig.now)  # for brokers that were restored
    assert rig.states[-1] == rig.state
    for seconds, answers in ((0.125, []), (0.125, [rig.state]), (0.125, [])):
        rig.advance(seconds)
        before = len(rig.states)
        rig.stop(A)
        assert rig.states[before:] == answers


def test_a_restart_begins_as_it_was(rig: Rig, make: Make, caplog: pytest.LogCaptureFixture) -> None:
    rig.stop(A, by="eve", why="a test")
    assert rig.written()
    again = make()
    assert (again.state.latched, again.state.recent, again.state.by, again.state.why) == (True, [A], "eve", "a test")
    assert again.state.boot != rig.state.boot
    assert "still stopped by eve (a test)" in caplog.text
    assert again.state.persisted is False  # written again: who wrote it may have been killed before it was durable
    assert again.written()
    assert again.states[-1].persisted is True
    again.reset(rig.state)
    assert (again.state.latched, again.state.reset_refused) == (True, "boot")
    again.reset(again.state)
    assert not again.state.latched
    assert again.written()
    free = make()
    assert (free.state.latched, free.state.recent) == (False, [A])
    free.stop(A)
    assert not free.state.latched  # a repetition of the stop that was reset


@pytest.mark.parametrize(
    ("name", "content", "barred"),
    [
        *(("estop-serial.json", text, 0) for text in ("", "[]", '{"latched": 1, "recent": []}')),
        *(("barred.json", text, 0) for text in ("{", "0", "true", "1.5", "1073741824")),
        *(("barred.json", str(run), run) for run in (1, 1073741823)),
    ],
)
def test_a_file_that_is_none_of_ours_counts_as_a_stop_and_bars_nothing(
    path: Path, name: str, content: str, barred: int, make: Make
) -> None:
    path.parent.mkdir()
    path.with_name(name).write_text(content)
    rig = make()
    rig.advance(3)
    assert (rig.state.latched, rig.guard.barred) == (name != "barred.json", barred)
    assert rig.guard.judge(SCRIPT, rig.now) == (None if rig.state.latched else 0.75)


def test_a_failed_write_is_published_and_repeated(rig: Rig, path: Path) -> None:
    path.mkdir(parents=True)
    rig.stop()
    assert not rig.written()
    assert rig.states[-1].persisted is False
    path.rmdir()
    rig.guard.save_again()
    rig.advance(1)
    assert rig.written()
    assert rig.states[-1].persisted is True
    rig.guard.save_again()
    assert rig.guard.persisted


def test_a_write_that_takes_long_is_not_repeated_until_it_has_ended(
    rig: Rig, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a disk that takes longer than the pause between two attempts would never have the newest state."""
    may_end = threading.Event()
    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: may_end.wait(WAIT_S) and sync(file))
    rig.stop()
    assert until(path.parent.exists)
    path.write_text("{}")  # nor for what appears meanwhile
    for _ in range(3):
        rig.guard.save_again()
        assert rig.guard.appeared_stop() is None
    may_end.set()
    assert rig.written()
    assert rig.state.persisted is True


def test_a_barred_run_is_published_and_stays_barred_after_a_restart(rig: Rig, path: Path, make: Make) -> None:
    assert rig.guard.judge(SCRIPT, rig.now) == 0.75
    assert rig.state.barred == 6
    assert rig.guard.judge(Drive(), rig.now) == 0
    assert rig.states[-1].barred == 7
    assert rig.guard.judge(SCRIPT, rig.now + 10) is None
    assert rig.counters["overruled"] == 1
    rig.close()
    again = make()
    assert again.state.barred == 7
    again.advance(10)
    assert again.guard.judge(SCRIPT, again.now) is None
    assert again.guard.judge(structs.replace(SCRIPT, run=8), again.now) == 0.75


def test_a_person_who_was_lost_bars_the_run_at_the_end_of_the_hold_without_any_further_command(rig: Rig) -> None:
    assert rig.guard.judge(SCRIPT, rig.now) == 0.75
    assert rig.guard.judge(Drive(z=1, valid_ms=400), rig.now) == 0.4
    assert rig.guard.due is not None
    rig.advance(1.9)
    assert (rig.state.barred, rig.guard.due) == (6, pytest.approx(rig.now + 0.11))
    rig.now = rig.guard.due
    rig.guard.tick(rig.now)
    assert rig.states[-1].barred == 7
    assert rig.guard.due is None


def test_what_is_barred_is_written_again_once_its_file_is_removed(rig: Rig) -> None:
    rig.guard.judge(Drive(source="autonomy", run=8), rig.now)
    for _ in range(2):
        assert until(lambda: rig.barred_file.in_place and not rig.barred_file.busy)
        rig.barred_file.path.unlink()
        rig.guard.save_again()
    assert until(lambda: rig.barred_file.load() == 7)


#: What happens before a command that is refused, which one, how it is counted, and what the log says.
REFUSED: dict[str, tuple[tuple[str, ...], Drive, str, str]] = {
    "a zero of a script": (("drive",), Drive(source="autonomy", run=7), "overruled", ""),
    "without a key": (("control", "stop"), Drive(z=1), "stranger", "only who has control may drive"),
    "stopped": (("stop",), Drive(z=1), "latched", "the robot is stopped"),
    "no zero since the reset": (("stop", "reset"), Drive(z=1), "overruled", "after the reset no zero and no pause"),
    "a person drives": (("drive",), SCRIPT, "overruled", "run 7 has to wait"),
    "its run has ended": (("next",), Drive(z=1, source="autonomy", run=1), "overruled", "run 1 has ended"),
    "a script beside a person": (("control", "stop"), SCRIPT, "latched", "the robot is stopped"),
    "a key of nobody": ((), Drive(z=1, key="00000000"), "stranger", "its key of control is not the one of now"),
}


@pytest.mark.parametrize(("before", "drive", "counted", "why"), REFUSED.values(), ids=REFUSED)
def test_why_a_command_is_refused(
    rig: Rig, caplog: pytest.LogCaptureFixture, before: tuple[str, ...], drive: Drive, counted: str, why: str
) -> None:
    happens: dict[str, Callable[[], object]] = {
        "stop": rig.stop,
        "control": lambda: rig.control.request(ControlRequest(id="aaaaaaaa", by="ann"), over=False, now=rig.now),
        "reset": lambda: rig.reset(rig.state),
        "drive": lambda: rig.guard.judge(Drive(z=1), rig.now),
        "next": lambda: rig.guard.judge(Drive(source="autonomy", run=2), rig.now),
    }
    for event in before:
        happens[event]()
    assert rig.guard.judge(drive, rig.now) is None
    assert rig.counters[counted] == 1
    assert (f"refused a drive command: {why}" in caplog.text) == bool(why)


def test_a_program_of_the_robot_is_no_stranger_where_names_are_checked(path: Path) -> None:
    with closing(Rig(path, level="named", strangers="refuse")) as rig:
        rig.stop()
        assert rig.guard.judge(Drive(z=1), rig.now) is None
        rig.control.request(ControlRequest(id="aaaaaaaa", by="ann"), over=False, now=rig.now)
        assert rig.guard.judge(Drive(z=1, key=rig.control.state().key, by="ann"), rig.now) is None
        assert (rig.counters["latched"], rig.counters["stranger"]) == (2, 0)


def test_the_largest_state_has_400_bytes_at_most(rig: Rig) -> None:
    rig.guard.judge(Drive(source="autonomy", run=(1 << 30) - 1), rig.now)
    for number in range(1000):
        rig.stop(f"{number:016x}", by="b" * 32, why="w" * 40)
    rig.reset(EstopState(latched=True, boot="", count=1000, recent=[], by="", why="", since=0), 0.0)
    rig.guard.reset(EstopReset(boot=rig.state.boot, count=7), 0.0, rig.now)
    assert len(msgspec.json.encode(rig.state)) <= 400


def test_a_stop_whose_file_was_removed_is_written_again(rig: Rig, path: Path, make: Make) -> None:
    rig.stop()
    assert rig.written()
    rig.guard.save_again()
    assert not rig.file.busy
    path.parent.rename(path.parent.with_name("moved"))
    rig.guard.save_again()
    assert rig.written()
    rig.close()
    assert make().state.latched


OLD = {"latched": True, "recent": [B], "by": "eve", "why": "before the power cut", "since": 1}


@pytest.mark.parametrize(
    ("before", "content", "found"),
    [
        ("nothing", json.dumps(OLD), B),  # the folder is mounted late
        ("nothing", json.dumps({**OLD, "latched": False}), ""),
        ("nothing", "{", "a new name"),  # as at the start, what cannot be read counts as a stop
        ("a reset", json.dumps(OLD), B),
        ("a reset", json.dumps({**OLD, "recent": [A]}), ""),  # known, and reset: the folder came back as it was
        ("a stop", json.dumps(OLD), ""),  # stopped already
    ],
)
def test_a_stop_in_a_file_that_appears(path: Path, before: str, content: str, found: str, make: Make) -> None:
    rig = make()
    if before != "nothing":
        rig.stop(A)
    if before == "a reset":
        rig.reset(rig.state)
    assert before == "nothing" or rig.written()
    assert until(lambda: not rig.file.busy)
    mounted = path.parent.with_name("mounted")
    mounted.mkdir()
    (mounted / path.name).write_text(content)
    shutil.rmtree(path.parent, ignore_errors=True)
    mounted.rename(path.parent)
    stop = rig.guard.appeared_stop()
    assert bool(stop) == bool(found)
    if stop is not None:
        assert (found in (stop.stop, "a new name"), len(stop.stop)) == (True, 16)
        rig.guard.stop(stop, rig.now)
        assert (rig.state.latched, rig.state.by) == (True, "" if content == "{" else "eve")
    else:
        assert rig.written()
    assert rig.guard.appeared_stop() is None
    rig.close()
    assert make().state.latched == (bool(found) or before == "a stop")


def test_where_nothing_can_be_saved_persisted_is_null_and_later_it_gets_the_stop(
    make: Make, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path.parent.write_text("in the way")
    rig = make()
    assert "cannot be written: an emergency stop ends with a power cut" in caplog.text
    rig.stop()
    rig.guard.save_again()
    assert (rig.states[-1].latched, rig.states[-1].persisted, rig.guard.appeared_stop()) == (True, None, None)
    path.parent.unlink()
    rig.guard.save_again()
    assert rig.written()
    assert rig.state.persisted is True
