"""``pebble conform``: judges a robot, of any maker, by the contract."""

from __future__ import annotations

from typing import Annotated

import typer

from pebble.check_result import State
from pebble.client.connection import Target, target_of
from pebble.client.names import base_of
from pebble.commands.broker import BELOW, BrokerOption, conform_of, settings_at
from pebble.commands.options import with_target
from pebble.commands.selftest import INDENT, ended, is_clear, printed, row
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals

_LOOKS_S = 4.0  # heartbeats of one a second need so long


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
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
    broker: BrokerOption = None,
    *,
    target: Target,
) -> int:
    """Judge a robot, in any language, by the contract: only by what it publishes and how it answers.

    Without --may-move no wheel turns; the robot is stopped and freed several times. Exits 1 if a check fails; each is
    printed with why it matters and what to change. With --broker a broker is judged: which promises of a transport it
    keeps, and what a robot lacks where it does not; with ROBOT, too, on topics of that robot.

    \b
        pebble conform rover --url mqtt://broker.example
        pebble conform rover --url mqtt://broker.example --may-move --cut
        pebble conform --broker mqtt://broker.example
    """
    if broker is not None:
        below = BELOW if robot is None else base_of(robot)
        settings = settings_at(broker, target.password_file, target.ca_cert)
        return conform_of(settings, below, restart=cut, as_json=as_json)
    if robot is None:
        raise PebbleError("which robot is missing: use either ROBOT or --broker URL")
    from pebble.conform.checks import CHECKS, run
    from pebble.conform.component import reached
    from pebble.conform.motion import MOVING
    from pebble.conform.power import CUT

    options = target_of(robot, target)
    found: list[dict[str, str]] = []
    if may_move and not is_clear(robot, "ahead for half a second, several times, and turn once"):
        typer.echo("nothing was tested", err=True)
        return 1
    with interrupted_by_signals(), reached(options, _LOOKS_S) as component:
        if not component.records:
            raise PebbleError(f"nothing came from {component.base} within {_LOOKS_S:g} s: is it on, at this broker?")
        for check, outcome in run(component, (*CHECKS, *(MOVING if may_move else ()), *(CUT if cut else ()))):
            found.append({**row(check.name, outcome), "why": check.why})
            if not as_json:
                printed(found[-1])
                if outcome.state is State.FAILED:
                    typer.echo(f"{INDENT}why: {check.why}")
    return ended(found, as_json=as_json, robot=component.base)
