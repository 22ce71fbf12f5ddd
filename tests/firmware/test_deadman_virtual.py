"""The dead-man's switch in virtual time: random schedules of faults.

Checked: motors are off at most 1.0 s after the last command that arrived; they follow the newest fresh command;
retained messages and nonsense never move them; no command moves them that left the broker more than 2.45 s ago (the
time in the broker's own queue is unknown); no turn of the loop blocks; after the faults the robot is online again
within 30 s and executes commands. While it is stopped nothing moves, also after a power cut once its state says that
this is saved.
"""

from __future__ import annotations

import json
from itertools import pairwise

import pytest

from pebble.extensions.lab.simulation.wireless import KINDS
from tests.firmware.drill import LIMIT_S, ONLINE, RESENT_S, START_S, Drill, ViolatedError
from tests.firmware.schedules import FAULTS, act, perform
from tests.support import cases, some

pytestmark = pytest.mark.computing

MIXED, SINGLE = cases(40, 700), cases(2, 30)  # schedules per robot; of each fault alone
FIRST_SINGLE = 700  # seeds of single faults begin here


@pytest.mark.parametrize("kind", KINDS)
def test_motors_obey_the_newest_fresh_command_and_stop_without_one(kind: str) -> None:
    drills = [_performed(kind, seed) for seed in range(MIXED)]
    assert max(drill.seen.longest_run for drill in drills) <= LIMIT_S
    assert sum(drill.seen.moves for drill in drills) > 10 * MIXED  # they were driven indeed
    assert (
        sum(drill.robot.deadman.trips for drill in drills) > MIXED // 2
    )  # and often stopped by the dead-man's switch only
    assert sum(drill.robot.refused for drill in drills) > MIXED
    assert sum(drill.robot.stops.latch.count for drill in drills) > MIXED // 10


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", KINDS)
def test_each_fault_alone(kind: str, fault: str) -> None:
    for seed in range(SINGLE):
        _performed(kind, FIRST_SINGLE + seed, fault)


def _performed(kind: str, seed: int, *faults: str) -> Drill:
    drill = Drill(kind, seed)
    try:
        perform(drill, *([faults] if faults else []))
    except ViolatedError as error:
        raise ViolatedError(f"{kind}, seed {seed}, {faults or 'mixed faults'}: {error}") from None
    return drill


@pytest.mark.parametrize("fault", some(["flood", "quiet", "ntp", "i2c"], 2))
@pytest.mark.parametrize("kind", KINDS)
def test_the_heartbeat_continues(kind: str, fault: str) -> None:
    """Four times a second, whatever happens beside it, and stamped by a clock that never goes back."""
    for seed in range(cases(4, 10)):
        drill = Drill(kind, seed)
        act(drill, (fault,))
        received = [one for one in drill.broker.received if one.message.topic == ONLINE and one.at > START_S + 5.0]
        times = [one.at for one in received]
        assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(0.25, rel=0.1)
        assert max(later - earlier for earlier, later in pairwise(times)) < 0.25 + 2 * RESENT_S
        stamps = [json.loads(one.message.payload)["t"] for one in received]
        assert all(later > earlier for earlier, later in pairwise(stamps))
