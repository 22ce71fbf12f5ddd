"""``pebble doctor``: prints the findings of :mod:`pebble.doctor.checks`, or tests a robot that runs, or a broker."""

import shutil
import textwrap
from pathlib import Path
from typing import Annotated

import typer

from pebble.check_result import CheckResult, State
from pebble.commands.broker import BELOW, BelowOption, BrokerOption, RestartOption, doctor_of, settings_at
from pebble.commands.options import CaCert, PasswordFile, RootOption
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
    running: Annotated[bool, typer.Option("--running", help="Test the robot, which runs, instead.")] = False,
    may_move: Annotated[
        bool, typer.Option("--may-move", help="With --running: ask, then also turn the wheels a little.")
    ] = False,
    report: Annotated[
        Path | None,
        typer.Option(
            "--report", help="Pack what helps to find a fault, of CONFIG or the installed robot.", metavar="FILE.zip"
        ),
    ] = None,
    broker: BrokerOption = None,
    below: BelowOption = BELOW,
    restart: RestartOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --running or --broker: print JSON instead.")] = False,
    root: RootOption = Path("/"),
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Check that this machine is ready for the robot, or with --broker what robots have of a broker.

    Each problem is printed with the command that fixes it. Exits 1 if a check fails, but not for warnings.

    With --running the robot is tested, end to end: on its own machine, as its user or root. Without --may-move no
    wheel turns. The robot is stopped for a moment, by an emergency stop that is ended by its name; not while a person
    or a script drives it, or another stop holds.

    A broker is tried for some 10 s on topics of its own, which are removed; no robot moves. Exits 1 if it has limits,
    2 if robots cannot use it.

    A report has config, findings, status, journal, units, slots, versions and devices. Passwords and keys are masked;
    then every one that is known on this machine is searched for in it, and if one is found, nothing is written. Run it
    as root: it searches only for what it may read.

    \b
        pebble doctor
        pebble doctor configs/goob.json
        pebble doctor configs/goob.json --running --may-move
        sudo pebble doctor --report goob.zip
        pebble doctor --broker mqtts://ann@broker.lab --password-file ann-password
    """
    modes = {"--running": running, "--report": report is not None, "--broker": broker is not None}
    _check_modes(modes, {"--may-move": may_move, "--json": as_json, "--root": root != Path("/")})
    if running:
        from pebble.commands.selftest import selftest

        if config is None:
            raise typer.BadParameter("which robot is missing: name its config file")
        return selftest(config, root, may_move=may_move, as_json=as_json)
    if report is not None:
        from pebble.commands.report import report as write_report

        return write_report(report, config, root)
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


#: Options, and those that they go with.
_WITH = {"--may-move": ("--running",), "--json": ("--running", "--broker"), "--root": ("--running", "--report")}


def _check_modes(modes: dict[str, bool], options: dict[str, bool]) -> None:
    """Raises BadParameter for options that do not go together."""
    chosen = [mode for mode, is_given in modes.items() if is_given]
    if len(chosen) > 1:
        raise typer.BadParameter(f"give {chosen[0]} or {chosen[1]}, not both")
    for option, is_given in options.items():
        if is_given and not set(chosen) & set(_WITH[option]):
            raise typer.BadParameter(f"{option} is for {' and '.join(_WITH[option])} only")


def _print(finding: CheckResult) -> None:
    width = shutil.get_terminal_size().columns
    typer.secho(f"{finding.state[:4]:<4}  ", fg=_COLOURS[finding.state], nl=False)
    text = without_secrets(f"{finding.what}: {finding.text}")
    text = textwrap.fill(text, width, initial_indent=_INDENT, subsequent_indent=_INDENT)
    typer.echo(text.removeprefix(_INDENT))
    if finding.fix:  # always on one line: it is to be copied
        typer.secho(f"{_INDENT}fix: {without_secrets(finding.fix)}", bold=True)
