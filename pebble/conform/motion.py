"""Checks that turn wheels, as far as the robot shows them. A person has agreed, and looks on."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec

from pebble import contract as c
from pebble.check_result import CheckResult
from pebble.conform.checks import ANSWER_S, Check, Driver, commanded, drives, free, stops
from pebble.conform.component import Component
from pebble.contract.payloads import EstopCommand, EstopReset
from pebble.selftest import failed, ok, skipped

SPEED = 0.2
DRIVES_S = 0.6
RESTS_S = 0.75  # after the last command, at the latest
_LATE_S = 0.5  # until a report of it is here
_STEP_S = 0.05
_SWING = 30  # of a hall sensor's value: less is noise
_UNSEEN = "nothing that it publishes shows whether it moves"
_SHOW_IT = 'publish {"value": {"wheels": [left, right]}} on outgoing/status whenever they change, or touch-sensors'


def moves_until(component: Component, since: float) -> float | None:
    """When the last motion after ``since`` ended, infinite while it lasts, 0 without any; None: nothing shows it.

    Shown by ``wheels`` in the status, which is published on change, or by readings of hall sensors.
    """
    reports = [(one.at, _wheels(one.value)) for one in component.of(c.STATUS) if one.value is not None]
    turning = [(at, any(wheels)) for at, wheels in reports if wheels is not None]
    touches = [(one.at, msgspec.structs.astuple(one.value.value)) for one in component.of(c.TOUCH_SENSORS) if one.value]
    if not turning and not touches:
        return None
    last, level = 0.0, touches[0][1] if touches else ()
    for index, (_, moving) in enumerate(turning):
        end = turning[index + 1][0] if index + 1 < len(turning) else float("inf")
        if moving and end > since:
            last = end
    for at, values in touches:
        if any(abs(value - before) > _SWING for value, before in zip(values, level, strict=True)):
            level = values
            last = max(last, at) if at > since else last
    return last


def _wheels(status: Any) -> list[float] | None:
    found = status.value.get("wheels")
    is_list = isinstance(found, list) and all(isinstance(one, int | float) for one in found)
    return found if is_list else None


@contextmanager
def _at_the_wheel(component: Component) -> Iterator[Callable[..., float]]:
    """A function that sends one drive command, with the key of control where the robot has one; zero at the end."""
    driver = Driver(component)

    def send(z: object = SPEED, **fields: object) -> float:
        key = {"key": driver.key} if driver.holds else {}
        return component.send(c.DRIVE, msgspec.json.encode({"x": 0, "z": z, **key, **fields}))

    if component.view.controlled:
        driver.asks(for_ms=10_000)
        component.wait(lambda: driver.holds, ANSWER_S)
    send(0)  # after a reset a robot waits for one
    component.wait(lambda: moves_until(component, time.monotonic()) != float("inf"), ANSWER_S)
    try:
        yield send
    finally:
        send(0)
        driver.asks("release")
        component.wait(lambda: not driver.holds, ANSWER_S)


def _drive(component: Component, send: Callable[..., float], **fields: object) -> tuple[float, float]:
    """Drive for a moment; when the first and the last command left."""
    began = last = time.monotonic()
    while time.monotonic() < began + DRIVES_S:
        last = send(**fields)
        component.look(_STEP_S)
    return began, last


def _rest(component: Component, began: float, last: float, limit_s: float) -> CheckResult:
    component.look(limit_s + _LATE_S)
    until = moves_until(component, began)
    if until is None:
        return skipped(_UNSEEN, _SHOW_IT)
    if until == 0.0:
        return failed(f"z {SPEED} for {DRIVES_S} s does not move it", "drive by incoming/drive-values, live ones")
    if until > last + limit_s + _LATE_S / 2:
        shown = "still moves" if until == float("inf") else f"moved for {until - last:.2f} s"
        return failed(f"it {shown} after the last command", f"stop {limit_s:g} s after the last drive command")
    return ok(f"it rests {max(0.0, until - last):.2f} s after the last command")


def dead_man(component: Component) -> CheckResult:
    with _at_the_wheel(component) as send:
        return _rest(component, *_drive(component, send), RESTS_S)


def valid_ms(component: Component) -> CheckResult:
    with _at_the_wheel(component) as send:
        return _rest(component, *_drive(component, send, valid_ms=150), 0.15)


def zero(component: Component) -> CheckResult:
    with _at_the_wheel(component) as send:
        began, _ = _drive(component, send)
        return _rest(component, began, send(0), 0.1)


def stop_moving(component: Component) -> CheckResult:
    """Commands go on, and move nothing."""
    with _at_the_wheel(component) as send:
        began, _ = _drive(component, send)
        name = secrets.token_hex(8)
        at = component.send(c.ESTOP, EstopCommand(stop=name, by="conform", why="conformance test"))
        _drive(component, send)
        outcome = _rest(component, began, at, 0.25)
    for state in component.view.estop.states.values():
        component.send(c.ESTOP_RESET, EstopReset(boot=state.boot, count=state.count, by="conform"))
    is_free = component.wait(lambda: not component.view.latched, ANSWER_S)
    return outcome if is_free else failed("a reset does not end the stop", "end it on incoming/estop-reset")


def _moves_nothing(why: str, fix: str, **fields: object) -> Callable[[Component], CheckResult]:
    def run(component: Component) -> CheckResult:
        with _at_the_wheel(component) as send:
            began, _ = _drive(component, send, **fields)
            component.look(_LATE_S)
            until = moves_until(component, began)
        if until is None:
            return skipped(_UNSEEN, _SHOW_IT)
        return failed(why, fix) if until > began else ok("it moves nothing")

    return run


def not_a_number(component: Component) -> CheckResult:
    with _at_the_wheel(component):
        began = time.monotonic()
        for number in (b"NaN", b"Infinity", b"1e999", b'"nan"', b"null"):
            component.send(c.DRIVE, b'{"x": 0, "z": %s}' % number)
        component.look(_LATE_S)
        until = moves_until(component, began)
    if until is None:
        return skipped(_UNSEEN, _SHOW_IT)
    return failed("it moves by a command that is no number", "refuse NaN and infinity") if until > began else ok("no")


def clamped(component: Component) -> CheckResult:
    with _at_the_wheel(component) as send:
        began = time.monotonic()
        send(9, x=-9, valid_ms=150)
        component.look(_LATE_S)
        shown = [_wheels(one.value) for one in component.of(c.STATUS, began) if one.value is not None]
    wheels = [abs(one) for values in shown for one in values or ()]
    if not wheels:
        return skipped("its status has no wheels", _SHOW_IT)
    if max(wheels) > 1.0:
        return failed(f"a wheel got {max(wheels):g}", "clamp both axes to -1..1, and the sum of them for each wheel")
    return ok(f"{max(wheels):g} at most")


def _foreign(component: Component) -> str:
    return "" if component.view.controlled else "its capabilities offer no control"


_MOVES = (drives, free, commanded)

MOVING: tuple[Check[Component], ...] = (
    Check("dead man", "a driver may vanish at any moment", dead_man, _MOVES),
    Check("validity", "a command tells how long it counts", valid_ms, _MOVES),
    Check("zero", "who lets go expects it to stop at once", zero, _MOVES),
    Check("no number", "a speed that is no number must not be one", not_a_number, _MOVES),
    Check("clamps", "motors get no more than everything", clamped, _MOVES),
    Check(
        "foreign key",
        "who had control before must not drive on",
        _moves_nothing("it moves by another's key", "refuse what moves and has another key", key="0badf00d"),
        (*_MOVES, _foreign),
    ),
    Check("stop moving", "a stopped robot does not move, whatever is sent", stop_moving, (*_MOVES, stops)),
)
