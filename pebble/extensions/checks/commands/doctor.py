"""``pebble doctor``: checks a machine and the robot on it, a robot that runs, or a broker; and packs a report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pebble.config import load
from pebble.config.hosts import is_loopback
from pebble.errors import PebbleError
from pebble.extensions.checks.commands.checks import Printer, is_clear
from pebble.extensions.checks.new_file import why_taken, write_new
from pebble.extensions.operator.client.connection import me
from pebble.extensions.operator.commands.options import CaCert, PasswordFile, RootOption
from pebble.extensions.operator.commands.target import broker_of
from pebble.extensions.operator.places import Places
from pebble.extensions.operator.signals import interrupted_by_signals
from pebble.runtime.environment import withhold
from pebble.transports import MqttSettings
from pebble.transports.topics import check_topic

_BELOW = "pebble/doctor"


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
    broker: Annotated[
        str | None,
        typer.Option("--broker", help="Judge this broker instead: mqtt://[USER@]HOST[:PORT].", metavar="URL"),
    ] = None,
    below: Annotated[
        str, typer.Option("--below", help="With --broker: topics below which the account may do all.", metavar="TOPIC")
    ] = _BELOW,
    restart: Annotated[
        bool, typer.Option("--restart", help="With --broker: ask to restart it, and see what is still retained.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead.")] = False,
    root: RootOption = Path("/"),
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Check that this machine is ready for the robot, or with --broker that a broker is fit for robots.

    Each problem is printed with a command that ends it, or with what to change or to look at. Exits 1 if a check fails,
    but not for warnings.

    With --running the robot is tested, end to end: on its own machine, as its user or root. Without --may-move no
    wheel turns. The robot is stopped for a moment, by an emergency stop that is ended by its name; not while a person
    or a script drives it, or another stop holds.

    A broker is tried for some 10 s on topics of its own, which are removed; no robot moves. Exits 1 if it has limits,
    2 if robots cannot use it.

    A report has config, findings, status, journal, units, slots, versions and devices. Every password and key that is
    known on this machine is hidden in it. Run it as root: it knows only what it may read.

    \b
        pebble doctor
        pebble doctor configs/goob.json
        pebble doctor configs/goob.json --running --may-move
        sudo pebble doctor --report goob.zip
        pebble doctor --broker mqtts://ann@broker.lab --password-file ann-password
    """
    modes = {"--running": running, "--report": report is not None, "--broker": broker is not None}
    _check_modes(modes, {"--may-move": may_move, "--root": root != Path("/")})
    if running:
        if config is None:
            raise typer.BadParameter("which robot is missing: name its config file")
        return _running(config, Places(root.absolute()), may_move=may_move, as_json=as_json)
    if report is not None:
        return _report(report, config, Places(root.absolute()))
    if broker is not None:
        if config is not None:
            raise PebbleError("--broker judges a broker alone: leave out the config file")
        return _broker(broker_of("--broker", broker, password_file, ca_cert), below, restart=restart, as_json=as_json)
    from pebble.extensions.checks.robot import run_checks  # of Linux only

    printer = Printer("CONFIG" if config is None else str(config), as_json=as_json)
    loaded = None if config is None else load(config)
    if loaded is not None:
        withhold(loaded.password_variables)
    for result in run_checks(loaded):
        printer.take(result)
    return printer.end()


#: By option: the modes that it goes with.
_WITH = {"--may-move": ("--running",), "--root": ("--running", "--report")}


def _check_modes(modes: dict[str, bool], options: dict[str, bool]) -> None:
    """Raise BadParameter for options that do not go together. Each is here by its name, with True if it is given."""
    chosen = [mode for mode, is_given in modes.items() if is_given]
    if len(chosen) > 1:
        raise typer.BadParameter(f"give {chosen[0]} or {chosen[1]}, not both")
    for option, is_given in options.items():
        if is_given and not any(mode in _WITH[option] for mode in chosen):
            raise typer.BadParameter(f"{option} is for {' and '.join(_WITH[option])} only")


# -- a robot that runs


def _running(config: Path, places: Places, *, may_move: bool, as_json: bool) -> int:
    """Test a robot that runs, with ``may_move`` also its wheels, if a person agrees; return the exit code."""
    from pebble.extensions.checks.check import run
    from pebble.extensions.checks.running.checks import CHECKS, MOVING  # of Linux only
    from pebble.extensions.checks.running.robot import become_user_of, reached

    loaded, printer = load(config), Printer(str(config), as_json=as_json)
    if may_move and not is_clear(loaded.robot.name or loaded.robot.id, "about 3 cm ahead and back, slowly"):
        return 1
    become_user_of(loaded.run_dir())
    with interrupted_by_signals(), reached(loaded, places, me()) as robot:
        for _, result in run((*CHECKS, *(MOVING if may_move else ())), robot, refresh=robot.read):
            printer.take(result)
    return printer.end()


# -- a report


def _report(file: Path, config: Path | None, places: Places) -> int:
    """Write the zip file; without a config it is about the installed robot."""
    from pebble.extensions.checks.report.report import make  # of Linux only

    if taken := why_taken(file, ".zip"):
        meant = f": pebble doctor {file} --report {file.with_suffix('.zip')}" if file.suffix == ".json" else ""
        raise typer.BadParameter(taken + meant)
    if config is not None and not config.exists():
        raise typer.BadParameter(f"{config} does not exist: name a robot's config file")
    report = make(places, None if config is None else config.absolute())
    write_new(file, report.packed())
    typer.echo(f"{file}: {', '.join(report.parts)}")
    for name, why in report.missing.items():
        typer.echo(f"missing: {name}: {why}")
    if report.unread:
        typer.echo(f"pebble: warning: passwords in {len(report.unread)} files are not known: use sudo", err=True)
    return 0


# -- a broker


def _broker(settings: MqttSettings, below: str, *, restart: bool, as_json: bool) -> int:
    """Print what is wrong with a broker, and what to type. Returns 0, 1 with limits, 2 if robots cannot use it."""
    from pebble.check_result import State
    from pebble.extensions.checks.broker.login import beyond_loopback, broker, own_addresses
    from pebble.extensions.checks.broker.login_attempt import reached
    from pebble.extensions.checks.broker.probes import assessment, judge

    check_topic(below)
    printer = Printer(as_json=as_json)
    with interrupted_by_signals():
        for result in broker("broker", settings):
            printer.take(result)
        states = dict.fromkeys(printer.names("failed"), State.FAILED)
        if not states:
            if is_loopback(settings.host):
                for result in beyond_loopback("broker", settings, own_addresses()):
                    printer.take(result)
            with reached(settings, below, _ask_to_restart if restart else None) as trial:
                for probe, result in judge(trial):
                    printer.take(result, probe.why)
                    states[probe.name] = result.state
            if trial.left:
                more = f" and {len(trial.left) - 1} more" if len(trial.left) > 1 else ""
                typer.echo(f"pebble: warning: still retained at the broker: {next(iter(trial.left))}{more}", err=True)
    words = assessment(states)
    if not as_json:
        for line in words:
            typer.secho(line, bold=True)
    code = printer.end(warnings_count=True, assessment=words)  # 1 for warnings, too: they are limits
    return 2 if printer.names("failed") else code


def _ask_to_restart() -> bool:
    typer.echo(
        "Restart the broker now (sudo systemctl restart mosquitto), then press Enter; q to go without: ", err=True
    )
    return sys.stdin.readline().isspace()  # an empty text, without a line end: standard input has no person
