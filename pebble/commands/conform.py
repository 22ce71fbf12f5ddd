"""``pebble conform``: judges a robot, or a client that drives, of any maker, by the contract."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated

import typer

from pebble.check_result import State
from pebble.client.connection import Target, target_of
from pebble.client.names import base_of
from pebble.commands.broker import BELOW, BrokerOption, conform_of, settings_at
from pebble.commands.options import with_target
from pebble.commands.selftest import INDENT, is_clear, printed, row
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals

if TYPE_CHECKING:
    from pebble.conform.checks import Check, J

_LOOKS_S = 4.0  # heartbeats of one a second need so long
_STARTS_S = 10.0  # until a person has started a client


@with_target(program="conform")
def conform(
    robot: Annotated[
        str | None, typer.Argument(help="Its id, or SYSTEM/TYPE/ID.", metavar="ROBOT", show_default=False)
    ] = None,
    may_move: Annotated[bool, typer.Option("--may-move", help="Ask, then also turn its wheels.")] = False,
    cut: Annotated[
        bool,
        typer.Option("--cut", help="Ask to cut its power, and to switch it on again; with --broker: to restart it."),
    ] = False,
    operator: Annotated[bool, typer.Option("--operator", help="Judge a client that drives: ROBOT is played.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
    broker: BrokerOption = None,
    *,
    target: Target,
) -> int:
    """Judge a robot, in any language, by the contract: only by what it publishes and how it answers.

    Without --may-move no wheel turns; the robot is stopped and freed several times. With --operator pebble plays the
    robot, asks a person to use the client that drives it, and judges what that publishes. With --broker a broker is
    judged: which promises of a transport it keeps, and what a robot lacks where it does not; with ROBOT, too, on topics
    of that robot. Exits 1 if a check fails; each is printed with why it matters and what to change. What could not be
    judged, or was not asked for, is listed at the end: it is no pass, though the exit code is 0.

    \b
        pebble conform rover --url mqtt://broker.example
        pebble conform rover --url mqtt://broker.example --may-move --cut
        pebble conform played --operator --url mqtt://broker.example
        pebble conform --broker mqtt://broker.example
    """
    if broker is not None:
        below = BELOW if robot is None else base_of(robot)
        settings = settings_at(broker, target.password_file, target.ca_cert)
        return conform_of(settings, below, restart=cut, as_json=as_json)
    if robot is None:
        raise PebbleError("which robot is missing: use either ROBOT or --broker URL")
    options = target_of(robot, target)
    if operator and (may_move or cut):
        raise PebbleError("--operator judges no robot: leave out --may-move and --cut")
    with interrupted_by_signals():
        if operator:
            return _of_operator(options, as_json=as_json)
        if may_move and not is_clear(robot, "ahead for half a second, several times, and turn and go back once"):
            typer.echo("nothing was tested", err=True)
            return 1
        return _of_robot(options, may_move=may_move, cut=cut, as_json=as_json)


def _of_robot(options: Target, *, may_move: bool, cut: bool, as_json: bool) -> int:
    from pebble.conform.checks import CHECKS, LAST
    from pebble.conform.component import reached
    from pebble.conform.control import CONTROL
    from pebble.conform.motion import MOVING
    from pebble.conform.power import CUT

    with reached(options, _LOOKS_S) as component:
        if not component.records:
            raise PebbleError(f"nothing came from {component.base} within {_LOOKS_S:g} s: is it on, at this broker?")
        checks = (*CHECKS, *CONTROL, *(MOVING if may_move else ()), *LAST, *(CUT if cut else ()))
        found = _judged(component, checks, as_json=as_json)
        left = {
            option: of for option, of, wanted in (("--may-move", MOVING, may_move), ("--cut", CUT, cut)) if not wanted
        }
        unasked = {option: [one.name for one in of if one.binds(component)] for option, of in left.items()}
    return _ended(found, unasked, as_json=as_json, robot=component.base)


def _of_operator(options: Target, *, as_json: bool) -> int:
    from pebble.conform.operators import OPERATOR
    from pebble.conform.stand_in import played

    with played(options) as robot:
        robot.ask(f"{robot.base} is played here: start the client, let it drive this robot, and leave it alone")
        robot.look(_STARTS_S)
        found = _judged(robot, OPERATOR, as_json=as_json)
    return _ended(found, {}, as_json=as_json, played=robot.base)


def _ended(found: list[dict[str, str]], unasked: dict[str, list[str]], *, as_json: bool, **more: str) -> int:
    """Print the end of it, with what was not judged, so that no one takes that for a pass; returns the exit code.

    ``unasked``: the names of checks that were not made, by the option that asks for them.
    """
    names = {state: [one["name"] for one in found if one["state"] == state] for state in State}
    failures, skips = names[State.FAILED], names[State.SKIPPED]
    if as_json:
        not_judged = [*skips, *(name for of in unasked.values() for name in of)]
        end = {"ok": not failures, **more, "checks": found, "not_judged": not_judged}
        typer.echo(json.dumps(end, ensure_ascii=False))
        return 1 if failures else 0
    left = [*([", ".join(skips)] if skips else []), *(f"{len(of)} with {option}" for option, of in unasked.items())]
    typer.echo(
        f"{len(names[State.OK])} passed, {len(failures)} failed" + (f"; NOT JUDGED: {'; '.join(left)}" if left else "")
    )
    return 1 if failures else 0


def _judged(judged: J, checks: Iterable[Check[J]], *, as_json: bool) -> list[dict[str, str]]:
    """Make the checks; print each, unless all are printed at the end."""
    from pebble.conform.checks import run

    found: list[dict[str, str]] = []
    for check, outcome in run(judged, checks):
        found.append({**row(check.name, outcome), "why": check.why})
        if not as_json:
            printed(found[-1])
            if outcome.state is State.FAILED:
                typer.echo(f"{INDENT}why: {check.why}")
    return found
