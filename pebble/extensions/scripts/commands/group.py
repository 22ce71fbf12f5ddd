"""``pebble script``: writes a new script, and lists, starts and stops those of a robot."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.contract.identity import meant
from pebble.contract.payloads import AutonomyStatus
from pebble.errors import PebbleError, TransportError
from pebble.extensions.operator.client import forms
from pebble.extensions.operator.client.connection import Target, connected, put_account_into_topics, target_of, wait_for
from pebble.extensions.operator.client.driveable import doubt_of
from pebble.extensions.operator.client.names import id_of
from pebble.extensions.operator.client.scripts import RobotScripts, options_of
from pebble.extensions.operator.commands.options import RobotArgument
from pebble.extensions.operator.commands.target import with_target
from pebble.transports import Transport

_HELP = """Programs that move a robot by themselves; docs/ext/scripts.md explains them.

\b
    pebble script new follow            write a first script and its test
    pebble script list goob.json        what the robot offers, and what runs
    pebble script start goob.json follow --tag-id 7
    pebble script stop goob.json
"""
_FIRST_SECOND_S = 1.0  # most mistakes in a script end it within that
_SAME_ERROR_S = 1.0  # an error that was there before the command is the answer to it, too, if it stays


def new(
    name: Annotated[str, typer.Argument(help="Of the script and its folder.", metavar="NAME", show_default=False)],
    folder: Annotated[Path, typer.Option("--folder", help="Where its folder is made.", metavar="DIR")] = Path(),
) -> None:
    """Write a script that follows a tag, a test that runs it in a simulated room, and a robot for that room.

    \b
        pebble script new follow
        cd follow
        python -m pytest
    """
    from pebble.extensions.scripts.commands.new import write

    for path in write(name, folder):
        typer.echo(path)


@with_target()
def list_(robot: RobotArgument, *, target: Target) -> int:
    """List the scripts that a robot offers, their options, what runs with which settings, and the last error."""
    with _scripts(robot, target) as (_, scripts, name):
        if scripts.files is None:
            raise PebbleError(f"{name} has published no scripts: is it up, and services.autonomy_manager.enabled true?")
        for file, entry in scripts.files.items():
            label = str(entry.get("label") or file)
            _print(file if label == file else f"{file}: {label}")
            for setting in forms.listed(entry.get("configs")):
                _print(f"    {_option(setting)}")
        if scripts.status is not None:
            _print_status(scripts.status, scripts)
    return 0


@with_target()
def start(
    context: typer.Context,
    robot: RobotArgument,
    file: Annotated[
        str, typer.Argument(help="The script; its own options follow.", metavar="SCRIPT", show_default=False)
    ] = "",
    *,
    target: Target,
) -> int:
    """Start a script on its robot, and wait until it has run for a second. A script that runs already is stopped first.

    \b
        pebble script start goob.json follow --tag-id 7 --distance-m 0.5
    """
    if not file or file.startswith("-"):
        raise PebbleError(f'which script? see "pebble script list {robot}"')
    with _scripts(robot, target) as (transport, scripts, _):
        try:
            file = meant(scripts.files or (), file)
        except PebbleError as error:
            raise PebbleError(f"{shown(file)}: {error}") from None
        before, answers_before, began = scripts.status, scripts.answers, time.monotonic()
        _require_sent(transport, scripts.start(transport, file, context.args))

        def is_answered() -> bool:
            elapsed_s = time.monotonic() - began
            return scripts.answers > answers_before and _is_answer(before, scripts.status, file, elapsed_s)

        wait_for(is_answered, scripts.answer_s)
        status = scripts.status
        if scripts.answers == answers_before or status is None:  # none came; `_runs` judges one that did
            raise PebbleError(f"no answer within {scripts.answer_s:g} s: is the robot up?")
        if not _runs(before, status, file):
            raise PebbleError(shown(status.error or f"{file} does not run"))
        _print_status(status, scripts)
        wait_for(lambda: _ended(scripts.status), _FIRST_SECOND_S)
        if scripts.status is not None and _ended(scripts.status) and scripts.status.error:
            raise PebbleError(shown(scripts.status.error))
    return 0


@with_target()
def stop(robot: RobotArgument, *, target: Target) -> int:
    """Stop the script that runs. In an emergency: pebble estop."""
    with _scripts(robot, target) as (transport, scripts, _):
        _require_sent(transport, scripts.stop(transport))
        wait_for(lambda: scripts.status is not None and not scripts.status.running, scripts.answer_s)
        if scripts.status is None or scripts.status.running:
            raise PebbleError(
                f"it is not known to have stopped within {scripts.answer_s:g} s: pebble estop stops the robot"
            )
        _print_status(scripts.status, scripts)
    return 0


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_HELP, rich_markup_mode=None)
    group.command("new", context_settings={"ignore_unknown_options": True})(new)  # else -x is not seen as a name
    group.command("list")(list_)
    group.command("start", context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(start)
    group.command("stop")(stop)
    app.add_typer(group, name="script")


@contextmanager
def _scripts(robot: str, target: Target) -> Iterator[tuple[Transport, RobotScripts, str]]:
    """Yield the connection, the robot's published scripts, and its name."""
    with connected(target_of(robot, target)) as (transport, names):
        scripts = RobotScripts(names)
        # Commands carry this client's account if the robot, as it says itself, requires names.
        put_account_into_topics(transport, names, lambda base: base == names.base and scripts.robot.named)
        scripts.subscribe(transport)
        wait_for(lambda: scripts.files is not None and scripts.status is not None, 1.0)
        yield transport, scripts, shown(id_of(names.base))


