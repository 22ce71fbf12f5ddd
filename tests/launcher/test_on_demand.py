"""Programs that run only while they are requested: a real launcher, a stand-in for the bridge, media that misbehave."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from pebble.extension import Program, Stage
from pebble.launcher import on_demand
from pebble.launcher.on_demand import OnDemand
from pebble.launcher.process_supervisor import ProcessSupervisor
from pebble.launcher.reactor import Reactor
from pebble.runtime import notes
from pebble.runtime.notes import Held, Wanted
from tests.launcher.robot import CONNECTION, DEVICE, Launch, Robot, Row
from tests.support import gone, until

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
