"""The check that turns wheels: a little way, after a person has agreed, and under control that no other person had."""

from dataclasses import replace

from pebble.checks.check import CheckResult, State, failed, skipped
from pebble.checks.conform.control import Driver
from pebble.checks.conform.motion import LATE_S, at_the_wheel, rested
from pebble.checks.running.robot import RobotUnderTest

SPEED, DRIVES_S = 0.2, 0.3
_CONTROL_S = 3.0
_FIXES = {
    State.FAILED: "battery, motors and their wires; pebble doctor CONFIG; journalctl -u pebble -n 50",
    State.SKIPPED: "look whether it moved, or set services.serial_mcu_bridge.telemetry.publish_touch_sensors to true",
}


def wheels(robot: RobotUnderTest) -> CheckResult:
    """Drive a little way ahead and back; between the two, and after it, the robot stops by itself."""
    if robot.view.charging:
        return skipped("it is on its charger")
    with at_the_wheel(robot.way, robot.by.partition("@")[0], _CONTROL_S) as driver:
        if not driver.may_drive:
            return skipped(f"{robot.way.view.control.who or 'no one'} has control")
        results = []
        for speed in (SPEED, -SPEED):
            results.append(_drive(robot, driver, speed))
            if results[-1].state is State.FAILED:
                break
    return next((result for result in results if result.state is not State.OK), results[-1])


def _drive(robot: RobotUnderTest, driver: Driver, speed: float) -> CheckResult:
    began, last = driver.drive(DRIVES_S, z=speed)
    robot.wait(lambda: False, robot.rests_s + LATE_S)
    if robot.view.latched:
        return failed("it was stopped meanwhile", "pebble estop status CONFIG")
    if not driver.may_drive:
        return skipped(f"{robot.way.view.control.who or 'another one'} took control")
    result = rested(robot.inside, began, last, robot.rests_s)
    return replace(result, text=f"at {speed:+.1f}: {result.text}", fix=_FIXES.get(result.state, ""))
