"""Programs that run only while they are wanted: a real launcher, a stand-in for the bridge, media that misbehave."""

from __future__ import annotations

import logging
import os
import signal
import socket
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from pebble.launcher import on_demand
from pebble.launcher.keeper import Keeper
from pebble.launcher.on_demand import OnDemand
from pebble.launcher.program import Program, Stage
from pebble.launcher.reactor import Reactor
from tests.launcher.robot import DEVICE, LINK, Launch, Robot, Row, lines_of
from tests.support import gone, until

ASKER: Row = ("bridge", "asker", LINK, {"asks": True})


def media(behaviour: str, name: str = "media", **more: Any) -> Row:
    return (name, behaviour, LINK, {"on_demand": True, "preloaded": False, **more})


def started(robot: Robot, name: str, times: int = 1) -> bool:
    return until(lambda: len(robot.events(name, "start")) == times, 20)


def state_of(robot: Robot, name: str = "media") -> Any:
    return robot.services().get(name, {}).get("state")


def test_runs_while_it_is_wanted_and_shows_from_then_on(launch: Launch) -> None:
    robot = launch(ASKER, media("good"))
    assert robot.ready("bridge", "announcer")
    assert set(robot.services()) == {"bridge", "announcer"}
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    robot.order("bridge", "media 0")
    assert until(lambda: state_of(robot) == "stopped")
    assert robot.services()["media"] == {"state": "stopped", "restarts": 0, "last_exit": "exit code 0"}
    assert len(robot.events("media", "stop")) == 1
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    assert robot.services()["media"]["restarts"] == 0, "nothing went wrong"
    assert len(robot.events("media", "start")) == 2


def test_nobody_waits_for_what_nobody_wants(launch: Launch, tmp_path: Path) -> None:
    path = tmp_path / "systemd"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        systemd.settimeout(20)

        def hear(text: str) -> bool:
            while systemd.recv(1000).decode() != text:
                pass
            return True

        robot = launch(ASKER, media("good"), env={"NOTIFY_SOCKET": str(path)})
        assert hear("READY=1")
        assert hear("STATUS=2 of 2 ready")
        robot.order("bridge", "media 1")
        assert hear("STATUS=3 of 3 ready")
        robot.order("bridge", "media 0")
        assert hear("STATUS=2 of 2 ready"), "what rests is nothing to worry about"


def test_what_ends_while_it_is_wanted_is_started_again_at_once(launch: Launch) -> None:
    robot = launch(ASKER, media("good"), restart_delay_seconds=600)
    assert robot.ready("bridge")
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    os.kill(robot.events("media", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("media", "ready")) == 2, 20)
    again = {"state": "ready", "restarts": 1, "last_exit": "signal 9"}
    assert until(lambda: robot.services()["media"] == again)


def test_a_crash_loop_shows_until_it_is_not_wanted(launch: Launch) -> None:
    robot = launch(ASKER, media("crash"), restart_delay_seconds=0)
    assert robot.ready("bridge")
    robot.order("bridge", "media 1")
    assert until(lambda: state_of(robot) == "failed", 20)
    assert len(robot.events("media", "start")) == 5
    robot.order("bridge", "media 0")
    assert until(lambda: state_of(robot) == "stopped")
    assert robot.states()["bridge"] == "ready"
    assert len(robot.events("bridge", "ready")) == 1


def test_who_does_not_stop_is_killed_and_nobody_waits(launch: Launch) -> None:
    robot = launch(ASKER, media("stubborn", stop_timeout_s=2.0), ("serial", "good", DEVICE))
    assert robot.ready("bridge", "serial")
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    (stubborn,) = robot.events("media", "start")
    robot.order("bridge", "media 0")
    assert until(lambda: "media is not wanted any more" in robot.stderr())
    os.kill(robot.events("serial", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) == 2, 20)
    assert not gone(stubborn), "the other one was back before this one had to end"
    assert until(lambda: gone(stubborn))
    assert until(lambda: state_of(robot) == "stopped")
    assert "media did not stop within 2 s: killed" in robot.stderr()
    assert robot.services()["media"]["last_exit"] == "signal 9"


