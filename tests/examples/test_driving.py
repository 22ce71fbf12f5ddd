"""The sample operators drive the sample robot: control, commands, letting go, stop, reset, and a robot that is gone."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from pebble import contract as c
from pebble.contract.payloads import Drive
from pebble.extensions.checks.observer import Observer
from tests.ext.checks.conform.programs import OPERATORS, Sample, at_open, robot_in_python, switched_on
from tests.support import SOON_S, WAIT_S, Broker, Child, further, until

pytestmark = pytest.mark.alone  # rates and deadlines are checked

SLOWEST_HZ, FASTEST_HZ = 4.0, 25.0  # a busy machine is slow
SILENT_S = 5.0


class Scene(NamedTuple):
    """A robot, the program of its operator, and everything that both publish."""

    robot: Child
    operator: Child
    seen: Observer

    def type(self, *lines: str) -> None:
        """Type lines as the operator's person."""
        assert self.operator.stdin is not None
        self.operator.stdin.write("".join(f"{line}\n" for line in lines).encode())
        self.operator.stdin.flush()

    def is_connected(self) -> bool:
        """True if something is published when the person lets go: what is typed before it is connected is dropped."""
        self.type("0 0")
        return self.seen.wait(self.commands, 0.5)

    def commands(self, since: float = 0.0) -> list[Drive]:
        return [record.value for record in self.seen.of(c.DRIVE, since) if record.value is not None]

    def wheels(self) -> list[float]:
        reports = [record.value.value for record in self.seen.of(c.STATUS, retained=True) if record.value is not None]
        return reports[-1].get("wheels", []) if reports else []

    def key(self) -> str:
        """Return the key of who has control; empty if nobody has."""
        state = self.seen.view.control.state
        return "" if state is None else state.key

    def drives(self) -> None:
        """Drive ahead; one that was kept from driving lets go first."""
        self.type("0 0")
        self.seen.look(0.3)
        self.type("0 0.5")
        assert self.seen.wait(lambda: self.wheels() == [0.5, 0.5], WAIT_S)


@pytest.fixture(params=[OPERATORS[0], *map(further, OPERATORS[1:])])
def scene(request: pytest.FixtureRequest, broker: Broker, tmp_path: Path) -> Iterator[Scene]:
    operator: Sample = request.param
    place, quiet = at_open(broker), {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with switched_on(robot_in_python(tmp_path), place, tmp_path, "pebble/robots/mine/#") as (robot, seen):
        person = Child([str(word) for word in (*operator(tmp_path), *place[0])], stdin=subprocess.PIPE, **quiet)
        try:
            scene = Scene(robot, person, seen)
            assert until(scene.is_connected)
            seen.look(1.0)  # until it has seen a heartbeat
            yield scene
        finally:
            person.kill()
            person.wait()


def test_it_asks_for_control_and_drives_at_its_rate(scene: Scene) -> None:
    scene.drives()
    began = scene.seen.look(2.0)
    commands = scene.commands(began)
    assert SLOWEST_HZ <= len(commands) / 2.0 <= FASTEST_HZ
    key = scene.key()
    assert {command.key for command in commands} == {key}
    stamps = [command.t for command in commands]
    assert stamps == sorted(stamps)
    scene.type("9 -9")
    assert scene.seen.wait(lambda: scene.commands()[-1].z == -1, WAIT_S)
    assert scene.commands()[-1].x == 1


def test_a_stick_that_is_let_go_stops_it_at_once_and_then_nothing_is_sent(scene: Scene) -> None:
    scene.drives()
    scene.type("0 0")
    assert scene.seen.wait(lambda: scene.wheels() == [0, 0], SOON_S)
    quiet_from = scene.seen.look(0.5) + 0.5
    scene.seen.look(1.0)
    assert scene.commands(quiet_from) == []


def test_a_stop_latches_the_robot_and_only_a_reset_frees_it(scene: Scene) -> None:
    scene.drives()
    scene.type("stop")
    assert scene.seen.wait(lambda: scene.seen.view.latched, WAIT_S)
    assert scene.seen.wait(lambda: scene.wheels() == [0, 0], SOON_S)
    scene.seen.look(1.0)
    scene.type("0 0", "reset")
    assert scene.seen.wait(lambda: not scene.seen.view.latched, WAIT_S)
    scene.drives()


@pytest.mark.parametrize("scene", OPERATORS, indirect=True)
def test_at_its_end_it_sends_a_zero_and_releases_control(scene: Scene) -> None:
    scene.drives()
    scene.seen.look(0.8)  # it is about to ask again
    assert scene.operator.stdin is not None
    scene.operator.stdin.close()
    assert scene.seen.wait(lambda: scene.key() == "", SOON_S)
    assert scene.operator.wait(WAIT_S) == 0
    asked = [record.value.want for record in scene.seen.of(c.CONTROL) if record.value is not None]
    assert (asked[-1], scene.commands()[-1].moves) == ("release", False)


def test_a_robot_that_is_gone_is_not_driven_on(scene: Scene) -> None:
    scene.drives()
    scene.robot.kill()
    scene.robot.wait()
    scene.seen.look(SILENT_S)
    assert scene.commands(scene.seen.look(1.0)) == []
