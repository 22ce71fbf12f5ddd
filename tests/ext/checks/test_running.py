"""``pebble doctor --running`` of whole robots: both transports, all levels, and a board that was pulled out."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.check_result import CheckResult
from pebble.config import load
from pebble.extensions.checks.check import Check, run
from pebble.extensions.checks.running.checks import CHECKS, MOVING
from pebble.extensions.checks.running.robot import RobotUnderTest, reached
from pebble.extensions.fleet import certificates
from pebble.extensions.operator.places import Places
from tests.commands.command_line import running
from tests.robot.named import Hall, Named
from tests.robot.operator import Operator, retained_messages
from tests.robot.rig import BASE, DEVICES, STOP, Rig
from tests.support import ROOT, WAIT_S, beside, free_port, further, until

pytestmark = pytest.mark.alone  # whole robots

ESTOP, PATIENCE_S = "outgoing/estop/serial", 20.0
#: Of a robot that is not installed.
NOT_HERE = {"unit": "skipped", "slot": "skipped"}


@pytest.fixture(scope="module", params=["mqtt", further("zenoh")])
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A robot with everything, and a page by https."""
    folder = tmp_path_factory.mktemp("tls")
    certificates.init(folder, ["robot.local"])
    files = {"certificate": folder / "server.pem", "key": folder / "server.key", "ca": folder / "ca.pem"}
    page = {"web_interface": {"port": free_port(), "tls": {name: str(file) for name, file in files.items()}}}
    with Rig(request.param, av_daemon=DEVICES, top=page, web_handler={"enabled": True}, start=False) as one:
        people = one.folder / "password"
        people.write_text("a good password\n")
        command = [sys.executable, "-m", "pebble.cli", "web", "user", "add", "ann", "--config", str(one.config)]
        with people.open() as password:
            subprocess.run(command, cwd=ROOT, stdin=password, check=True, capture_output=True)
        started(one)
        yield one


def started(rig: Rig) -> None:
    """Start it, and wait until it knows that its motors obey; its page takes a while on a busy machine."""
    rig.wait_until_up(rig.start(ready=False), 60)
    assert rig.shows_driveable("yes", seconds=60)


Checks = tuple[Check[RobotUnderTest], ...]


def results(rig: Rig, checks: Checks = CHECKS, patience_s: float = PATIENCE_S) -> dict[str, CheckResult]:
    """Return the result of each check, by a test that has more patience than people have."""
    with reached(load(rig.config), Places(), "ann@desk", patience_s=patience_s, rests_s=PATIENCE_S / 10) as robot:
        return {check.name: result for check, result in run(checks, robot, refresh=robot.read)}


def found(rig: Rig, checks: Checks = CHECKS, patience_s: float = PATIENCE_S) -> dict[str, tuple[str, str]]:
    """Return the state and the text of each check."""
    return {name: (one.state.value, one.text) for name, one in results(rig, checks, patience_s).items()}


def only(*names: str) -> Checks:
    return tuple(check for check in (*CHECKS, *MOVING) if check.name in names)


def command(rig: Rig, *options: str, typed: str = "") -> tuple[int, dict[str, Any]]:
    """The exit code of ``pebble doctor --running --json``, and its checks by name."""
    line = [sys.executable, "-m", "pebble.cli", "doctor", str(rig.config), "--running", "--json", *options]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, input=typed, timeout=120, check=False)
    printed = json.loads(done.stdout or "{}")
    assert printed.get("ok", False) is (done.returncode == 0), done
    return done.returncode, {check.pop("name"): check for check in printed.get("checks", [])}


def moved(rig: Rig, since: float) -> set[tuple[float, float]]:
    """The drive lines that were not zero."""
    return {wheels for _, wheels in rig.mcu.drives(since) if wheels != STOP}


def state(rig: Rig) -> dict[str, Any]:
    last = rig.operator.last(ESTOP)
    return {} if last is None else last.json


def test_everything_is_tested_and_nothing_moves(rig: Rig) -> None:
    assert until(lambda: state(rig).get("latched") is False)
    before, began = retained_messages(rig.remote.port, BASE), time.monotonic()
    checks = found(rig)
    states = {name: one[0] for name, one in checks.items()}
    assert states == {check.name: "ok" for check in CHECKS} | NOT_HERE, checks
    assert "answers; its certificate is valid for 39" in checks["page"][1]
    assert moved(rig, began) == set()
    assert [entry for entry in rig.mcu.entries(began) if entry.line[:1] == "M"], "the stop has reached the motors"
    assert until(lambda: state(rig)["latched"] is False and state(rig)["reset_refused"] is None), state(rig)
    names = {seen.json["stop"] for seen in rig.operator.on("incoming/estop", began)}
    assert names == {state(rig)["recent"][0]}
    flags = {"incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"}
    left = {topic: raw for topic, raw in retained_messages(rig.remote.port, BASE).items() if "incoming/" in topic}
    assert set(left) - set(before) <= flags, "its retained command is removed"