def test_wanted_again_while_it_stops_it_is_started_after_the_exit(launch: Launch) -> None:
    robot = launch(ASKER, media("stubborn", stop_timeout_s=0.5), shutdown_timeout_seconds=0.5)
    assert robot.ready("bridge")
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    (first,) = robot.events("media", "start")
    robot.order("bridge", "media 0", "media 1")
    assert started(robot, "media", 2)
    assert gone(first)
    assert until(lambda: len(robot.events("media", "ready")) == 2)
    assert until(lambda: robot.services()["media"]["restarts"] == 0 and state_of(robot) == "ready")
    assert robot.stop() == 0


def test_changing_ones_mind_all_the_time_starts_few_processes(launch: Launch) -> None:
    robot = launch(ASKER, media("good"))
    assert robot.ready("bridge")
    began = time.monotonic()
    robot.order("bridge", *["media 1", "media 0"] * 200, "media 1")
    assert robot.ready("media")
    assert len(robot.events("media", "start")) <= 2 + time.monotonic() - began


def test_an_environment_and_a_folder_of_its_own(launch: Launch, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    own = {"environment": {"MARK": "red", "PEBBLE_ENCODING": "x"}, "folder": str(tmp_path / "elsewhere")}
    robot = launch(ASKER, media("curious about itself", **own), env={"MARK": "blue"})
    assert robot.ready("bridge")
    robot.order("bridge", "media 1")
    assert robot.ready("media")
    assert said_of_itself(robot) == ["env:red:elsewhere:None"]


def test_each_start_knows_which_encoding_was_asked_for_last(launch: Launch) -> None:
    robot = launch(ASKER, media("curious about itself"))
    assert robot.ready("bridge")
    robot.order("bridge", "media 1 h264")
    assert robot.ready("media")
    robot.order("bridge", "media 1 pbvz")
    os.kill(robot.events("bridge", "start")[0], signal.SIGKILL)
    assert until(lambda: robot.events("bridge", "before:media=pbvz") or robot.events("bridge", "before:media=h264"))
    robot.order("bridge", "media 1 pbvz", "other 1")
    assert until(lambda: "no say in" in robot.stderr()), "it has been heard"
    os.kill(robot.events("media", "start")[0], signal.SIGKILL)
    assert until(lambda: len(said_of_itself(robot)) == 2)
    robot.order("bridge", "media 1", "media 0")
    assert until(lambda: robot.events("media", "stop"))
    robot.order("bridge", "media 1")
    assert until(lambda: len(said_of_itself(robot)) == 3)
    assert [said.rpartition(":")[2] for said in said_of_itself(robot)] == ["h264", "pbvz", "None"]


def said_of_itself(robot: Robot) -> list[str]:
    words = (line.split() for line in lines_of(robot.journal))
    return [word for name, word, _ in words if name == "media" and word.startswith("env:")]


@pytest.mark.parametrize("how", ["half", "noise"])
def test_what_is_said_in_pieces_or_after_noise_is_understood(launch: Launch, how: str) -> None:
    robot = launch(ASKER, media("good"))
    assert robot.ready("bridge")
    robot.order("bridge", f"{how} media 1")
    assert robot.ready("media")


def test_only_the_bridge_may_want_and_only_what_there_is(launch: Launch) -> None:
    robot = launch(ASKER, ("other", "asker", LINK), media("good"))
    assert robot.ready("bridge", "other")
    robot.order("other", "media 1", "media 1", "media 1")
    robot.order("bridge", "nothing 1", "other 0", "nothing 1")
    said = "bridge says what it has no say in, ignored: WANT nothing 1"
    assert until(lambda: said in robot.stderr() and "other says what it has no say in" in robot.stderr())
    robot.order("bridge", "media 0")
    assert until(lambda: robot.states() == {"bridge": "ready", "other": "ready", "announcer": "ready"})
    assert robot.stderr().count("no say in") == 2, "one line each"
    assert not robot.events("media", "start")


def test_the_robot_stops_with_all_it_has(launch: Launch) -> None:
    robot = launch(ASKER, media("good"), media("stubborn", "deaf"), media("good", "idle"), shutdown_timeout_seconds=1.5)
    assert robot.ready("bridge")
    robot.order("bridge", "media 1", "deaf 1")
    assert robot.ready("media", "deaf")
    pids = [robot.events(name, "start")[0] for name in ("media", "deaf", "bridge")]
    assert robot.stop() == 0
    assert all(gone(pid) for pid in pids)
    assert "idle" not in robot.services()
    assert robot.services()["media"]["state"] == "stopped"


class TestBridgeThatDies:
    def test_the_next_one_knows_and_what_it_says_again_runs_on(self, launch: Launch) -> None:
        robot = launch(ASKER, media("good"), media("good", "other"), options=("forgetful",))
        assert robot.ready("bridge")
        robot.order("bridge", "media 1", "other 1")
        assert robot.ready("media", "other")
        os.kill(robot.events("bridge", "start")[0], signal.SIGKILL)
        assert until(lambda: len(robot.events("bridge", "ready")) == 2, 20)
        assert robot.events("bridge", "before:media=,other=")
        robot.order("bridge", "media 1")
        assert until(lambda: robot.events("other", "stop"), 20), "withdrawn: nobody has said it again"
        assert "other: who wanted it has ended, and nobody has wanted it again" in robot.stderr()
        assert until(lambda: state_of(robot, "other") == "stopped")
        assert robot.states()["media"] == "ready"
        assert len(robot.events("media", "start")) == 1
        assert not robot.events("media", "stop")

    def test_its_wants_count_for_a_while(self, launch: Launch) -> None:
        robot = launch(ASKER, media("good"), restart_delay_seconds=600)
        assert robot.ready("bridge")
        robot.order("bridge", "media 1")
        assert robot.ready("media")
        os.kill(robot.events("bridge", "start")[0], signal.SIGKILL)
        assert until(lambda: len(robot.events("bridge", "ready")) == 2, 20)
        robot.order("bridge", "media 0")
        assert until(lambda: robot.events("media", "stop"))
        assert len(robot.events("media", "start")) == 1

    def test_dying_again_and_again_prolongs_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(on_demand, "OUTLIVE_S", 0.3)
        reactor, keeper = Reactor(), StandIn()
        bridge = Program("bridge", "bridge", (), Stage.LINK, asks=True)
        programs = OnDemand(reactor, {"media": cast(Keeper, keeper)})
        programs.hear(bridge, "WANT media 1")
        reactor.every(0.1, lambda: programs.ended(bridge))
        assert reactor.run_until(lambda: not keeper.wanted, 10)
        programs.hear(bridge, "WANT media 1")
        assert not reactor.run_until(lambda: not keeper.wanted, 0.2), "that was another want"
        reactor.close()


@pytest.mark.parametrize(("state", "ended"), [("init", 1), ("ready", 0)])
def test_one_that_still_starts_begins_again_with_what_is_asked_for_now(state: str, ended: int) -> None:
    """One that is ready hears the request itself."""
    keeper = StandIn(state)
    programs = OnDemand(Reactor(), {"media": cast(Keeper, keeper)})
    bridge = Program("bridge", "bridge", (), Stage.LINK, asks=True)
    for line in ("WANT media 1", "WANT media 1", "WANT media 1 h264"):
        programs.hear(bridge, line)
    assert (keeper.wanted, keeper.ended) == (True, ended)


@pytest.mark.parametrize(
    "line",
    [
        "",
        "WANT",
        "WANT media",
        "WANT media 2",
        "WANT media yes",
        "want media 1",
        "WANT  1",
        "READY?",
        "WANT media 1 H264",
        "WANT media 1 a b",
        "\ufffd" * 9,
    ],
)
def test_nonsense_is_ignored(line: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    keeper = StandIn()
    programs = OnDemand(Reactor(), {"media": cast(Keeper, keeper)})
    programs.hear(Program("bridge", "bridge", (), Stage.LINK, asks=True), line)
    assert not keeper.wanted
    assert len(caplog.records) == 1


class StandIn:
    """What OnDemand sees of a keeper."""

    wanted = False
    ended = 0  # how often it was told to end

    def __init__(self, state: str = "ready") -> None:
        self.life = SimpleNamespace(state=state)

    def want(self) -> None:
        self.wanted = True

    def unwant(self) -> None:
        self.ended += self.wanted
        self.wanted = False
