"""The check that turns wheels: a little way, after a person has agreed, and under control that no other person had."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import msgspec

from pebble.checks.check import CheckResult, State, failed, skipped
from pebble.checks.conform.motion import LATE_S, rested
from pebble.checks.running.robot import RobotUnderTest, Side
from pebble.client.control import ControlClient
from pebble.client.pace_of_link import WIDE
from pebble.contract import DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.transports import Message

SPEED, DRIVES_S = 0.2, 0.3
_STEP_S = 0.05
_CONTROL_S = 3.0
_FIXES = {
    State.FAILED: "battery, motors and their wires; pebble doctor CONFIG; journalctl -u pebble -n 50",
    State.SKIPPED: "look whether it moved, or set services.serial_mcu_bridge.telemetry.publish_touch_sensors to true",
}


def wheels(robot: RobotUnderTest) -> CheckResult:
    """Drive a little way ahead and back; between the two, and after it, the robot stops by itself."""
    if robot.view.charging:
        return skipped("it is on its charger")
    side = robot.way
    with _in_control(robot, side) as (control, why):
        if why:
            return skipped(why)
        results = []
        for speed in (SPEED, -SPEED):
            results.append(_drive(robot, side, control, speed))
            if results[-1].state is State.FAILED:
                break
    return next((result for result in results if result.state is not State.OK), results[-1])


def _drive(robot: RobotUnderTest, side: Side, control: ControlClient, speed: float) -> CheckResult:
    side.publish([_command(side, control, Drive())])  # after a reset it waits for one
    began = sent_at = time.monotonic()
    while time.monotonic() < began + DRIVES_S:
        if robot.view.latched:
            return failed("it was stopped meanwhile", "pebble estop status CONFIG")
        if robot.view.controlled and not control.held:
            return skipped(f"{robot.view.control.who or 'another one'} took control")
        sent_at = time.monotonic()
        side.publish([_command(side, control, Drive(z=speed, valid_ms=side.view.pace.valid_ms))])
        _hold(robot, side, control, max(_STEP_S, side.view.pace.step_s))
    _hold(robot, side, control, robot.rests_s + LATE_S)
    result = rested(robot.inside, began, sent_at, robot.rests_s)
    return replace(result, text=f"at {speed:+.1f}: {result.text}", fix=_FIXES.get(result.state, ""))


@contextmanager
def _in_control(robot: RobotUnderTest, side: Side) -> Iterator[tuple[ControlClient, str]]:
    """Take control for the block, or tell why there is none; who has it is asked for nothing."""
    control = ControlClient(side.view.control, by=robot.by.partition("@")[0], device="selftest")

    def held() -> bool:
        side.publish(control.tick(time.monotonic()))
        return control.held or not control.wanted

    why = ""
    try:
        if side.view.controlled:
            control.ask(time.monotonic())
            robot.wait(held, _CONTROL_S)
            why = "" if control.held else control.failed or f"{side.view.control.who or 'no one'} has control"
        yield control, why
    finally:
        if not why:
            side.publish([_command(side, control, Drive(valid_ms=0))])
        control.release()
        side.publish(control.tick(time.monotonic()))


def _hold(robot: RobotUnderTest, side: Side, control: ControlClient, seconds: float) -> None:
    """Let time pass, and renew control meanwhile; a request drives nothing."""

    def renew() -> bool:
        side.publish(control.tick(time.monotonic()))
        return False

    robot.wait(renew, seconds)


def _command(side: Side, control: ControlClient, command: Drive) -> Message:
    if control.key and command.valid_ms != 0:
        command = msgspec.structs.replace(command, key=control.key)
    qos = WIDE.qos
    if command.moves:
        qos, command = side.view.pace.qos, side.view.pace.dated(command, time.monotonic(), control.id)
    return Message(side.view.estop.drive_topic, codec.encode(DRIVE, command), qos)
