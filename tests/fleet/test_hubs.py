"""A whole robot at three linked hubs, which are killed while an operator at another one drives it and sees pictures."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from pebble.transports import ZenohSettings, create
from tests.fleet.hosts_rig import TransportOperator
from tests.robot.operator import Driver, Operator, number_of
from tests.robot.rig import BASE, DEVICES, STOP, Rig
from tests.robot.test_media import CAMERA, want_video
from tests.support import cases, until
from tests.transports.zenoh.test_mesh import NAMES, Mesh

pytestmark = [pytest.mark.alone, pytest.mark.thorough]


class World:
    """Robot and operator know all hubs; the robot tries them in another order, so they begin at different ones."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.mesh = Mesh(folder)
        stack.callback(self.mesh.stop)
        ends = [hub.endpoint for hub in self.mesh.hubs.values()]
        settings = ZenohSettings(run_dir=folder / "operator", connect=(ends[1], ends[2], ends[0]), client=True)
        self.operator = TransportOperator(create("zenoh", "operator", settings))
        bridge = {"enabled": True, "remote": {"kind": "zenoh", "connect": ends}}
        self.rig = stack.enter_context(Rig("mqtt", operator=self.operator, mqtt_bridge=bridge, av_daemon=DEVICES))
        assert self.rig.local is not None
        self.inside = Operator(self.rig.local.port, BASE, "incoming/#")
        stack.callback(self.inside.close)


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with ExitStack() as stack:
        yield World(tmp_path, stack)


def test_a_killed_hub_costs_little_driving_and_few_pictures(world: World) -> None:
    operator, gaps, dark, ages = world.operator, list[float](), list[float](), list[float]()
    began = want_video(world.rig)
    assert until(lambda: len(operator.on(CAMERA, began)) > 5, 20)
    driver = Driver(operator)
    assert until(lambda: world.rig.mcu.moving(began), 10)
    for number in range(cases(1, 9)):
        hub = NAMES[number % 3]
        time.sleep(1)
        killed = time.monotonic()
        world.mesh.hubs[hub].kill()
        assert until(lambda killed=killed: len(operator.on(CAMERA, killed + 0.3)) > 3, 15)
        dark.append(operator.on(CAMERA, killed + 0.3)[0].at - killed)
        time.sleep(2)
        world.mesh.start(hub)
    driver.stop()
    assert until(lambda: not world.rig.mcu.moving(began), 3)
    drives = [one for one in world.inside.on("incoming/drive-values", began) if one.json["x"] or one.json["z"]]
    numbers = [number_of(one.json["z"] + one.json["x"], one.json["z"] - one.json["x"]) for one in drives]
    ages = [one.at - driver.sent_at[number] for one, number in zip(drives, numbers, strict=True)]
    gaps = [later.at - earlier.at for earlier, later in itertools.pairwise(drives)]
    wheels = world.rig.mcu.drives(began)
    stood = sum(values == STOP for _, values in wheels[1:-1])
    sys.stdout.write(
        f"\n{len(numbers)} commands, largest gap {max(gaps):.2f} s, oldest {max(ages):.2f} s, "
        f"pictures again after {max(dark):.2f} s, wheels stood {stood} times\n"
    )
    assert numbers == sorted(set(numbers)), "twice, or out of order"
    assert max(gaps) <= 0.5
    assert max(ages) <= 0.5
    assert max(dark) <= 3.0
