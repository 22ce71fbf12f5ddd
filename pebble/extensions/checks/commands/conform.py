"""``pebble conform``: judges a robot of any maker by the contract."""

from __future__ import annotations

from typing import Annotated

import typer

from pebble.errors import PebbleError
from pebble.extensions.checks.commands.checks import Printer, is_clear
from pebble.extensions.operator.client.connection import Target, target_of
from pebble.extensions.operator.commands.target import with_target
from pebble.extensions.operator.signals import interrupted_by_signals

_LOOKS_S = 4.0  # heartbeats of one a second need so long


@with_target(program="conform")
def conform(
    robot: Annotated[str, typer.Argument(help="Its id, or SYSTEM/TYPE/ID.", metavar="ROBOT", show_default=False)],
    may_move: Annotated[bool, typer.Option("--may-move", help="Ask, then also turn its wheels.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
    *,
    target: Target,
) -> int:
    """Judge a robot, in any language, by the contract: only by what it publishes and how it answers.

    Without --may-move no wheel turns; the robot is stopped and freed several times. Exits 1 if a check fails; each is
    printed with why it matters and what to change. What could not be judged, or was not asked for, is listed at the
    end: it is no pass, though the exit code is 0.

    \b
        pebble conform rover --url mqtt://broker.example
        pebble conform rover --url mqtt://broker.example --may-move
    """
    from pebble.extensions.checks.check import run
    from pebble.extensions.checks.conform.checks import CHECKS, LAST
    from pebble.extensions.checks.conform.control import CONTROL
    from pebble.extensions.checks.conform.motion import MOVING
    from pebble.extensions.checks.observer import observed

    options, printer = target_of(robot, target), Printer(as_json=as_json)
    with interrupted_by_signals():
        if may_move and not is_clear(robot, "ahead for half a second, several times, and turn and go back once"):
            return 1
        with observed(options, _LOOKS_S) as observer:
            if not observer.records:
                raise PebbleError(f"nothing came from {observer.base} within {_LOOKS_S:g} s: is it on, at this broker?")
            checks = (*CHECKS, *CONTROL, *(MOVING if may_move else ()), *LAST)
            for check, result in run(checks, observer, refresh=observer.read):
                printer.take(result, check.why)
            unasked = [] if may_move else [check.name for check in MOVING if check.binds(observer)]
    skips = printer.names("skipped")
    asked_for = f"{len(unasked)} with --may-move" if unasked else ""
    not_judged = "; ".join(filter(None, (", ".join(skips), asked_for)))
    if not_judged and not as_json:
        typer.echo(f"NOT JUDGED: {not_judged}")
    return printer.end(robot=observer.base, not_judged=[*skips, *unasked])
