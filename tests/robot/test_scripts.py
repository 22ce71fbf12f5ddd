"""A few random schedules with whole robots (``python -m tests.kit.schedules robot`` runs hundreds), and scripts.

The wheels rest however a script ends, and a person goes first. Times by the MCU's trace.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from typing import Any

import pytest

from tests.robot.rig import STOP, Rig
from tests.robot.whole import ENGINE
from tests.support import further, gone, until

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.mark.parametrize(("kind", "seed"), [("zenoh", 2), *(further(kind, 1) for kind in ENGINE.kinds)])
def test_what_people_and_owners_do_is_seen_at_the_wheels(kind: str, seed: int) -> None:
    (result,) = ENGINE.run(kind, seed, range(1))
    assert not result.problems, f"{result.problems}\n{result.log}"


DRIVE, CONTROL = "incoming/drive-values", "incoming/control"
CRUISE = {"x": 0.0, "z": -0.3}
DRIVEN, WHEELS = {"x": 0, "z": 0.4}, (0.4, 0.4)  # by a person
MIA = {"id": "aaaaaaaa", "by": "mia", "for_ms": 3000}
REST_S = 0.5  # without a motion the wheels are at rest
AT_ONCE_S = 0.6  # a few milliseconds on an idle machine; less than the 0.75 s after which any wheel stops


@pytest.fixture(scope="module")
def rigs() -> Iterator[Callable[[str], Rig]]:
    """Robots by their transport, each started when it is first needed."""

    def opened(kind: str) -> Rig:
        rig = stack.enter_context(Rig(kind, mirror=kind == "zenoh", direct=True, scripts=("cruise", "flood", "follow")))
        assert until(rig.lists_scripts, 60), rig.log.read_text()[-3000:]
        return rig

    with ExitStack() as stack:
        yield cache(opened)


@pytest.fixture(params=["zenoh", "mqtt"])
def rig(request: pytest.FixtureRequest, rigs: Callable[[str], Rig]) -> Rig:
    return rigs(request.param)


def driving(rig: Rig, file: str = "cruise", config: dict[str, Any] | None = None) -> int:
    """Start a script and wait until its commands turn the wheels; returns its process."""
    began = rig.run_script(file, config)
    assert until(lambda: rig.script().get("running") and rig.mcu.moving(began)), rig.log.read_text()[-3000:]
    return int(rig.script()["pid"])


def idle(rig: Rig) -> None:
    """End the script, and wait until it has ended and the wheels stand."""
    rig.end_script()
    assert until(lambda: not rig.script().get("running") and not rig.mcu.turning())


def rested_s(rig: Rig, since: float) -> float:
    """From ``since`` until the wheels stayed at rest; infinite if they turn now, or did not turn at all."""
    until(lambda: time.monotonic() > since + REST_S and not rig.mcu.turning(), 3)
    before = [speeds for at, speeds in rig.mcu.motors() if at < since]
    later = rig.mcu.motors(since)
    if not before or before[-1] == STOP or not later or later[-1][1] != STOP:
        return math.inf
    turning = [at for at, speeds in later if speeds != STOP]
    return next(at for at, _ in later if not turning or at > turning[-1]) - since


def freeze(rig: Rig, pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)


def launcher_killed(rig: Rig, _pid: int) -> None:
    rig.kill_launcher()


#: Ways to end a script: what does it, and the most seconds until the wheels rest.
ENDINGS: dict[str, tuple[Callable[[Rig, int], object], float]] = {
    "killed": (lambda _rig, pid: os.kill(pid, signal.SIGKILL), AT_ONCE_S),
    "SIGTERM": (lambda _rig, pid: os.kill(pid, signal.SIGTERM), AT_ONCE_S),
    "stopped": (lambda rig, _pid: rig.end_script(), AT_ONCE_S),
    "frozen": (freeze, 1.5),
    "manager killed": (lambda rig, _pid: rig.kill("autonomy_manager"), AT_ONCE_S),
    "launcher killed": (launcher_killed, AT_ONCE_S),
}
SLOW = {"frozen": "zenoh", "manager killed": "zenoh", "launcher killed": "mqtt"}  # one transport each


@pytest.mark.parametrize(
    ("rig", "ending"),
    [(kind, ending) for kind in ("zenoh", "mqtt") for ending in ENDINGS if SLOW.get(ending, kind) == kind],
    indirect=["rig"],
)
def test_the_wheels_rest_however_a_script_ends(rig: Rig, ending: str) -> None:
    act, rest_s = ENDINGS[ending]
    pid = driving(rig, config=CRUISE)
    began = time.monotonic()
    act(rig, pid)
    assert rested_s(rig, began) <= rest_s
    if act is freeze:
        rig.end_script()
    assert until(lambda: gone(pid))
    if ending == "launcher killed":
        rig.start()
    if ending.endswith("killed") and ending != "killed":
        assert until(lambda: rig.lists_scripts(began), 60)
    else:
        assert until(lambda: not rig.script()["running"])


@pytest.mark.parametrize("rig", ["zenoh", further("mqtt")], indirect=True)
def test_one_stop_of_a_person_is_enough(rig: Rig) -> None:
    """Against a script that publishes 500 commands a second."""
    driving(rig, "flood")
    began = time.monotonic()
    rig.operator.send(DRIVE, {"x": 0, "z": 0})
    rested = rested_s(rig, began)
    idle(rig)
    assert rested <= AT_ONCE_S


def control(rig: Rig, **wanted: Any) -> dict[str, Any]:
    """Ask for control, and return the state of the motor owner."""
    rig.operator.send(CONTROL, {**MIA, **wanted})
    return rig.operator.newest("control/serial")


def test_a_person_with_control_goes_before_a_script_of_the_original(rig: Rig) -> None:
    """Which knows nothing of signatures; every end of it stops the wheels, too."""
    pid = driving(rig, "follow")
    assert until(lambda: control(rig).get("id") == MIA["id"], step=0.1)
    key, began = control(rig)["key"], time.monotonic()
    for _ in range(5):
        rig.operator.send(DRIVE, {**DRIVEN, "key": key})
        time.sleep(0.05)
    released = time.monotonic()
    control(rig, want="release")
    assert until(lambda: rig.mcu.moving(released + 0.5)), "the script goes on"
    lines = rig.mcu.drives(began)
    first = next(index for index, (_, wheels) in enumerate(lines) if wheels == WHEELS)
    assert lines[first][0] - began < AT_ONCE_S
    assert {wheels for at, wheels in lines[first:] if at < released} <= {WHEELS, STOP}

    stopped = rig.end_script()
    assert until(lambda: not rig.mcu.moving(stopped) and rig.mcu.drives(stopped))
    assert until(lambda: gone(pid))
    assert until(lambda: rig.script()["running"] is False)
    assert until(lambda: time.monotonic() > released + 2.5)  # before, a person who drove last ends what starts

    pid = driving(rig, "follow")
    killed = rig.kill("autonomy_manager")
    assert until(lambda: gone(pid))
    assert rested_s(rig, killed) < 0.9
    assert until(lambda: rig.lists_scripts(killed), 60)