def _is_answer(before: AutonomyStatus | None, now: AutonomyStatus | None, file: str, elapsed_s: float) -> bool:
    """True if the newest status is the answer to a start: the script runs, or an error says why it does not."""
    if now is None:
        return False
    if _runs(before, now, file):
        return True
    is_new_error = before is None or now.error != before.error
    return bool(now.error) and (is_new_error or elapsed_s > _SAME_ERROR_S)  # an earlier error counts if it stays


def _runs(before: AutonomyStatus | None, now: AutonomyStatus, file: str) -> bool:
    """True if the script runs in another process than before."""
    as_before = before is not None and before.running and now.pid == before.pid
    return now.running and now.file == file and not as_before


def _ended(now: AutonomyStatus | None) -> bool:
    return now is not None and not now.running


def _require_sent(transport: Transport, accepted: bool) -> None:
    if not accepted:
        raise TransportError(f"nothing was sent: {transport.problem or 'the connection was lost'}")


def _print_status(status: AutonomyStatus, scripts: RobotScripts) -> None:
    if status.running:
        waits = ", but a person drives: it waits" if status.overridden is True else ""
        _print(f"{status.file} runs (process {status.pid}){waits}")
        for key, value in (status.config or {}).items():
            _print(f"    {key}: {value}")
        for other in status.dependencies:
            _print(f"    with {other.file}" + (f" (process {other.pid})" if other.running else ", which does not run"))
        if doubt := doubt_of(scripts.robot.driveable):
            _print(f"{scripts.robot.name}: {doubt}")
    else:
        _print("no script runs")
    if status.error:
        _print(f"error: {status.error}")


def _option(setting: forms.Setting) -> str:
    """Return an option's line, such as ``--tag-id INT  Tag ID (default: 13)``."""
    names: dict[bool | None, str] = {}  # the first option for each value of a flag; None: for other settings
    for option, value in options_of(setting):
        names.setdefault(value, option)
    usage = f"{names.get(None)} {setting.type.upper()}"
    if setting.type == "bool":
        usage = f"[{names[True]} | {names[False]}]"
    notes = []
    if setting.options:
        notes.append(", ".join(map(str, setting.options)))
    if setting.min is not None:
        notes.append(f"min {setting.min}")
    if setting.max is not None:
        notes.append(f"max {setting.max}")
    notes.append("required" if setting.required else f"default: {setting.default}")
    return f"{usage:32}  {setting.label or setting.key} ({'; '.join(notes)})"


def _print(line: str) -> None:
    typer.echo(shown(line))
