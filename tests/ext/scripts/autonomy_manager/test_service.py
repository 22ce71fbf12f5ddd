"""What the manager does with commands, ends of processes, motor owners and people."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.scripts.runs import SUPERSEDED
from pebble.services.autonomy_manager.catalogue import Catalogue
from pebble.services.autonomy_manager.motor_owners import OVERRIDDEN
from pebble.services.autonomy_manager.script import Dependency, Script
from tests.ext.scripts.autonomy_manager.fake_children import Bench, FakeChild, script
from tests.support import WAIT_S, until

TERM, KILL = signal.SIGTERM, signal.SIGKILL

SCRIPTS = {
    entry.file: entry
    for entry in (
        *(script("walk"), script("sing"), script("eyes"), script("wheel")),
        script("follow", Dependency("eyes"), Dependency("wheel")),
        script("old", ours=False),
        script("count", drives=False, label="Count steps"),
        script("stride", Dependency("count"), drives=False),
        script("pace", Dependency("walk"), drives=False),
    )
}
IDLE = {
    "running": False,
    "file": None,
    "pid": None,
    "dependencies": [],
    "error": None,
    "config": None,
    "controls": True,
}


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with closing(Bench(tmp_path, SCRIPTS)) as bench:
        yield bench


def run_of(child: FakeChild) -> int:
    return int(child.launch.environment["PEBBLE_RUN"])


def test_it_begins_idle_and_stops_what_a_predecessor_may_have_left(bench: Bench) -> None:
    assert bench.status == IDLE
    (halt,) = bench.drives
    assert (halt["source"], halt["x"], halt["z"]) == ("autonomy", 0, 0)
    walk = bench.start("walk", speed="0.25", unknown=[1])
    assert run_of(walk) > halt["run"]
    assert walk.launch.command[0:2] == ("walk", "--config")
    assert walk.launch.command[3:] == ("--speed", "0.25")
    assert walk.launch.environment["PEBBLE_CONFIG"] == walk.launch.command[2]
    assert walk.launch.tie is TERM
    runs = {"running": True, "file": "walk", "label": "walk", "pid": walk.pid, "config": {"speed": 0.25}}
    assert bench.status == IDLE | runs
    zero = {"x": 0.0, "z": 0.0, "y": 0.0, "source": "autonomy", "run": run_of(walk)}
    assert until(lambda: bench.drives[-1] == zero), "else a person who stops it before it drives would not end it"


def test_a_refused_start_leaves_the_running_script_alone(bench: Bench) -> None:
    walk = bench.start("walk")
    bench.command(True)
    assert bench.becomes(running=True, file="walk", pid=walk.pid, error="Start command missing file")
    assert walk.signals == []


def test_nonsense_does_nothing(bench: Bench) -> None:
    walk = bench.start("walk")
    for body in ({"file": "sing"}, {"action": "dance"}, b"\xff", b"[" * 5000, 7):
        bench.command(body)
    bench.quiet()
    assert (walk.signals, bench.children.files) == ([], ["walk"])


def test_stop_halts_the_wheels_and_the_run_that_has_ended_is_barred(bench: Bench) -> None:
    """Else a process that left the script's process group could drive on."""
    walk = bench.start("walk")
    bench.stop(walk)
    assert until(lambda: bench.zeros(run_of(walk)) == 1), "first"
    assert bench.status["running"] is True  # until it has ended
    walk.end(0)
    assert bench.becomes(**IDLE)
    bench.quiet()
    assert (bench.drives[-1]["run"], bench.drives[-1]["x"], bench.drives[-1]["z"]) == (run_of(walk) + 1, 0, 0)
    bench.advance(0.11)
    bench.advance(0.2)
    assert until(lambda: bench.zeros(run_of(walk)) == 4), "and again when the process has ended"
    assert run_of(bench.start("sing")) > run_of(walk) + 1, "a person may have barred that number meanwhile"


def test_what_does_not_end_is_killed(bench: Bench) -> None:
    walk = bench.start("walk")
    bench.stop(walk)
    bench.advance(7.9)
    assert walk.signals == [TERM]
    bench.advance(0.2)
    assert walk.signals == [TERM, KILL]
    walk.end(-KILL)
    assert bench.becomes(**IDLE)