def test_one_that_is_ended_while_wheels_turn_sends_a_zero_and_gives_control_back(rig: Rig) -> None:
    began = time.monotonic()
    with running("doctor", rig.config, "--running", "--may-move", stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        process.stdin.write("y\n")
        process.stdin.flush()
        assert until(lambda: moved(rig, began), 90)
        process.send_signal(signal.SIGTERM)
        assert process.wait(WAIT_S) != 0
    assert until(lambda: rig.operator.on("incoming/drive-values", began)[-1].json.get("valid_ms") == 0)
    assert until(lambda: rig.operator.last("outgoing/control/serial").json["key"] == "")  # type: ignore[union-attr]
    assert until(lambda: not rig.mcu.turning())
    assert not state(rig)["latched"]


def test_without_an_answer_nothing_is_tested(rig: Rig) -> None:
    began = time.monotonic()
    for typed in ("n\n", ""):
        assert command(rig, "--may-move", typed=typed) == (1, {})
    assert moved(rig, began) == set()
    assert rig.operator.on("incoming/estop", began) == []


def test_what_a_person_has_is_not_taken(rig: Rig) -> None:
    """Neither their control, nor their stop."""
    free = only("retained commands", "stop", "wheels")
    client = {"id": "aaaaaaaa", "by": "zoe", "for_ms": 10_000}
    rig.operator.send("incoming/control", client)
    assert until(lambda: rig.operator.last("outgoing/control/serial").json["by"] == "zoe")  # type: ignore[union-attr]
    began = time.monotonic()
    assert found(rig, free) == dict.fromkeys([check.name for check in free], ("skipped", "zoe drives it"))
    rig.operator.send("incoming/control", client | {"want": "release"})
    assert rig.operator.on("incoming/estop", began) == []
    rig.operator.send("incoming/estop", {"stop": "00000000000000a1", "by": "zoe"})
    assert until(lambda: state(rig)["latched"])
    why = "it is stopped by zoe, which only a person ends"
    assert found(rig, free) == dict.fromkeys([check.name for check in free], ("skipped", why))
    assert state(rig)["latched"]
    reset = {name: state(rig)[name] for name in ("boot", "count")}
    rig.operator.send("incoming/estop-reset", reset)
    assert until(lambda: not state(rig)["latched"])
    assert moved(rig, began) == set()


def test_a_stop_of_another_person_meanwhile_stays(rig: Rig) -> None:
    """It comes as soon as the test's is seen: before that is ended, or after."""
    began = time.monotonic()

    ending = threading.Event()

    def stops_too() -> None:
        assert until(lambda: ending.is_set() or rig.operator.on("incoming/estop", began))
        rig.operator.send("incoming/estop", {"stop": "00000000000000b2", "by": "zoe"})

    with beside(stops_too, ending):
        found(rig, only("stop"))
    assert until(lambda: state(rig)["recent"][0] == "00000000000000b2"), state(rig)
    assert state(rig)["latched"]
    assert state(rig)["by"] == "zoe"
    rig.operator.send("incoming/estop-reset", {name: state(rig)[name] for name in ("boot", "count")})
    assert until(lambda: not state(rig)["latched"])


def test_what_an_old_id_has_left_is_named_with_what_removes_it(rig: Rig) -> None:
    hostile = "old; echo `id` 'name"
    with closing(Operator(rig.remote.port, f"pebble/robots/{hostile}")) as old:
        old.send("outgoing/capabilities", {"t": 1, "value": {}}, retain=True)
        assert until(lambda: old.on("outgoing/capabilities"))
    result = results(rig, only("leftovers"))["leftovers"]
    assert (result.state.value, result.text) == ("failed", f"1 that send no heartbeat: {hostile}")
    fix = result.fix.partition("pebble ")[2].partition(", and so on")[0].replace("CONFIG", str(rig.config))
    done = subprocess.run([sys.executable, "-m", "pebble.cli", *shlex.split(fix)], cwd=ROOT, check=False)
    assert done.returncode == 0
    assert found(rig, only("leftovers"))["leftovers"] == ("ok", "none")


def test_a_pulled_board_is_named(rig: Rig) -> None:
    rig.mcu.command("unplug")
    assert until(lambda: found(rig, only("boards"), 1.0)["boards"][0] == "failed")
    assert str(rig.mcu.port) in found(rig, only("boards"), 1.0)["boards"][1]
    stop = found(rig, only("stop"))["stop"]
    assert (stop[0], "nothing confirms that its motors stand" in stop[1]) == ("failed", True)
    rig.mcu.command("replug")
    assert until(lambda: found(rig, only("boards"))["boards"][0] == "ok")


def test_how_a_robot_that_is_off_is_started(rig: Rig) -> None:
    rig.stop()  # the last test of this rig
    code, checks = command(rig)
    assert code == 1
    states = {name: check["state"] for name, check in checks.items()}
    assert states["processes"] == states["heartbeats"] == states["page"] == "failed"
    assert {name for name, one in states.items() if one == "skipped"} >= {"boards", "stop", "retained commands"}
    assert all(check["fix"] for check in checks.values() if check["state"] == "failed")


@pytest.mark.parametrize(("kind", "level"), [("zenoh", "named"), further("mqtt", "named"), further("zenoh", "login")])
def test_at_every_level(kind: str, level: Any, tmp_path: Path) -> None:
    hall = Hall(tmp_path / "hall", level)
    with hall, Named(kind, hall, {"level": level}, av_daemon=DEVICES, start=False) as rig:
        started(rig)
        began = time.monotonic()
        checks = found(rig, (*CHECKS, *MOVING))
        states = {name: one[0] for name, one in checks.items()}
        expected = {check.name: "ok" for check in (*CHECKS, *MOVING)} | NOT_HERE | {"page": "skipped"}
        assert states == expected, checks
        assert moved(rig, began) == {(0.2, 0.2), (-0.2, -0.2)}
        assert rig.mcu.drives(began)[-1][1] == STOP
