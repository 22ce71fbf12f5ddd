"""When the launcher starts what and kills it: its lock, its clock, restarts, the watchdog, and programs on demand."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import socket
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from pebble.config import LAUNCHER_LOCK
from pebble.errors import PebbleError
from pebble.extension import Program, Stage
from pebble.launcher import on_demand
from pebble.launcher.on_demand import OnDemand
from pebble.launcher.process_supervisor import ProcessSupervisor
from pebble.launcher.reactor import Reactor
from pebble.launcher.restart_policy import ALIVE_LIMIT_S, LOOP_RETRY_S, START_INTERVAL_S, START_LIMIT_S, RestartPolicy
from pebble.launcher.run_lock import RunLock
from pebble.launcher.sd_notify import SystemdNotifier
from pebble.runtime import notes
from pebble.runtime.notes import Held, Wanted
from tests.launcher.conftest import CONNECTION, DEVICE, Launch, Robot, Row
from tests.support import WAIT_S, gone, refused, until


def crash(policy: RestartPolicy, at: float, ran_for: float = 0.0) -> float:
    """One start and one exit; returns how long to wait for the next start."""
    policy.started(at)
    return policy.exited(at + ran_for, "exit code 1")


@pytest.mark.parametrize(
    ("delay_s", "expected"), [(2.0, [0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0, 10.0]), (0.4, [0.0, 0.1, 0.2])]
)
def test_the_first_restart_is_immediate_and_later_ones_wait_longer(delay_s: float, expected: list[float]) -> None:
    policy, now, waits = RestartPolicy(delay_s), 0.0, []
    for _ in expected:
        waits.append(crash(policy, now, ran_for=20.0))  # slow enough not to be a crash loop
        now += 20.0 + waits[-1]
    assert waits == pytest.approx(expected)
    assert policy.state == "restarting"


def test_five_exits_within_a_minute_are_a_crash_loop_that_is_retried_slowly() -> None:
    policy = RestartPolicy(0.0)
    waits = [crash(policy, now) for now in (0.0, 1.0, 2.0, 3.0)]
    assert waits == [0.0] * 4
    assert (policy.state, policy.in_crash_loop) == ("restarting", False)
    assert crash(policy, 4.0) == LOOP_RETRY_S
    assert (policy.state, policy.in_crash_loop) == ("failed", True)
    assert crash(policy, 14.0) == LOOP_RETRY_S
    assert policy.restarts == 5
    policy.started(24.0)
    assert policy.state == "failed", "an attempt is not yet a success"
    policy.ready(24.1)
    assert policy.state == "ready"


def test_a_requested_end_is_no_restart_and_the_last_exit_is_that_of_what_ran_last() -> None:
    policy = RestartPolicy()
    assert (policy.state, policy.first_attempt_done) == ("init", False)
    for now in (10.0, 11.0):
        crash(policy, now)
    policy.stopped(None)
    assert (policy.state, policy.restarts, policy.last_exit) == ("stopped", 1, "exit code 1")


def test_a_stable_minute_clears_the_record() -> None:
    policy = RestartPolicy(0.0)
    for now in range(5):
        crash(policy, float(now))
    assert policy.in_crash_loop
    assert crash(policy, 20.0, ran_for=60.0) == 0.0
    assert (policy.state, policy.in_crash_loop) == ("restarting", False)


def test_silence_makes_it_stuck_later_at_the_start_than_afterwards() -> None:
    policy = RestartPolicy()
    assert policy.stuck_at == float("inf")
    policy.started(100.0)
    assert policy.stuck_at == 100.0 + START_LIMIT_S
    policy.ready(101.0)
    assert policy.stuck_at == 101.0 + ALIVE_LIMIT_S
    policy.alive(105.0)
    assert policy.stuck_at == 105.0 + ALIVE_LIMIT_S
    policy.exited(106.0, "signal 9")
    assert policy.stuck_at == float("inf")


def test_a_program_rests_between_two_starts() -> None:
    policy = RestartPolicy()
    assert policy.request_delay_s(0.0) == 0.0
    policy.started(5.0)
    policy.stopped("exit code 0")
    assert policy.request_delay_s(5.25) == START_INTERVAL_S - 0.25
    assert policy.request_delay_s(5.0 + START_INTERVAL_S) == 0.0


class Frozen:
    """A reactor that does not wait, because there is always something to read; a turn takes 0.5 s of its clock."""

    def __init__(self, *freezes: str) -> None:
        self.time = 1000.0
        self.stalls: list[float] = []
        self.reactor = Reactor(lambda: self.time, on_stall=self.stalls.append)
        self._freezes = list(freezes)
        self._pipe = os.pipe()
        os.write(self._pipe[1], b"a note")
        self.reactor.watch(self._pipe[0], lambda: self.stand_still("reading"))

    def stand_still(self, where: str) -> None:
        if where in self._freezes:
            self._freezes.remove(where)
            self.time += 12.0

    def turns(self, timeout: float) -> float:
        """How long the clock ran until nothing more was due."""
        began = self.time

        def turn() -> bool:
            self.time += 0.5
            self.stand_still("waiting")
            return False

        self.reactor.run_until(turn, timeout)
        return self.time - began

    def close(self) -> None:
        self.reactor.close()
        for end in self._pipe:
            os.close(end)


@pytest.mark.parametrize("where", ["reading", "waiting"])
def test_a_time_in_which_it_stood_still_makes_nothing_due(where: str) -> None:
    frozen, due = Frozen(where), list[float]()
    frozen.reactor.after(10.0, lambda: due.append(frozen.time))
    assert frozen.turns(8.0) == pytest.approx(8.0 + 12.0, abs=1.0), "its own limits are on the same clock"
    assert not due
    assert frozen.stalls == [pytest.approx(12.0, abs=1.0)]
    frozen.turns(8.0)
    assert due == [pytest.approx(1000.0 + 10.0 + 12.0, abs=1.0)]
    frozen.close()


def test_a_launcher_that_gets_little_time_still_ends_what_hangs() -> None:
    frozen, due = Frozen(*["waiting"] * 20), list[float]()
    frozen.reactor.after(5.0, lambda: due.append(frozen.time))
    frozen.turns(10.0)
    assert due
    frozen.close()


@pytest.mark.parametrize(
    ("environment", "period_s"),
    [
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "own"}, 10.0),
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_the_watchdog_is_served_at_half_its_time(environment: dict[str, str], period_s: float | None) -> None:
    own = {name: text.replace("own", str(os.getpid())) for name, text in environment.items()}
    assert SystemdNotifier(own).watchdog_period_s == period_s


@pytest.mark.parametrize("mode", [None, 0o755])
def test_the_folder_is_for_this_user_alone(tmp_path: Path, mode: int | None) -> None:
    run = tmp_path / "a" / "b"
    if mode is not None:
        run.parent.mkdir(0o700)
        run.mkdir(mode)
    with RunLock(run, "x/y/z", tmp_path / "state.lock") as lock:
        assert [folder.stat().st_mode & 0o777 for folder in (run, run.parent)] == [0o700] * 2
        assert lock.path.read_text() == f"{os.getpid()}\nx/y/z\n"


def test_what_is_not_ours_to_lock_or_to_close_is_named(tmp_path: Path) -> None:
    (tmp_path / "lock" / LAUNCHER_LOCK).mkdir(parents=True)
    with pytest.raises(PebbleError, match=f"{LAUNCHER_LOCK} cannot be locked: Is a directory; remove it"):
        RunLock(tmp_path / "lock", "x/y/z", tmp_path / "state.lock").take()
    (run := tmp_path / "run").mkdir()
    run.chmod(0o1777)
    with pytest.raises(PebbleError, match="others may write there, name a folder of this user"):
        RunLock(run, "x/y/z", tmp_path / "state.lock").take()
    assert run.stat().st_mode & 0o7777 == 0o1777


def test_another_run_directory_does_not_make_another_robot(tmp_path: Path) -> None:
    lock = tmp_path / "state" / "launcher-x+y+z.lock"
    with RunLock(tmp_path / "by systemd", "x/y/z", lock):
        with pytest.raises(PebbleError, match=re.escape(f"x/y/z already runs: process {os.getpid()} holds {lock};")):
            RunLock(tmp_path / "by a shell", "x/y/z", lock).take()
        with RunLock(tmp_path / "by a shell", "x/y/another", tmp_path / "state" / "launcher-x+y+another.lock"):
            pass
    with RunLock(tmp_path / "by a shell", "x/y/z", lock):
        pass


@pytest.mark.parametrize("refuses", ["a state directory", "a disk with room"])
def test_a_robot_starts_all_the_same_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuses: str) -> None:
    state_lock = tmp_path / "state.lock"
    if refuses == "a state directory":
        (tmp_path / "file").touch()
        state_lock = tmp_path / "file" / "state.lock"
    else:
        monkeypatch.setattr(os, "pwrite", refused(errno.ENOSPC))
    unknown = pytest.raises(PebbleError, match=r"x/y/z already runs: process .* holds")
    with RunLock(tmp_path, "x/y/z", state_lock), unknown:
        RunLock(tmp_path, "x/y/z", state_lock).take()


@pytest.mark.parametrize("remove", [lambda run: shutil.rmtree(run), lambda run: (run / LAUNCHER_LOCK).unlink()])
def test_a_removed_lock_is_taken_again(tmp_path: Path, remove: Callable[[Path], object]) -> None:
    run, state_lock = tmp_path / "run", tmp_path / "state.lock"
    with RunLock(run, "x/y/z", state_lock) as lock:
        assert not lock.keep()
        remove(run)
        assert lock.keep()
        assert not lock.keep()
        assert lock.path.read_text() == f"{os.getpid()}\nx/y/z\n"
        with pytest.raises(PebbleError, match=f"holds {lock.path}"):
            RunLock(run, "x/y/other", tmp_path / "other.lock").take()


def test_a_lock_that_cannot_be_taken_again_is_reported_once_and_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = tmp_path / "run"
    with RunLock(run, "x/y/z", tmp_path / "state.lock") as lock:
        shutil.rmtree(run)
        run.write_text("in the way")
        assert not lock.keep()
        assert not lock.keep()
        assert [record.levelname for record in caplog.records] == ["ERROR"]
        run.unlink()
        assert lock.keep()
        assert lock.path.exists()


# -- programs that run only while they are requested, with a stand-in for the bridge and media that misbehave


ASKER: Row = ("bridge", "asker", CONNECTION, {"may_request": True})


def media(behaviour: str, name: str = "media", **more: Any) -> Row:
    return (name, behaviour, CONNECTION, {"on_demand": True, "preloaded": False, **more})


def started(robot: Robot, name: str, times: int = 1) -> bool:
    return until(lambda: len(robot.events(name, "start")) == times)


def state_of(robot: Robot, name: str = "media") -> Any:
    return robot.services().get(name, {}).get("state")


def test_a_program_runs_while_it_is_requested_and_not_held(launch: Launch) -> None:
    robot = launch(ASKER, media("good"))
    assert robot.ready("bridge", "announcer")
    assert set(robot.services()) == {"bridge", "announcer"}
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    robot.order("bridge", "media 0")
    assert until(lambda: state_of(robot) == "stopped")
    assert robot.services()["media"] == {"state": "stopped", "restarts": 0, "last_exit": "exit code 0"}
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    robot.order("bridge", "hold media 1")
    assert until(lambda: state_of(robot) == "held")
    assert len(robot.events("media", "stop")) == 2
    os.kill(robot.events("bridge", "start")[0], signal.SIGKILL)
    assert started(robot, "media", 3), "who held it has ended"
    assert until(lambda: robot.events("bridge", "before:media="))
    assert robot.services()["media"]["restarts"] == 0, "nothing went wrong"


@pytest.mark.parametrize(
    ("lines", "states"),
    [
        ("H1 W1 H0 W0", "idle held runs idle"),
        ("W1 H1 W0 H0", "runs held idle idle"),
        ("W1 H1 W0 W1 H0", "runs held idle held runs"),
        ("W1 H1 W1 dies", "runs held held runs"),
        ("W1 H1 expires H0", "runs held idle idle"),
        ("W1 dies H1 W1", "runs runs held held"),
    ],
)
def test_a_program_runs_if_it_is_requested_and_not_held(
    monkeypatch: pytest.MonkeyPatch, lines: str, states: str
) -> None:
    monkeypatch.setattr(on_demand, "OUTLIVE_S", 0.0)
    reactor, supervisor = Reactor(), StandIn()
    programs = OnDemand(reactor, [cast(ProcessSupervisor, supervisor)])
    bridge = Program("bridge", "bridge", (), Stage.CONNECTION, may_request=True)
    acts: dict[str, Callable[[str], object]] = {
        "W": lambda rest: programs.want(bridge, Wanted("media", rest == "1")),
        "H": lambda rest: programs.hold(bridge, Held("media", rest == "1")),
        "d": lambda _: programs.ended(bridge),
        "e": lambda _: programs.ended(bridge) or reactor.run_until(lambda: not programs.requested, 10),
    }
    found = []
    for line in lines.split():
        acts[line[0]](line[1:])
        found.append(supervisor.shown)
    reactor.close()
    assert " ".join(found) == states


def test_a_released_program_that_does_not_stop_is_killed_without_a_wait_and_started_if_requested_again(
    launch: Launch,
) -> None:
    stubborn_one = media("stubborn", stop_timeout_s=2.0)
    robot = launch(ASKER, stubborn_one, ("serial", "good", DEVICE), shutdown_timeout_seconds=0.5)
    assert robot.ready("bridge", "serial")
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    (stubborn,) = robot.events("media", "start")
    robot.order("bridge", "media 0", "media 1")
    assert until(lambda: "media is released" in robot.stderr())
    os.kill(robot.events("serial", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) == 2)
    assert not gone(stubborn), "the other one was back before this one had to end"
    assert started(robot, "media", 2)
    assert gone(stubborn)
    assert until(lambda: robot.services()["media"]["restarts"] == 0 and state_of(robot) == "ready")
    assert "media did not stop within 2 s: killed" in robot.stderr()
    assert robot.stop() == 0


def test_only_the_bridge_may_request_and_only_existing_programs(launch: Launch) -> None:
    robot = launch(ASKER, ("other", "asker", CONNECTION), media("good"))
    assert robot.ready("bridge", "other")
    robot.order("other", "media 1", "media 1", "media 1")
    robot.order("bridge", "nothing 1", "other 0", "nothing 1")
    refusal = "bridge may not request nothing, ignored"
    assert until(lambda: refusal in robot.stderr() and "other may not request media" in robot.stderr())
    robot.order("bridge", "media 0")
    assert until(lambda: robot.states() == {"bridge": "ready", "other": "ready", "announcer": "ready"})
    assert robot.stderr().count("may not request") == 2, "one line each"
    assert not robot.events("media", "start")


def test_the_successor_of_a_bridge_that_dies_gets_the_requests_and_those_it_repeats_last(launch: Launch) -> None:
    robot = launch(ASKER, media("good"), media("good", "other"), options=("forgetful",))
    assert robot.ready("bridge")
    robot.order("bridge", "media 1", "other 1")
    assert robot.ready("media", "other")
    os.kill(robot.events("bridge", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("bridge", "ready")) == 2)
    assert robot.events("bridge", "before:media=,other=")
    robot.order("bridge", "media 1")
    assert until(lambda: robot.events("other", "stop")), "expired: the request was not repeated"
    assert "other: the program that requested it has ended, and the request was not repeated" in robot.stderr()
    assert until(lambda: state_of(robot, "other") == "stopped")
    assert robot.states()["media"] == "ready"
    assert len(robot.events("media", "start")) == 1
    assert not robot.events("media", "stop")


@pytest.mark.parametrize(("state", "releases"), [("init", 1), ("ready", 0)])
def test_a_starting_program_begins_again_with_the_newest_request(state: str, releases: int) -> None:
    """One that is ready receives the new request itself."""
    supervisor = StandIn(state)
    programs = OnDemand(Reactor(), [cast(ProcessSupervisor, supervisor)])
    bridge = Program("bridge", "bridge", (), Stage.CONNECTION, may_request=True)
    for encoding in ("", "", "h264"):
        programs.want(bridge, Wanted("media", True, encoding))
    assert (supervisor.requested, supervisor.releases) == (True, releases)


@pytest.mark.parametrize(
    "line",
    [
        "",
        '{"note":"wanted","program":"media","on":2}',
        '{"note":"wanted","program":"media","on":true,"encoding":"H264"}',
        '{"note":"feature","name":"drive","has":true}',
        '{"note":"feature","name":"estop\\n","has":true}',
        '{"note":"feature","name":"outlets/a/b","has":true}',
        '{"note":"mcu","state":"well","silent_ms":0}',
    ],
)
def test_nonsense_is_no_note(line: str) -> None:
    with pytest.raises(msgspec.DecodeError):
        notes.decode(line)


class StandIn:
    """What OnDemand uses of a supervisor."""

    def __init__(self, state: str = "ready") -> None:
        self.program = Program("media", "media", (), Stage.CONNECTION, on_demand=True)
        self.policy = SimpleNamespace(state=state)
        self.requested = self.held = False
        self.releases = 0

    @property
    def shown(self) -> str:
        return {(True, False): "runs", (False, True): "held", (False, False): "idle"}[self.requested, self.held]

    def request(self) -> None:
        self.requested, self.held = True, False

    def release(self) -> None:
        self.releases += self.requested
        self.requested = self.held = False

    def hold(self) -> None:
        self.release()
        self.held = True


def test_systemd_is_told_also_at_an_abstract_address() -> None:
    name = f"pebble-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(f"\0{name}")
        systemd.settimeout(WAIT_S)
        SystemdNotifier({"NOTIFY_SOCKET": f"@{name}"}).ready()
        assert systemd.recv(64) == b"READY=1"