def test_only_the_newest_request_counts_while_another_script_ends(bench: Bench) -> None:
    walk = bench.start("walk")
    for file in ("sing", "follow", "sing", "eyes"):
        bench.command({"action": "start", "file": file})
    bench.quiet()
    assert (walk.signals, bench.children.files) == ([TERM], ["walk"])
    walk.end(0)
    assert bench.becomes(running=True, file="eyes")
    assert bench.children.files == ["eyes"]
    bench.command({"action": "start", "file": "sing"})
    bench.command({"action": "stop"})
    bench.quiet()
    bench.children.all[-1].end(0)
    assert bench.becomes(**IDLE)
    assert bench.children.files == [], "a stop forgets what was to start next"


@pytest.mark.parametrize(
    ("code", "error"),
    [
        (0, None),
        (3, "walk exited with code 3"),
        (-9, "walk was ended by signal 9"),
        (143, "walk was ended by signal 15"),
    ],
)
def test_an_end_stops_the_wheels_and_nothing_is_started_again(bench: Bench, code: int, error: str | None) -> None:
    walk = bench.start("walk")
    walk.end(code)
    assert bench.becomes(**{**IDLE, "error": error})
    assert "stopped" not in bench.status
    bench.advance(0.11)
    bench.advance(0.2)
    bench.advance(60)
    assert until(lambda: bench.zeros(run_of(walk)) == 3)
    assert bench.children.files == []


def test_dependencies_come_first_with_the_same_run_and_go_last(bench: Bench) -> None:
    follow = bench.start("follow")
    eyes, wheel, _ = bench.children.all
    assert bench.children.files == ["eyes", "wheel", "follow"]
    assert {run_of(child) for child in bench.children.all} == {run_of(follow)}
    assert bench.status["dependencies"] == [
        {"file": "eyes", "pid": eyes.pid, "running": True},
        {"file": "wheel", "pid": wheel.pid, "running": True},
    ]
    bench.command({"action": "start", "file": "walk"})
    assert until(lambda: follow.signals == [TERM])
    assert (eyes.signals, wheel.signals) == ([], [])
    follow.end(0)
    assert until(lambda: eyes.signals == [TERM] == wheel.signals)
    assert bench.becomes(running=False)
    eyes.end(0)
    bench.quiet()
    assert bench.children.files == ["wheel"]
    wheel.end(-TERM)
    assert bench.becomes(running=True, file="walk", error=None, dependencies=[])


def test_a_dependencys_end_stops_the_script(bench: Bench) -> None:
    follow = bench.start("follow")
    eyes, wheel, _ = bench.children.all
    eyes.end(0)
    assert until(lambda: follow.signals == [TERM])
    assert until(lambda: bench.zeros(run_of(follow)) == 1)
    follow.end(1)
    assert until(lambda: wheel.signals == [TERM])
    wheel.end(0)
    assert bench.becomes(**{**IDLE, "error": "dependency eyes exited with code 0"})


def test_what_cannot_be_started_ends_what_was_started_for_it(bench: Bench) -> None:
    bench.children.failing = "wheel"
    bench.command({"action": "start", "file": "follow"})
    assert until(lambda: bench.children.all and bench.children.all[0].signals == [TERM])
    bench.children.all[0].end(0)
    assert bench.becomes(**{**IDLE, "error": "Failed to start follow: [Errno 2] No such file or directory: 'wheel'"})
    bench.children.failing = ""
    bench.start("walk")


# -- motor owners


def test_an_emergency_stop_ends_the_script_and_refuses_others_until_the_reset(bench: Bench) -> None:
    bench.owner(barred=500_000_000)
    walk = bench.start("walk")
    assert run_of(walk) > 500_000_000
    bench.owner(latched=True, count=1, by="ann")
    error = "emergency stop by ann of motor owner serial: reset it first"
    assert bench.becomes(error=error)
    assert walk.signals == [TERM]
    walk.end(0)
    assert bench.becomes(**{**IDLE, "error": error, "stopped": True})
    bench.command({"action": "start", "file": "sing"})
    assert bench.becomes(error=f"Failed to start sing: {error}")
    bench.owner(count=1, by="ann")
    assert bench.becomes(**IDLE), "a stop is no failure, and it ends with the reset"
    assert "stopped" not in bench.status
    bench.start("sing")


