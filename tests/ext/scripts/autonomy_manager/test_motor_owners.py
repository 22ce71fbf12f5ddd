"""What the motor owners' states mean for a script that is to start, or runs."""

from __future__ import annotations

import operator
from typing import Any

import pytest

from pebble.contract.payloads import ControlState
from pebble.extensions.scripts.runs import SUPERSEDED, following
from pebble.motion.arbiter import Arbiter
from pebble.motion.latch import Latch
from pebble.motion.lease import Lease
from pebble.services.autonomy_manager.motor_owners import OVERRIDDEN, MotorOwners
from pebble.services.autonomy_manager.script import Dependency, StartError, plan
from tests.ext.operator.client.estop_robot import estop_state as state
from tests.ext.scripts.autonomy_manager.fake_children import script


@pytest.fixture
def owners() -> MotorOwners:
    owners = MotorOwners(["serial"])
    owners.receive("serial", state(barred=7))
    return owners


def test_only_a_latched_robot_refuses_and_names_who(owners: MotorOwners) -> None:
    assert (owners.refusal, owners.barred) == ("", 7)
    assert owners.ending(8, owners.baseline()) == ""
    owners.receive("serial", state(latched=True, by="ann\x07"))
    assert owners.refusal == "emergency stop by ann? of motor owner serial: reset it first"


@pytest.mark.parametrize(
    ("newest_run", "fields", "why"),
    [
        (0, {"latched": True, "count": 1, "barred": 8}, "emergency stop of motor owner serial: reset it first"),
        (0, {"count": 1, "barred": 8, "by": "bob"}, "emergency stop by bob of motor owner serial: it was reset since"),
        (0, {"barred": 8}, OVERRIDDEN),
        (9, {"barred": 8}, SUPERSEDED),
        (0, {"barred": 9, "boot": "bb"}, SUPERSEDED),
        (0, {"boot": "bb"}, "motor owner serial was restarted: start the script again"),
        (0, {"barred": 7}, ""),
    ],
)
def test_a_run_ends_with_the_reason_and_a_newer_run_is_no_operator(
    owners: MotorOwners, newest_run: int, fields: dict[str, Any], why: str
) -> None:
    if newest_run:
        owners.note_run(newest_run)
    baseline = owners.baseline()
    owners.receive("serial", state(**fields))
    assert owners.ending(8, baseline) == why


def test_an_owner_that_appears_during_a_run_must_not_change_from_then_on() -> None:
    owners = MotorOwners([])
    baseline = owners.baseline()
    owners.receive("esp", state())
    assert owners.ending(1, baseline) == ""
    owners.receive("esp", state(boot="cc"))
    assert owners.ending(1, baseline) == "motor owner esp was restarted: start the script again"


def test_states_of_others_count_only_where_no_owner_is_known() -> None:
    owners = MotorOwners(["serial"])
    owners.receive("old", state(latched=True))
    assert owners.refusal == ""
    unknown = MotorOwners([])
    for number in range(100):
        unknown.receive(f"o{number}", state(barred=number))
    assert unknown.barred == 15


HALF, LAST = 1 << 29, (1 << 30) - 1


