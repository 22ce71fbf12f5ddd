"""``pebble doctor --running``: tests a robot that runs, end to end."""

import json
import shlex
import sys
import textwrap
from pathlib import Path
from typing import Any

import typer

from pebble.check_result import CheckResult, State
from pebble.commands.estop import me
from pebble.config import load
from pebble.config.secret_text import without_secrets
from pebble.config.visible import shown
from pebble.runtime.signals import interrupted_by_signals
from pebble.setup.places import Places

_COLOURS = {State.OK: typer.colors.GREEN, State.FAILED: typer.colors.RED, State.SKIPPED: typer.colors.YELLOW}
INDENT = " " * 9


def selftest(config: Path, root: Path, *, may_move: bool, as_json: bool) -> int:
    """Print each check with what ends its failure; returns 1 if one failed."""
    from pebble.selftest.checks import CHECKS, MOVING, run  # of Linux only
    from pebble.selftest.robot import become_user_of, reached

    loaded = load(config)
    found: list[dict[str, str]] = []
    if may_move and not is_clear(loaded.robot.name or loaded.robot.id, "about 3 cm ahead and back, slowly"):
        typer.echo("nothing was tested", err=True)
        return 1
    become_user_of(loaded.run_dir())
    with interrupted_by_signals(), reached(loaded, Places(root.absolute()), me()) as robot:
        for check, outcome in run(robot, (*CHECKS, *(MOVING if may_move else ()))):
            found.append(row(check.name, outcome, str(config)))
            if not as_json:
                printed(found[-1])
        if dropped := sum(side.dropped for side in robot.sides):
            typer.echo(f"pebble: warning: {dropped} messages came too fast to be read", err=True)
    return ended(found, as_json=as_json)


def ended(found: list[dict[str, str]], *, as_json: bool, **more: str) -> int:
    """Print the end of a table of checks, or all of it as JSON; returns the exit code."""
    states = [one["state"] for one in found]
    failures = states.count(State.FAILED)
    if as_json:
        typer.echo(json.dumps({"ok": not failures, **more, "checks": found}, ensure_ascii=False))
    else:
        typer.echo(f"checks: {len(found)}, failures: {failures}, skipped: {states.count(State.SKIPPED)}")
    return 1 if failures else 0


def is_clear(name: str, how: str) -> bool:
    """Whether a person answers that the robot may move. Standard output is for the result."""
    typer.echo(f"{shown(name)} will drive {how}.", err=True)
    typer.echo("Does it stand free, on the floor, with no person in its way? [y/N]: ", nl=False, err=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def row(name: str, outcome: CheckResult, config: str = "CONFIG") -> dict[str, str]:
    """One check for JSON: texts come from the robot, and fixes name this config."""
    text, fix = (
        shown(without_secrets(one)) for one in (outcome.text, outcome.fix.replace("CONFIG", shlex.quote(config)))
    )
    return {"name": name, "state": outcome.state.value, "text": text, "fix": fix}


def printed(one: dict[str, Any]) -> None:
    state = State(one["state"])
    because = "skipped because " if state is State.SKIPPED else ""
    typer.secho(f"{state.value:<7}  ", fg=_COLOURS[state], nl=False)
    text = textwrap.fill(f"{one['name']}: {because}{one['text']}", 100, initial_indent=INDENT, subsequent_indent=INDENT)
    typer.echo(text.removeprefix(INDENT))
    if one["fix"]:  # always on one line: it is to be copied
        typer.secho(f"{INDENT}fix: {one['fix']}", bold=True)