@pytest.mark.parametrize(("file", "signals"), [("stride", []), ("pace", [TERM]), ("old", [TERM])])
def test_only_what_declares_no_drive_with_all_that_it_needs_lives_through_a_stop(
    bench: Bench, file: str, signals: list[signal.Signals]
) -> None:
    bench.owner()
    child = bench.start(file)
    bench.owner(latched=True, count=1, by="ann", barred=bench.drives[-1]["run"])
    assert child.signals == signals
    bench.owner(boot="bb")
    assert child.signals == signals


def test_a_stop_while_another_script_ends_cancels_the_next_one(bench: Bench) -> None:
    bench.owner()
    walk = bench.start("walk")
    bench.command({"action": "start", "file": "sing"})
    bench.owner(latched=True, count=1)
    walk.end(0)
    assert bench.becomes(**{**IDLE, "error": "emergency stop of motor owner serial: reset it first"})
    bench.owner(count=1)
    assert bench.children.files == []


# -- people


def test_the_status_shows_that_a_person_drives(bench: Bench) -> None:
    bench.start("walk")
    assert "overridden" not in bench.status
    bench.drive(z=0.5, source="autonomy", run=7)
    bench.quiet()
    assert "overridden" not in bench.status
    bench.drive(z=0.5)
    assert bench.becomes(running=True, overridden=True)
    bench.advance(1.5)
    bench.drive(z=0.0)
    bench.quiet()
    bench.advance(1.5)
    assert bench.status["overridden"] is True

    def is_over() -> bool:  # the zero and the status travel by themselves: time goes on until they have arrived
        bench.advance(0.6)
        return "overridden" not in bench.status

    assert until(is_over)
    assert bench.status["running"] is True


KEY = {"key": "0badf00d"}


@pytest.mark.parametrize(
    ("drives", "status"),
    [
        ([{"z": 0.5, **KEY}], {"running": True, "overridden": True}),
        ([{"z": 0.5, **KEY}, {"z": 0.0, **KEY}, {"z": 0.4}], {"running": True, "overridden": True}),
        ([{"z": 0.0, "valid_ms": 0, **KEY}], {"error": OVERRIDDEN, "overridden": True}),
    ],
    ids=["a person with control", "who lets go", "who stops"],
)
def test_who_has_control_is_told_from_a_script_that_does_not_sign(
    bench: Bench, drives: list[dict[str, Any]], status: dict[str, Any]
) -> None:
    old = bench.start("old")
    for drive in drives:
        bench.drive(**drive)
    bench.quiet()
    bench.owner(barred=bench.drives[0]["run"] + 9)  # as its own zeros may bar it
    assert bench.becomes(**status)
    assert ("overridden" in bench.status) == ("overridden" in status)
    assert old.signals == ([TERM] if "error" in status else [])


def test_a_script_that_does_not_sign_ends_when_the_connection_of_who_drives_is_lost(bench: Bench) -> None:
    old = bench.start("old")
    assert "PEBBLE_RUN" not in old.launch.environment
    assert old.launch.tie is KILL, "with the manager"
    bench.drive(z=0.5, **KEY)
    assert bench.becomes(overridden=True)
    bench.advance(2.1)
    assert bench.becomes(error=OVERRIDDEN)
    assert old.signals == [TERM]


@pytest.mark.parametrize(("holder", "zeros"), [("", 1), ("page-1/ann", 0)])
def test_the_wheels_of_a_script_that_does_not_sign_stop_with_it(bench: Bench, holder: str, zeros: int) -> None:
    """A signed zero is refused for 2 s after what looks like a person's command; who has control is not stopped."""
    bench.holder(holder)
    old = bench.start("old")
    bench.drive(z=0.5)
    bench.quiet()
    bench.stop(old)
    old.end(-TERM)
    assert bench.becomes(**IDLE)
    zero = {"x": 0.0, "z": 0.0, "y": 0.0, "source": "autonomy_manager"}
    assert until(lambda: bench.drives[-1].get("run", 0) > bench.drives[1]["run"])
    assert bench.drives.count(zero) == zeros


