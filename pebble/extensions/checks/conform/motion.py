"""Checks that turn wheels, judged by the motion that the robot reports. A person has agreed and is watching."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf
from typing import Any

import msgspec

from pebble import contract as c
from pebble.check_result import CheckResult, State, failed, ok, skipped
from pebble.extensions.checks.check import Check
from pebble.extensions.checks.conform.checks import (
    BY,
    END_IT,
    commanded,
    controls,
    drives,
    free,
    freed,
    reset,
    stop,
    stops,
)
from pebble.extensions.checks.conform.control import DRIVES_S, SPEED, STEP_S, UNSEEN, Driver, named
from pebble.extensions.checks.observer import ANSWER_S, Observer

RESTS_S = 0.75  # after the last command, at the latest
LATE_S = 0.5  # until a report of it is here
_ENDS_S = 0.25  # after a stop, or when another takes control
_SWING = 30  # of a hall sensor's value: less is noise
_HALF_TRACK_M = 0.25  # of wheels that are known by odometry: only their signs are judged
_OTHER_KEY, _OTHER_ACCOUNT = "0badf00d", "conform-other"
_NOT_SHOWN = skipped(
    "nothing that it publishes shows whether it moves",
    'publish {"value": {"wheels": [left, right]}} on outgoing/status whenever they change, touch-sensors or odometry',
)


def moves_until(robot: Observer, since: float) -> float | None:
    """Return when the last motion after ``since`` ended: inf while it lasts, 0 if none was seen.

    None: the robot reports no motion. It may report ``wheels`` in its status (published on change), readings of hall
    sensors, or speeds of its odometry.
    """
    reports = _wheel_reports(robot)
    readings = [(record.at, record.value.value) for record in robot.of(c.TOUCH_SENSORS) if record.value]
    odometry = _odometry_wheels(robot)
    if not reports and not readings and not odometry:
        return None
    moved_at = [*_swings(readings), *(at for at, wheels in odometry if any(wheels))]
    next_reports_at = [*(at for at, _ in reports[1:]), inf]
    for (_, wheels), until in zip(reports, next_reports_at, strict=False):  # a report holds until the next one
        if any(wheels):
            moved_at.append(until)
    return max((at for at in moved_at if at > since), default=0.0)


def _swings(readings: list[tuple[float, Any]]) -> Iterator[float]:
    """Yield the times at which a hall sensor's value changed by more than noise since the previous such change."""
    reference: tuple[int, ...] | None = None  # the values at the last change
    for at, sensors in readings:
        values = msgspec.structs.astuple(sensors)
        if reference is None:
            reference = values
        elif any(abs(value - before) > _SWING for value, before in zip(values, reference, strict=True)):
            yield at
            reference = values


def _wheel_reports(robot: Observer) -> list[tuple[float, list[float]]]:
    """Return the wheel speeds, each with its time: as seen from outside (``robot.eyes``), or else as reported."""
    reports = [(report.at, report.value.value.get("wheels")) for report in robot.of(c.STATUS) if report.value]
    return robot.eyes() or [(at, wheels) for at, wheels in reports if _are_speeds(wheels)]


def _odometry_wheels(robot: Observer) -> list[tuple[float, list[float]]]:
    """Return the odometry's speeds as those of a left and a right wheel (m/s), each with its time."""
    speeds = []
    for record in robot.of(c.WHEEL_ODOMETRY):
        value: dict[str, Any] = record.value.value if record.value else {}
        linear: Any = value.get("linear_speed_mps")
        angular: Any = value.get("angular_speed_radps")
        if _are_speeds([linear, angular]):  # rounded, so that less than 5 mm/s counts as rest
            ahead_mps, turn_mps = round(float(linear), 2), _HALF_TRACK_M * round(float(angular), 2)
            speeds.append((record.at, [ahead_mps - turn_mps, ahead_mps + turn_mps]))
    return speeds


def _moving_wheels(robot: Observer, since: float) -> list[float] | None:
    """Return the wheel speeds that the robot reports after ``since``: empty if it rests, None if it reports none."""

    def reports() -> list[tuple[float, list[float]]]:
        return _wheel_reports(robot) or _odometry_wheels(robot)

    def newest_moving() -> list[float]:
        return next((wheels for at, wheels in reversed(reports()) if at >= since and any(wheels)), [])

    robot.wait(newest_moving, ANSWER_S)
    robot.look(LATE_S)  # more reports may follow, and the newest counts
    return newest_moving() if reports() else None


