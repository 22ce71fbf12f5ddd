"""Checks that operate a robot: request media, stop and drive it. Afterwards it is free again."""

import time
from dataclasses import replace
from functools import partial

from pebble.check_result import CheckResult, State, failed, ok, skipped
from pebble.contract import ESTOP_RESET, ESTOP_STATE, codec
from pebble.contract.payloads import EstopReset
from pebble.errors import PebbleError
from pebble.extensions.checks.conform.control import Driver
from pebble.extensions.checks.conform.motion import LATE_S, at_the_wheel, rested
from pebble.extensions.checks.running.robot import RobotUnderTest
from pebble.extensions.operator.client.driveable import doubt_of, is_cut_off
from pebble.extensions.operator.client.estop import StopSender, new_name, send
from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.extensions.operator.client.media_request.offer import Medium
from pebble.extensions.operator.client.robot_estop import Reset
from pebble.transports import QoS

_LOG = "pebble doctor CONFIG; journalctl -u pebble -n 50"
_PROGRAMS: dict[Medium, str] = {"video": "camera_publisher", "audio": "audio_publisher"}
_CONFIRMED_S = 5.0  # a stop is repeated every half second
_WHY = "selftest"
_NO_BOOT, _NO_COUNT = "selftest", 1_000_000  # no motor owner has had this boot id, or so many stops
_SPEED, _DRIVES_S = 0.2, 0.3
_CONTROL_S = 3.0
_WHEEL_FIXES = {
    State.FAILED: f"battery, motors and their wires; {_LOG}",
    State.SKIPPED: "look whether it moved, or set services.serial_mcu_bridge.telemetry.publish_touch_sensors to true",
}


# -- pictures and sound


def received(robot: RobotUnderTest, medium: Medium, device: str) -> CheckResult:
    """Check that requested pictures or sound arrive; then end the request."""
    if _PROGRAMS[medium] not in robot.config.on_demand_programs():
        return skipped(f"it has no {device}")
    receiver = MediaReceiver(robot.commanding_side.transport, robot.config.base)

    def arrived() -> bool:
        receiver.poll()
        return receiver.newest is not None if medium == "video" else receiver.sounds.count > 0

    try:
        receiver.wait_for_capabilities(robot.patience_s)
        began = time.monotonic()
        receiver.request(medium)
        if not robot.wait(arrived, robot.patience_s):
            return failed(f"none came from the {device} within {robot.patience_s:g} s", _LOG)
        took_s = time.monotonic() - began
    except PebbleError as error:
        return failed(str(error), _LOG)
    finally:
        receiver.close()
    size = ""
    if receiver.newest is not None:
        height, width = receiver.newest.picture.shape[:2]
        size = f"{width}×{height}, "
    return ok(f"{size}{receiver.encoding[medium]}, after {took_s:.1f} s")


# -- the emergency stop


def stop(robot: RobotUnderTest) -> CheckResult:
    """Check that an operator's stop is confirmed; then end exactly this stop from the robot's own side."""
    before = {owner: state.recent for owner, state in robot.view.estop.states.items()}  # names of the newest stops
    side, name = robot.commanding_side, new_name()
    sender = StopSender(name, by=robot.by, why=_WHY, now=time.monotonic(), robots=[robot.config.base])
    stopped = sender.robots[robot.config.base]
    stopped.estop = side.view.estop  # as it is known already, with its topics
    side.listeners.append(sender.receive)

    def confirmed() -> bool:
        send(partial(side.transport.publish, urgent=True), sender.tick(time.monotonic()))
        return sender.confirmed

    try:
        robot.wait(confirmed, _CONFIRMED_S)
        took_s, why = stopped.confirmed_s, stopped.why
    finally:  # also if this is interrupted: the robot must not stay stopped by a test
        why_stopped = _end(robot, name, before)
    if why_stopped:
        return failed(why_stopped, "pebble estop reset CONFIG")
    if took_s is None:
        text = f"NOT CONFIRMED after {_CONFIRMED_S:g} s: {why}"
        return failed(text, "pebble doctor CONFIG; pebble estop CONFIG")
    if is_cut_off(robot.view.driveable):  # it confirms, and says itself that nothing reaches the motors
        return failed(f"{robot.view.name} is latched; {doubt_of(robot.view.driveable, stopped=True)}", _LOG)
    sender_side = "its own side" if side.own else "operators"
    return ok(f"confirmed {took_s:.2f} s after {sender_side} sent it, and ended by name")


