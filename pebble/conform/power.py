"""Checks that need a person, or a test, to cut the robot's power and to switch it on again."""

from __future__ import annotations

import secrets

from pebble import contract as c
from pebble.conform.checks import ANSWER_S, Check, commanded, drives, free, stops
from pebble.conform.motion import moves_until
from pebble.conform.witness import Witness
from pebble.contract.payloads import EstopCommand, EstopReset
from pebble.selftest import Outcome, State, failed, ok, skipped

_LOOKS_S = 3.0


def will(witness: Witness) -> Outcome:
    began = witness.look(0.0)
    witness.ask("cut the robot's power now")
    if not witness.wait(lambda: _offline(witness, began), witness.person_s):
        fix = 'its will is outgoing/online {"t": <epoch ms>, "online": false}, retained'
        return failed("nothing tells that it is gone", fix)
    kept = [one for one in witness.kept() if one.channel is c.ONLINE]
    if not kept or kept[-1].value is None or kept[-1].value.online is not False:
        return failed("its will is not retained", "set the retain flag of the will")
    return ok("its will came")


def _offline(witness: Witness, since: float) -> bool:
    return any(one.value is not None and one.value.online is False for one in witness.of(c.ONLINE, since))


def retained_commands(witness: Witness) -> Outcome:
    """What a broker keeps is delivered when it starts: a drive command, and a stop."""
    commands = {c.DRIVE: b'{"x": 0, "z": 0.2}', c.ESTOP: b'{"stop": "00000000000000ff", "by": "conform"}'}
    for channel, payload in commands.items():
        witness.retain(channel, payload)
    since = witness.look(0.0)
    try:
        if why := _back(witness):
            return failed(why, "connect again by itself after a start")
        witness.look(_LOOKS_S)
        if witness.view.latched:
            return failed("it stops by a retained stop", "ignore messages with the retain flag on incoming/estop")
        until = moves_until(witness, since)
        if until is not None and until > since:
            return failed("it drives by a retained command", "ignore messages with the retain flag on incoming/")
    finally:
        for channel in commands:
            witness.retain(channel, b"")
    return ok("it ignores them") if until is not None else skipped("it ignores a stop; its wheels are not shown")


def _back(witness: Witness) -> str:
    began = witness.look(0.0)
    witness.ask("switch it on again")
    here = witness.wait(
        lambda: [one for one in witness.of(c.ONLINE, began) if one.value.online is not False], witness.person_s
    )
    return "" if here else f"it is not back within {witness.person_s:g} s"


def survives(witness: Witness) -> Outcome:
    """A stop outlives a power cut where its owner says that it is saved."""
    name = secrets.token_hex(8)
    witness.send(c.ESTOP, EstopCommand(stop=name, by="conform", why="conformance test"))
    witness.wait(lambda: witness.view.latched, ANSWER_S)
    states = witness.view.estop.states
    saved = bool(states) and all(one.persisted is True for one in states.values())
    boots = {one.boot for one in states.values()}
    if saved:
        witness.ask("cut the robot's power for a moment")
        witness.wait(
            lambda: {one.boot for one in witness.view.estop.states.values()}.isdisjoint(boots), witness.person_s
        )
        witness.look(ANSWER_S)
    outcome = (
        ok("it starts stopped") if witness.view.latched else failed("it is free after a power cut", "save the stop")
    )
    for one in witness.view.estop.states.values():
        witness.send(c.ESTOP_RESET, EstopReset(boot=one.boot, count=one.count, by="conform"))
    if not witness.wait(lambda: not witness.view.latched, ANSWER_S) and outcome.state is State.OK:
        return failed("a reset does not end the stop after a power cut", "publish the new boot, and reset by it")
    return outcome if saved else skipped("its state does not claim that it is saved")


CUT = (
    Check("will", "a robot that is gone must not look as if it were there", will),
    Check("retained commands", "a parked command must move nothing when it starts", retained_commands, (drives,)),
    Check(
        "stop survives", "a stop must outlive a power cut, or say that it does not", survives, (stops, free, commanded)
    ),
)