def _are_speeds(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(isinstance(speed, int | float) for speed in value)


@contextmanager
def at_the_wheel(robot: Observer, by: str = BY, answer_s: float = ANSWER_S) -> Iterator[Driver]:
    """Yield a driver that takes control if it is free.

    The driver sends a zero first and last: after a reset, a robot moves only once the stick was at rest.
    """
    driver = Driver(robot, by)
    try:
        if robot.view.controlled:  # it decides itself who drives it
            driver.asks(for_ms=10_000)
            robot.answers(lambda: driver.holds, answer_s)
        if driver.may_drive:
            driver.send()
            robot.wait(lambda: moves_until(robot, time.monotonic()) != inf, ANSWER_S)  # inf: it still moves
        yield driver
    finally:
        if driver.may_drive:
            driver.send(valid_ms=0)  # a final zero: no script resumes after it
        driver.leaves()


def _driven(test: Callable[[Observer, Driver], CheckResult]) -> Callable[[Observer], CheckResult]:
    """Return a check that runs ``test`` with a driver that may drive."""

    def run(robot: Observer) -> CheckResult:
        with at_the_wheel(robot) as driver:
            return test(robot, driver)

    return run


def _rest(robot: Observer, began: float, last: float, limit_s: float, what: str = "the last command") -> CheckResult:
    """Wait until the robot must rest and its reports have come; then return what :func:`rested` finds."""
    robot.look(limit_s + LATE_S)
    return rested(robot, began, last, limit_s, what)


def rested(robot: Observer, began: float, last: float, limit_s: float, what: str = "the last command") -> CheckResult:
    """Check that a robot driven from ``began`` to ``last`` moved, and rested within ``limit_s`` after ``last``."""
    until = moves_until(robot, began)
    if until is None:
        return _NOT_SHOWN
    if until == 0.0:  # no motion was seen
        return failed("its commands do not move it", "drive by incoming/drive-values, live ones")
    if until > last + limit_s + LATE_S / 2:  # ``until`` is when a report arrived, a little after the motion
        shown = "still moves" if until == inf else f"moved for {until - last:.2f} s"
        return failed(f"it {shown} after {what}", f"stop {limit_s:g} s after {what}, at the latest")
    return ok(f"it rests {max(0.0, until - last):.2f} s after {what}")


def _not_moved(robot: Observer, since: float, why: str, fix: str) -> CheckResult:
    """Return ok if the robot has not moved after ``since``, else a failure."""
    robot.look(robot.patience_s)
    until = moves_until(robot, since)
    if until is None:
        return _NOT_SHOWN
    return failed(why, fix) if until > since else ok("it moves nothing")


def _dead_man(robot: Observer, driver: Driver) -> CheckResult:
    return _rest(robot, *driver.drive(), RESTS_S)


def _valid_ms(robot: Observer, driver: Driver) -> CheckResult:
    """Check commands that are valid for a short time, and for a longer time than a robot may accept."""
    outcome = _rest(robot, *driver.drive(valid_ms=150), 0.15)
    if outcome.state is not State.OK:
        return outcome
    last = _rest(robot, *driver.drive(0.2, valid_ms=4000), RESTS_S)
    return outcome if last.state is State.OK else failed(f"valid_ms 4000: {last.text}", last.fix)


def _zero(robot: Observer, driver: Driver) -> CheckResult:
    """Check that a zero with another key than the driver's stops the robot: a zero needs no key."""
    began, _ = driver.drive()
    return _rest(robot, began, driver.send(key=_OTHER_KEY), 0.1, "a zero with another key")


def _steering(robot: Observer, driver: Driver) -> CheckResult:
    """Check the signs of the left and the right wheel for three commands."""
    ways: tuple[tuple[dict[str, Any], tuple[int, int]], ...] = (
        ({"z": 0, "x": SPEED}, (1, -1)),
        ({"z": SPEED}, (1, 1)),
        ({"z": -SPEED, "wrapped": True}, (-1, -1)),
    )
    for fields, signs in ways:
        began, _ = driver.drive(DRIVES_S / 2, **fields)
        wheels = _moving_wheels(robot, began)
        if wheels is None:
            return _NOT_SHOWN
        are_right = len(wheels) > 1 and all(speed * sign > 0 for speed, sign in zip(wheels, signs, strict=False))
        if not are_right:
            sent = f"x {fields.get('x', 0):g}, z {fields['z']:g}"
            if "wrapped" in fields:
                sent += " within value"
            return failed(f"at {sent} its wheels do {wheels}", "left is z + x, right is z - x, also within value")
    return ok("x to the right, z ahead")


def _stop_moving(robot: Observer, driver: Driver) -> CheckResult:
    """Check that commands after a stop move nothing, also those of a new gesture."""
    began, _ = driver.drive()
    stopped_at = time.monotonic()
    stop(robot, secrets.token_hex(8))
    driver.drive()
    driver.send()  # a zero, which ends the gesture
    driver.drive(DRIVES_S / 2)
    outcome = _rest(robot, began, stopped_at, limit_s=_ENDS_S, what="the stop")
    return outcome if freed(robot) else failed("a reset does not end the stop", END_IT)


def _reset_waits(robot: Observer, driver: Driver) -> CheckResult:
    """Check that a stick held down over a reset moves nothing until released; another client's zero is no release."""
    stop(robot, secrets.token_hex(8))
    began, _ = driver.drive(2 * STEP_S)  # from before the reset on: a pause would count as a release
    reset(robot)
    driver.drive(DRIVES_S / 2)
    if robot.view.controlled:  # this robot gives keys, so it knows whose zero it receives
        driver.send(key=_OTHER_KEY)  # another client's zero
    driver.drive()
    why = "a stick that is held down moves it after a reset"
    outcome = _not_moved(robot, began, why, "wait for a zero of who has control, or for 0.5 s without commands")
    if outcome.state is State.OK:
        driver.send()  # the zero that counts as a release
        outcome = _rest(robot, *driver.drive(), RESTS_S)  # now it must move, and rest afterwards
    is_free = robot.wait(lambda: not robot.view.latched, ANSWER_S)
    return outcome if is_free else failed("a reset does not end the stop", END_IT)


def _not_a_number(robot: Observer, _driver: Driver) -> CheckResult:
    began = time.monotonic()
    for number in (b"NaN", b"Infinity", b"1e999", b'"nan"', b"null"):
        robot.send(c.DRIVE, b'{"x": 0, "z": %s}' % number)
    return _not_moved(robot, began, "it moves by a command that is no number", "refuse NaN and infinity")


def _clamped(robot: Observer, driver: Driver) -> CheckResult:
    """Check that no wheel gets more than full power by axes beyond -1..1."""
    began, _ = driver.drive(DRIVES_S / 2, z=9, x=-9)
    wheels = _moving_wheels(robot, began)
    if wheels is None or not _wheel_reports(robot):  # speeds by odometry are good for their signs only
        return _NOT_SHOWN
    if not wheels:
        return failed("x -9, z 9 does not move it", "clamp both axes to -1..1, and obey")
    largest = max(map(abs, wheels))
    if largest > 1.0:
        return failed(f"a wheel got {largest:g}", "clamp both axes to -1..1, and the sum of them for each wheel")
    return ok(f"{largest:g} at most")


def _foreign_key(robot: Observer, driver: Driver) -> CheckResult:
    """Check that commands with another's key move nothing, while someone has control and while nobody has."""
    why, fix = "it moves by another's key", "refuse what moves and has another key"
    began, _ = driver.drive(key=_OTHER_KEY)
    outcome = _not_moved(robot, began, why, fix)
    if outcome.state is not State.OK:
        return outcome
    driver.leaves()
    began, _ = driver.drive(DRIVES_S / 2, key=_OTHER_KEY)
    return _not_moved(robot, began, f"{why} while no one has control", fix)


def _control_passes(robot: Observer, driver: Driver) -> CheckResult:
    """Check that the robot rests once another takes control, although the former driver goes on with its key."""
    began, _ = driver.drive()
    key, second = driver.key, Driver(robot)
    taken_at = second.takes()
    robot.answers(lambda: second.holds)
    driver.drive(key=key)
    outcome = _rest(robot, began, taken_at, limit_s=_ENDS_S, what="another took control")
    second.leaves()
    return outcome


def _keyless(robot: Observer, driver: Driver) -> CheckResult:
    began, _ = driver.drive(key="")
    return _not_moved(robot, began, "it moves by a command without a key", "at level named refuse those")


def _foreign_account(robot: Observer, driver: Driver) -> CheckResult:
    """Check that the right key moves nothing if it is sent by another account, or by none."""
    command = msgspec.json.encode({"x": 0, "z": SPEED, "key": driver.key})
    began = time.monotonic()
    delivered = [robot.send_as(account, c.DRIVE, command) for account in (_OTHER_ACCOUNT, "")]
    fix = "a key counts with the account that asked for it"
    outcome = _not_moved(robot, began, "it moves by a key that another sends", fix)
    if outcome.state is not State.FAILED and not all(delivered):
        return skipped(UNSEEN)
    return outcome


_MOVES = (drives, free, commanded)
_BY_TURNS = (*_MOVES, controls)

MOVING: tuple[Check[Observer], ...] = (
    Check("dead man", _driven(_dead_man), _MOVES, "a driver may vanish at any moment"),
    Check("validity", _driven(_valid_ms), _MOVES, "a command tells how long it counts, but never long"),
    Check("zero", _driven(_zero), _MOVES, "who lets go expects it to stop at once, and anyone may halt it"),
    Check("steering", _driven(_steering), _MOVES, "a person must know where it will go"),
    Check("no number", _driven(_not_a_number), _MOVES, "a speed that is no number must not be one"),
    Check("clamps", _driven(_clamped), _MOVES, "motors get no more than everything"),
    Check("foreign key", _driven(_foreign_key), _BY_TURNS, "who had control before must not drive on"),
    Check("control passes", _driven(_control_passes), _BY_TURNS, "the next driver must not get a robot that moves"),
    Check("stop moving", _driven(_stop_moving), (*_MOVES, stops), "a stopped robot does not move, whatever is sent"),
    Check("reset waits", _driven(_reset_waits), (*_MOVES, stops), "who resets must not be surprised by a stick"),
    Check("keyless", _driven(_keyless), _BY_TURNS, "where names are checked, who drives is known", binds=named),
    Check("foreign account", _driven(_foreign_account), _BY_TURNS, "a key can be read by all", binds=named),
)