def _end(robot: RobotUnderTest, name: str, before: dict[str, list[str]]) -> str:
    """End this stop, unless stops came that are not in ``before`` (by owner); return why the robot stays stopped."""
    view = robot.view
    robot.wait(lambda: all(name in state.recent for state in view.estop.states.values()), 1.0)
    if not view.latched:
        return ""
    for owner, state in view.estop.latched.items():
        is_newest = state.recent[:1] == [name]  # of the owner's stops
        new_others = [other for other in state.recent[1:] if other not in before.get(owner, [])]
        if new_others or not is_newest:
            return f"it was stopped by another one meanwhile, and stays so ({state.by or 'unknown'}: {state.why})"
    reset = Reset(view.estop, robot.by)
    send(partial(robot.own_side.transport.publish, urgent=True), reset.messages())
    robot.wait(lambda: not reset.waiting, robot.patience_s)
    refusals = [f"{owner}: {why}" for owner, why in reset.refusals().items()]
    return f"it stays stopped: {', '.join(refusals)}" if refusals else ""


def retained_commands(robot: RobotUnderTest) -> CheckResult:
    """Check that the robot ignores a retained command.

    The command is a reset that no motor owner could accept: an owner that reads it publishes why it refuses it. A live
    reset of another kind follows, which must be answered: this shows that the silence before was no accident.
    """
    operators = robot.commanding_side
    if robot.own_side.heartbeats:  # the bridge sends them to operators alone: both sides are at the operators' broker
        return skipped("one broker serves both sides: there, what is published to be retained is live at first")
    owner, state = next(iter(robot.view.estop.states.items()), (None, None))
    if owner is None or state is None:
        return skipped("it publishes no emergency stop")
    if state.reset_refused is not None:
        return skipped("it refused a reset before, which looks the same", "run it again")
    topic, metric = ESTOP_RESET.topic(robot.config.base), ESTOP_STATE.suffix.format(owner=owner)
    began = time.monotonic()

    def refusals() -> set[str | None]:
        states = [record for record in operators.of(ESTOP_STATE, began) if record.metric == metric]
        return {record.value.reset_refused for record in states if record.value is not None}

    def publish_retained(payload: bytes) -> None:  # on ``beside``, the connection that the with block below opens
        beside.publish(topic, payload, qos=QoS.DELIVERED, retain=True, remember=False)
        robot.wait(lambda: beside.outgoing.waiting == 0, robot.patience_s)

    # This connection puts no account into the topic, as nothing is retained on a topic with one.
    with operators.beside("selftest") as (beside, _):
        try:
            publish_retained(codec.encode(ESTOP_RESET, EstopReset(boot=_NO_BOOT, count=0, by=_WHY)))
            operators.send(ESTOP_RESET, EstopReset(boot=state.boot, count=state.count + _NO_COUNT, by=_WHY))
            robot.wait(lambda: "count" in refusals(), robot.patience_s)
        finally:
            publish_retained(b"")  # removes it
    if "boot" in refusals():
        return failed("it read a retained command as if it were sent now", "pebble doctor CONFIG")
    if "count" not in refusals():
        return skipped("a live one of this account is not answered either")
    return ok("it ignores them")


# -- driving


def wheels(robot: RobotUnderTest) -> CheckResult:
    """Drive a short way ahead and back, if a person has agreed; after each the robot must stop by itself."""
    if robot.view.charging:
        return skipped("it is on its charger")
    user = robot.by.partition("@")[0]  # without the machine: names of who has control hold no @
    with at_the_wheel(robot.commanding_side, user, _CONTROL_S) as driver:
        if not driver.may_drive:
            return skipped(f"{robot.commanding_side.view.control.who or 'no one'} has control")
        ahead = _drive(robot, driver, _SPEED)
        if ahead.state is State.FAILED:
            return ahead
        back = _drive(robot, driver, -_SPEED)
    return back if ahead.state is State.OK else ahead


def _drive(robot: RobotUnderTest, driver: Driver, speed: float) -> CheckResult:
    """Drive for a moment; judge by the robot's own reports whether it moved, and came to rest."""
    began, last = driver.drive(_DRIVES_S, z=speed)
    robot.wait(lambda: False, robot.rests_s + LATE_S)  # in any case: until it must rest
    if robot.view.latched:
        return failed("it was stopped meanwhile", "pebble estop status CONFIG")
    if not driver.may_drive:
        return skipped(f"{robot.commanding_side.view.control.who or 'another one'} took control")
    result = rested(robot.own_side, began, last, robot.rests_s)
    return replace(result, text=f"at {speed:+.1f}: {result.text}", fix=_WHEEL_FIXES.get(result.state, ""))
