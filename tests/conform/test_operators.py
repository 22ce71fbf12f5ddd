"""The checker finds every planted violation of the sample operator, and passes it as it is."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pebble.check_result import State
from pebble.client.connection import Target
from pebble.conform import operators
from pebble.conform.checks import run
from pebble.conform.operators import OPERATOR
from pebble.conform.stand_in import StandIn, played
from pebble.errors import PebbleError
from tests.conform.programs import (
    NATS,
    OPERATOR_PY,
    OPERATORS,
    WITHOUT_NATS,
    Command,
    Hall,
    Sample,
    at_named,
    at_open,
    ended,
    mutant,
    named_by_nats,
    named_by_the_fleet,
)
from tests.fleet.conftest import cheap_hashes as cheap_hashes
from tests.support import Broker, Child, further, some

pytestmark = pytest.mark.alone  # rates and deadlines are checked

ALL = {check.name: check for check in OPERATOR}
#: What a person types who is asked to do something; its end is the end of the program.
LINES = {
    operators.DRIVE: "0 0\n0 0.5\n",  # a client that was kept from driving asks to let go first
    operators.FULL: "0 0\n9 -9\n",
    operators.LET_GO: "0 0\n",
    operators.STOP: "stop\n",
    operators.RESET: "reset\n",
}

#: By check: what is written into the operator's program in place of what, and how the check names it.
VIOLATIONS: dict[str, tuple[str, str, str]] = {
    "control": ("and not self.must_let_go and may_move", "and not self.must_let_go", "without a key"),
    "requests": ('request = {"id": self.id', 'request = {"id": secrets.token_hex(4)', "its ids"),
    "rate": ("hz = max(2.0, min(20.0, self", "hz = max(2.0, min(50.0, 5 * self", "commands a second"),
    "stamps": ("monotonic_ns() // 1_000_000", "monotonic_ns() // 1_000_000_000", "t grew by"),
    "thin link": ('min(20.0, self.robot.link["drive_hz"])', "20.0", "commands a second"),
    "clamps": ("(max(-1.0, min(1.0, x)), max(-1.0, min(1.0, z)))", "(x, z)", "it sends 9"),
    "zero": (
        'self.send("drive-values", {"x": 0',
        '({"x": 0',
        "asked to let go of the stick: nothing came",
    ),
    "silence": ('SILENT_S.get(self.link["level"], SILENT_S["wide"])', "60", "a robot that is silent"),
    "offline": ('value.get("online") is False', "False", "a robot that is offline"),
    "refused": ('self.request("hold")', 'self.send("control/take", {"id": self.id}, 1)', "it takes control"),
    "stop": ("stop = StopSender()\n", "StopSender().step()\n", "it is not repeated"),
    "stopped": ('stop.get("latched") is not False', "False", "it drives a stopped robot"),
    "reset": ('"count": state.get("count")', '"count": 0', "not that of the state"),
    "payloads": ('{"id": self.id, "want": want', '{"id": self.id, "want": "drive"', "Invalid enum value"),
    "numbers": ('command = {"x": self.stick[0],', 'command = {"x": math.nan,', "NaN"),
    "release": ("driver.release()\n", "", "control is kept"),
    "retained": ("json.dumps(value), qos)", "json.dumps(value), qos, True)", "incoming/drive-values"),
    # It sends without a pause, which costs more than all others: only `make test THOROUGH=1` tries it.
    "idle": (
        "    driver.step(is_stopping=stop is not None)\n",
        '    driver.step(False)\n    send("drive-values", {"x": 0, "z": 0}, 1)\n',
        "it publishes incoming/drive-values",
    ),
    "taken": (
        'return "another has control now"',
        'self.send("control/take", {"id": self.id}, 1)',
        "it takes control back",
    ),
}


@contextmanager
def driven(command: Command, target: Target) -> Iterator[StandIn]:
    """An operator's program, whose person does what is asked, and the robot that is played for it."""
    with played(target) as robot:
        process = Child(
            [str(one) for one in command], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        person = process.stdin
        assert person is not None

        def ask(text: str) -> None:
            if text == operators.END:
                person.close()
            else:
                person.write(LINES[text].encode())
                person.flush()

        try:
            robot.ask, robot.person_s = ask, 10.0
            ask(operators.LET_GO)
            robot.wait(lambda: robot.inbox.sent, 10.0)
            robot.look(1.0)  # until it has seen a heartbeat
            robot.inbox.sent.clear()
            yield robot
        finally:
            process.kill()
            process.wait()


def judged(robot: StandIn, *names: str) -> dict[str, tuple[State, str]]:
    return {check.name: (one.state, one.text) for check, one in run(robot, [ALL[name] for name in names or ALL])}


@pytest.mark.parametrize("sample", [OPERATORS[0], *map(further, OPERATORS[1:])])
def test_a_sample_operator_passes(broker: Broker, tmp_path: Path, sample: Sample) -> None:
    program = sample(tmp_path)
    arguments, target = at_open(broker)
    with driven([*program, *arguments], target) as robot:
        found = judged(robot)
    assert {name: one for name, one in found.items() if one[0] is not State.OK} == {
        "names": (State.SKIPPED, "names are not checked here: use an account, as in --url mqtts://ROBOT@BROKER")
    }
    assert len(found) >= 10


def with_named_stops(folder: Path) -> Command:
    return [sys.executable, mutant(OPERATOR_PY, folder, "{PLAIN, INCOMING}", "{INCOMING}")]


@pytest.mark.thorough
@WITHOUT_NATS
@pytest.mark.parametrize("sample", OPERATORS)
def test_it_passes_at_another_broker(tmp_path: Path, sample: Sample) -> None:
    program = sample(tmp_path)
    with ended(NATS.make(tmp_path)) as broker:
        arguments, target = at_open(broker)
        with driven([*program, *arguments], target) as robot:
            found = judged(robot)
    assert [name for name, one in found.items() if one[0] is not State.OK] == ["names"]


@pytest.mark.usefixtures("cheap_hashes")
@pytest.mark.thorough
@pytest.mark.parametrize(
    ("hall", "sample", "violated"),
    [
        *((named_by_the_fleet, one, []) for one in OPERATORS),
        *(pytest.param(named_by_nats, one, [], marks=WITHOUT_NATS) for one in OPERATORS),
        (named_by_the_fleet, with_named_stops, ["names"]),
    ],
)
def test_where_names_are_checked(hall: Hall, tmp_path: Path, sample: Sample, violated: list[str]) -> None:
    program = sample(tmp_path)
    with hall(tmp_path / "hall") as broker:
        arguments, target = at_named(broker, tmp_path, "ann", "mine")
        with driven([*program, *arguments], target) as robot:
            found = judged(robot)
    assert [name for name, one in found.items() if one[0] is not State.OK] == violated


@pytest.mark.parametrize("name", some(VIOLATIONS, 5))
def test_a_violation_is_found(broker: Broker, tmp_path: Path, name: str) -> None:
    old, new, reason = VIOLATIONS[name]
    arguments, target = at_open(broker)
    needs = ["rate"] if name in ("stamps", "payloads", "numbers", "retained") else []
    with driven([sys.executable, mutant(OPERATOR_PY, tmp_path, old, new), *arguments], target) as robot:
        state, text = judged(robot, *needs, name)[name]
    assert (state, reason in text) == (State.FAILED, True), text


def test_no_robot_is_played_where_it_runs(broker: Broker) -> None:
    target = at_open(broker)[1]
    found: list[str] = []

    def play() -> None:
        try:
            with played(target):
                found.append("it is played")
        except PebbleError as error:
            found.append(str(error))

    with played(target) as robot:
        second = threading.Thread(target=play)
        second.start()
        robot.wait(lambda: found, 10)
        second.join()
    assert "runs at this broker" in found[0]
