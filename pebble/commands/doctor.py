"""``pebble doctor``: prints the findings of :mod:`pebble.doctor.checks`."""

import shutil
import textwrap
from pathlib import Path
from typing import Annotated

import typer

from pebble.check_result import CheckResult, State
from pebble.commands.broker import BELOW, BelowOption, BrokerOption, RestartOption, doctor_of, settings_at
from pebble.commands.options import CaCert, PasswordFile
from pebble.config import load
from pebble.config.secret_text import without_secrets
from pebble.errors import PebbleError
from pebble.runtime.environment import withhold

_COLOURS = {
    State.OK: typer.colors.GREEN,
    State.WARN: typer.colors.YELLOW,
    State.FAILED: typer.colors.RED,
    State.SKIPPED: typer.colors.BLUE,
}
_INDENT = " " * 6


def doctor(
    config: Annotated[
        Path | None, typer.Argument(help="Also check what this robot needs.", metavar="CONFIG", show_default=False)
    ] = None,
    broker: BrokerOption = None,
    below: BelowOption = BELOW,
    restart: RestartOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --broker: print one JSON object instead.")] = False,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Check that this machine is ready for the robot, or with --broker what robots have of a broker.

    Each problem is printed with the command that fixes it. Exits 1 if a check fails, but not for warnings.

    A broker is tried for some 10 s on topics of its own, which are removed; no robot moves. Exits 1 if it has limits,
    2 if robots cannot use it.

    \b
        pebble doctor
        pebble doctor configs/goob.json
        pebble doctor --broker mqtts://ann@broker.lab --password-file ann-password
    """
    if broker is not None:
        if config is not None:
            raise PebbleError("--broker judges a broker alone: leave out the config file")
        settings = settings_at(broker, password_file, ca_cert)
        return doctor_of(settings, below, restart=restart, as_json=as_json, show=_print)
    from pebble.doctor.checks import run_checks  # of Linux only

    counts = dict.fromkeys(_COLOURS, 0)
    loaded = None if config is None else load(config)
    if loaded is not None:
        withhold(loaded.password_variables)
    for finding in run_checks(loaded):
        counts[finding.state] += 1
        _print(finding)
    failed, warned = counts[State.FAILED], counts[State.WARN]
    typer.echo(f"checks: {sum(counts.values())}, warnings: {warned}, failures: {failed}")
    return 1 if failed else 0


def _print(finding: CheckResult) -> None:
    width = shutil.get_terminal_size().columns
    typer.secho(f"{finding.state[:4]:<4}  ", fg=_COLOURS[finding.state], nl=False)
    text = without_secrets(f"{finding.what}: {finding.text}")
    text = textwrap.fill(text, width, initial_indent=_INDENT, subsequent_indent=_INDENT)
    typer.echo(text.removeprefix(_INDENT))
    if finding.fix:  # always on one line: it is to be copied
        typer.secho(f"{_INDENT}fix: {without_secrets(finding.fix)}", bold=True)