def test_a_run_by_hand_ends_the_script_with_that_reason(bench: Bench) -> None:
    """The owner bars the run before the newer one, as if a person had stopped it."""
    walk = bench.start("walk")
    bench.drive(z=0.5, source="autonomy", run=run_of(walk) + 1)
    bench.owner(barred=run_of(walk))
    assert bench.becomes(error=SUPERSEDED)


def test_a_person_may_end_the_script_where_the_config_wants_it(tmp_path: Path) -> None:
    with closing(Bench(tmp_path, SCRIPTS, on_override="stop")) as bench:
        walk = bench.start("walk")
        bench.drive(x=0.1)
        assert bench.becomes(error=OVERRIDDEN)
        assert walk.signals == [TERM]


@pytest.mark.parametrize(
    ("drive", "file", "why"),
    [
        ({"z": 0.0, "valid_ms": 0}, "walk", f"{OVERRIDDEN} just now: start it again in 2 s"),
        ({"z": 0.5}, "old", "a person drives: start it again after 2 s without a command"),
    ],
)
def test_a_start_right_after_a_persons_last_command_is_refused_instead_of_ended_two_seconds_later(
    bench: Bench, drive: dict[str, float], file: str, why: str
) -> None:
    bench.drive(**drive)
    bench.quiet()
    bench.command({"action": "start", "file": file})
    assert bench.becomes(error=f"Failed to start {file}: {why}", running=False)
    bench.advance(2.01)
    bench.drive(z=0.0)  # a release
    bench.quiet()
    bench.start(file)


def test_where_names_are_checked_only_who_has_control_starts_a_script(tmp_path: Path) -> None:
    """Anybody ends one, and a program of the robot, which has no name, starts one."""
    with closing(Bench(tmp_path, SCRIPTS, named=True)) as bench:
        bench.holder("page-1/ann")
        bench.command({"action": "start", "file": "walk", "by": "otto"})
        assert bench.becomes(error="page-1/ann has control, and starts scripts")
        bench.command({"action": "start", "file": "walk", "by": "page-1/bob"})
        assert bench.becomes(running=True, file="walk")
        bench.command({"action": "stop", "by": "otto"})
        assert until(lambda: bench.children.all[-1].signals == [TERM])


@pytest.mark.parametrize(
    ("between", "status"),
    [
        (lambda bench: None, {"running": True, "file": "walk"}),
        (lambda bench: bench.command({"action": "stop"}), {"running": False, "error": None}),
        (lambda bench: bench.owner(latched=True, count=1), {"running": False, "error": None}),
        (
            lambda bench: bench.advance(3.01),
            {"error": "Unknown autonomy file: walk: scripts are still being listed, try again"},
        ),
    ],
    ids=["nothing", "a stop", "an emergency stop", "three seconds"],
)
def test_a_start_waits_until_its_script_is_listed_unless_something_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, between: Callable[[Bench], None], status: dict[str, Any]
) -> None:
    lists, scans = threading.Event(), list[Catalogue]()

    def scan(catalogue: Catalogue, found: Callable[[dict[str, Script]], None]) -> None:
        scans.append(catalogue)
        assert lists.wait(WAIT_S)
        found(SCRIPTS)

    monkeypatch.setattr(Catalogue, "scan", scan)
    with closing(Bench(tmp_path, None)) as bench:
        bench.owner()
        bench.command({"action": "start", "file": "walk"})
        bench.quiet()
        between(bench)
        bench.quiet()
        lists.set()
        assert until(lambda: bench.world.newest_raw("autonomy-files"))
        bench.advance(0.11)
        assert bench.becomes(**status)
        assert len(bench.children.all) == bool(status.get("running"))
        assert len(scans) < 4, "the scripts are listed every three seconds"
