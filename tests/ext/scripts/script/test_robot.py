"""What a script can do with its robot, besides driving it: messages and pictures."""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pebble.config import parse
from pebble.contract import AUTONOMY_COMMAND, DRIVE, ESTOP_RESET, ESTOP_STATE, WHEEL_ODOMETRY, Channel, Kind, codec
from pebble.contract.payloads import Drive, WheelOdometry
from pebble.errors import PebbleError
from pebble.extensions.scripts.script import Robot, Stopped
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.av.media_rig import HEIGHT, WIDTH, Filming
from tests.support import until

BASE = "pebble/robots/goob"
MOOD = Channel(metric="mood", kind=Kind.EVENT, payload=dict)


class Setting:
    """A robot, another program on its transport, and a clock that is moved by hand."""

    def __init__(self, run_dir: str, **options: Any) -> None:
        hub = MemoryHub()
        self.other, transport = MemoryTransport("other", hub).open(), MemoryTransport("script", hub).open()
        self.now = 100.0
        config = parse(
            {"robot": {"id": "goob"}, "transport": {"kind": "mqtt", "run_dir": run_dir}}, folder=Path(run_dir), env={}
        )
        self.robot = Robot(config, transport, lambda above: above + 1, clock=lambda: self.now, **options)

    def send(self, value: WheelOdometry) -> None:
        self.other.publish(WHEEL_ODOMETRY.topic(BASE), codec.encode(WHEEL_ODOMETRY, value))

    def close(self) -> None:
        self.robot.close()
        self.other.close()


@pytest.fixture
def setting() -> Iterator[Setting]:
    with tempfile.TemporaryDirectory(prefix="pbl") as folder:
        setting = Setting(folder)
        yield setting
        setting.close()


def odometry(x_mm: float) -> WheelOdometry:
    return WheelOdometry(value={"x_mm": x_mm}, timestamp=0.0)


def test_the_latest_message_ages_from_its_arrival(setting: Setting) -> None:
    robot = setting.robot
    assert robot.latest(WHEEL_ODOMETRY) is None
    setting.send(odometry(1.0))
    setting.send(odometry(2.0))
    assert until(lambda: robot.latest(WHEEL_ODOMETRY) == odometry(2.0))
    setting.now += 0.9
    assert robot.latest(WHEEL_ODOMETRY, max_age=1.0) == odometry(2.0)
    assert robot.latest(WHEEL_ODOMETRY, max_age=0.5) is None
    setting.now += 0.2
    assert robot.latest(WHEEL_ODOMETRY, max_age=1.0) is None


def test_a_malformed_message_takes_no_valid_ones_place(setting: Setting) -> None:
    robot = setting.robot
    received: list[WheelOdometry] = []
    robot.on(WHEEL_ODOMETRY, received.append)
    robot.latest(WHEEL_ODOMETRY)
    setting.send(odometry(1.0))
    setting.other.publish(WHEEL_ODOMETRY.topic(BASE), b"{")
    setting.send(odometry(3.0))
    assert until(lambda: len(received) == 2)
    assert received == [odometry(1.0), odometry(3.0)]


@pytest.mark.parametrize(
    ("channel", "names", "why"),
    [
        (DRIVE, {}, "use robot.drive"),
        (Channel(metric="drive-values", kind=Kind.COMMAND, payload=dict), {}, "use robot.drive"),
        (ESTOP_RESET, {}, "let people reset"),
        (ESTOP_STATE, {"owner": "wheels"}, "motor owners publish it"),
        (AUTONOMY_COMMAND, {}, "let people start scripts"),
    ],
)
def test_a_script_neither_drives_unsigned_nor_resets_nor_starts_scripts(
    setting: Setting, channel: Channel, names: dict[str, str], why: str
) -> None:
    with pytest.raises(PebbleError, match=why):
        setting.robot.publish(channel, {}, **names)
    with pytest.raises(PebbleError, match=why):
        setting.robot.publish_at_end(channel, dict)


@pytest.mark.parametrize(
    "act",
    [
        lambda robot: robot.drive(z=0.5),
        lambda robot: robot.publish(Channel(metric="arm", kind=Kind.COMMAND, payload=dict), {}),
        lambda robot: robot.publish_at_end(Channel(metric="arm", kind=Kind.COMMAND, payload=dict), dict),
    ],
)
def test_a_script_that_declares_no_drive_commands_nothing(tmp_path: Path, act: Callable[[Robot], object]) -> None:
    with closing(Setting(str(tmp_path), drives=False)) as setting:
        assert setting.robot.publish(MOOD, {"mood": "fine"})
        with pytest.raises(PebbleError, match="only measures"):
            act(setting.robot)


def test_a_last_value_that_fails_keeps_nothing_from_ending(setting: Setting, caplog: pytest.LogCaptureFixture) -> None:
    sorrow = Channel(metric="sorrow", kind=Kind.EVENT, payload=dict)
    received: list[dict[str, str]] = []
    setting.other.subscribe(sorrow.topic(BASE), lambda message: received.append(codec.decode(sorrow, message.payload)))
    setting.robot.publish_at_end(MOOD, lambda: {"mood": str(1 // 0)})
    setting.robot.publish_at_end(sorrow, lambda: {"mood": "sad"})
    setting.robot.end("a test")
    assert until(lambda: received == [{"mood": "sad"}])
    assert "publish_at_end: no last mood" in caplog.text


@pytest.mark.parametrize(("x", "error"), [("left", ValueError), (None, TypeError), (math.nan, ValueError)])
def test_what_is_no_number_is_named_and_drives_nothing(setting: Setting, x: Any, error: type[Exception]) -> None:
    for axis in ("x", "z"):
        with pytest.raises(error, match=rf"{axis} is (a number from -1 to 1, not |not a finite)"):
            setting.robot.drive(**{axis: x})


@pytest.mark.parametrize("half", [np.float32(0.5), np.array(0.5)])
def test_models_drive_with_numbers_of_numpy(setting: Setting, half: float) -> None:
    received: list[Drive] = []
    setting.other.subscribe(DRIVE.topic(BASE), lambda message: received.append(codec.decode(DRIVE, message.payload)))
    assert setting.robot.drive(x=half)
    assert until(lambda: [drive.x for drive in received] == [0.5])


def test_every_call_ends_a_script_that_is_to_end(setting: Setting) -> None:
    robot = setting.robot
    robot.end("enough", 3)
    calls = [robot.drive, robot.stop, robot.picture, lambda: robot.sleep(0), lambda: robot.latest(MOOD)]
    for call in [*calls, lambda: robot.publish(MOOD, {}), lambda: robot.on(MOOD, print), lambda: next(robot.camera())]:
        with pytest.raises(Stopped) as stopped:
            call()
        assert stopped.value.code == 3


@pytest.mark.parametrize("wait", [lambda robot: robot.sleep(60), lambda robot: next(robot.camera())])
def test_a_wait_ends_with_the_script(setting: Setting, wait: Callable[[Robot], object]) -> None:
    threading.Timer(0.1, lambda: setting.robot.end("enough")).start()
    with pytest.raises(Stopped):
        wait(setting.robot)


def test_pictures_in_a_loop_over_them_and_in_a_loop_of_its_own(setting: Setting) -> None:
    robot = setting.robot
    with Filming(robot.config.run_dir()):
        assert next(robot.camera()).shape == (HEIGHT, WIDTH, 3)
        assert until(lambda: robot.picture(max_age=0.5) is not None)
        assert robot.picture(max_age=0.0) is None
    assert until(lambda: robot.picture(max_age=0.2) is None)