@pytest.mark.parametrize(
    "barred",
    [[7, HALF + 9], [HALF + 9, 7], [1, LAST], [0, HALF], [5, LAST // 3, LAST // 3 * 2]],
)
def test_every_owner_comes_to_obey_a_run_also_one_that_was_away_while_a_stranger_sent_numbers(
    barred: list[int],
) -> None:
    table, arbiters = MotorOwners([]), []
    for owner, number in enumerate(barred):
        table.receive(f"o{owner}", state(barred=number))
        arbiters.append(Arbiter(Latch("aa", 8, operator.sub), Lease(0, operator.sub, str, 0), 0, operator.sub, 750))
        arbiters[-1].bar(number)
    run, baseline = following(table.barred), table.baseline()
    zeros = list(table.steps_to(run))
    for arbiter in arbiters:
        for number in zeros:
            arbiter.judge(False, number, -1, 3000)
        assert arbiter.judge(True, run, -1, 3000) == 750
    assert table.ending(run, baseline) == "", "what was barred before the start ends nothing"


@pytest.mark.parametrize(
    ("states", "by", "holder"),
    [
        ({}, "ann", ""),
        ({"serial": ("ann", "0badf00d")}, "ann", ""),
        ({"serial": ("ann", "0badf00d")}, "otto", "ann"),
        ({"serial": ("", "0badf00d")}, "ann", "a program of the robot"),
        ({"serial": ("page-1/ann", "0badf00d")}, "page-1/bob", ""),  # the page asks its own people
        ({"serial": ("page-1/ann", "0badf00d")}, "ann", "page-1/ann"),
        ({"left": ("otto", "0badf00d"), "arm": ("ann", "1badf00d")}, "ann", ""),  # the first owner by name decides
    ],
)
def test_who_has_control_beside_the_one_who_asks(states: dict[str, tuple[str, str]], by: str, holder: str) -> None:
    owners = MotorOwners(list(states))
    for owner, (name, key) in states.items():
        owners.receive_control(owner, ControlState(by=name, id="aaaaaaaa", key=key))
        owners.receive_control(f"forged-{owner}", ControlState(by="mia", id="bbbbbbbb", key="2badf00d"))
    assert owners.holder_beside(by) == holder


# -- whether a start is possible, and the words for why it is not


SCRIPTS = {
    "walk": script("walk", Dependency("eyes", {"speed": 1})),
    "eyes": script("eyes"),
    "new": script("new", asked=False),
    "lost": script("lost", Dependency("nose")),
    "late": script("late", Dependency("new")),
    "torn": script("torn", broken="run.py, line 3: invalid syntax"),
    "fast": script("fast", Dependency("eyes", {"speed": 9})),
    "\u00c5": script("\u00c5"),
    "A\u030a": script("A\u030a"),
}


def test_a_plan_has_the_dependencies_with_their_own_settings() -> None:
    found = plan(SCRIPTS, "walk", {"speed": "0.1"})
    assert [(step.script.file, step.options) for step in (*found.dependencies, found.main)] == [
        ("eyes", ("--speed", "1.0")),
        ("walk", ("--speed", "0.1")),
    ]
    assert found.config == {"speed": 0.1}


@pytest.mark.parametrize(("there", "typed"), [("ba\u0308r", "b\u00e4r"), ("bar", "bar")])
def test_a_script_is_started_by_a_name_that_looks_the_same(there: str, typed: str) -> None:
    found = plan({"x": script("x", Dependency(typed)), there: script(there)}, "x", {})
    assert [step.script.file for step in found.dependencies] == [there]
    assert plan({there: script(there)}, typed, {}).main.script.file == there


@pytest.mark.parametrize(
    ("file", "config", "error"),
    [
        ("run\x1b", {}, "Unknown autonomy file: run?"),
        ("walk", {"speed": 2}, "Invalid config for walk: speed above maximum 1"),
        ("lost", {}, "Failed to start lost: Dependency script not found: nose"),
        ("torn", {"speed": 2}, "Failed to start torn: run.py, line 3: invalid syntax"),
        ("late", {}, "Failed to start late: new: it is still asked what it needs"),
        ("fast", {}, "Failed to start fast: Invalid config for eyes: speed above maximum 1"),
        ("\u212b", {}, "Unknown autonomy file: \u212b: 2 names look like this: rename all but one"),
    ],
)
def test_a_start_that_is_not_possible_is_refused_with_the_originals_words(
    file: str, config: dict[str, Any], error: str
) -> None:
    with pytest.raises(StartError) as caught:
        plan(SCRIPTS, file, config)
    assert str(caught.value) == error
