"""Checks that need a person, or a test, to cut the robot's power and to switch it on again."""

from __future__ import annotations

import secrets

from pebble import contract as c
from pebble.check_result import CheckResult, State
from pebble.conform.checks import Check, commanded, drives, free, freed, stop, stops
from pebble.conform.component import ANSWER_S, Component
from pebble.conform.motion import moves_until
from pebble.selftest import failed, ok, skipped

_LOOKS_S = 3.0


def will(component: Component) -> CheckResult:
    began = component.look(0.0)
    component.ask("cut the robot's power now")
    if not component.wait(lambda: _offline(component, began), component.person_s):
        fix = 'its will is outgoing/online {"t": <epoch ms>, "online": false}, retained'
        return failed("nothing tells that it is gone", fix)
    found = [one for one in component.retained() if one.channel is c.ONLINE]
    if not found or found[-1].value is None or found[-1].value.online is not False:
        return failed("its will is not retained", "set the retain flag of the will")
    return ok("its will came")


def _offline(component: Component, since: float) -> bool:
    return any(one.value is not None and one.value.online is False for one in component.of(c.ONLINE, since))


def retained_commands(component: Component) -> CheckResult:
    """What a broker keeps is delivered when it starts: a drive command, and a stop."""
    commands = {c.DRIVE: b'{"x": 0, "z": 0.4}', c.ESTOP: b'{"stop": "00000000000000ff", "by": "conform"}'}
    for channel, payload in commands.items():
        component.retain(channel, payload)
    since = component.look(0.0)
    try:
        if why := _back(component):
            return failed(why, "connect again by itself after a start")
        component.look(_LOOKS_S)
        if component.view.latched:
            return failed("it stops by a retained stop", "ignore messages with the retain flag on incoming/estop")
        until = moves_until(component, since)
        if until is not None and until > since:
            return failed("it drives by a retained command", "ignore messages with the retain flag on incoming/")
    finally:
        for channel in commands:
            component.retain(channel, b"")
    return ok("it ignores them") if until is not None else skipped("it ignores a stop; its wheels are not shown")


def _back(component: Component) -> str:
    began = component.look(0.0)
    component.ask("switch it on again")
    here = component.wait(
        lambda: [one for one in component.of(c.ONLINE, began) if one.value.online is not False], component.person_s
    )
    return "" if here else f"it is not back within {component.person_s:g} s"


def survives(component: Component) -> CheckResult:
    """A stop outlives a power cut where its owner says that it is saved."""
    name = secrets.token_hex(8)
    stop(component, name)
    states = component.view.estop.states
    saved = bool(states) and all(one.persisted is True for one in states.values())
    boots = {one.boot for one in states.values()}
    if saved:
        component.ask("cut the robot's power for a moment")
        component.wait(
            lambda: {one.boot for one in component.view.estop.states.values()}.isdisjoint(boots), component.person_s
        )
        component.look(ANSWER_S)
    outcome = (
        ok("it starts stopped") if component.view.latched else failed("it is free after a power cut", "save the stop")
    )
    if not freed(component) and outcome.state is State.OK:
        return failed("a reset does not end the stop after a power cut", "publish the new boot, and reset by it")
    return outcome if saved else skipped("its state does not claim that it is saved")


CUT: tuple[Check[Component], ...] = (
    Check("will", "a robot that is gone must not look as if it were there", will, once=True),
    Check(
        "retained commands",
        "a parked command must move nothing when it starts",
        retained_commands,
        (drives,),
        once=True,
    ),
    Check(
        "stop survives",
        "a stop must outlive a power cut, or say that it does not",
        survives,
        (stops, free, commanded),
        once=True,
    ),
)
