"""``pebble impair``: robots behind an impaired network."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer.core import TyperCommand

from pebble.bench import catalogue
from pebble.client.connection import Target
from pebble.commands.bench import command_of, with_parameters
from pebble.commands.options import CaCert, PasswordFile
from pebble.errors import PebbleError

if TYPE_CHECKING:
    from typer._click.core import Context, Parameter

_INTO: Final = Path("impair")
_SECONDS: Final = 120.0


def impair(
    context: typer.Context,
    *,
    robot: Annotated[
        str | None,
        typer.Option(help="Measure this real robot; the options below belong to it.", metavar="[SYSTEM/TYPE/]ID"),
    ] = None,
    url: Annotated[str | None, typer.Option(help="Its broker.", metavar="mqtt[s]://[USER@]HOST[:PORT]")] = None,
    label: Annotated[str | None, typer.Option(help="Name of the present limit, such as 512k.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Measure for this long. [default: 120]", min=1)] = None,
    no_media: Annotated[bool, typer.Option("--no-media", help="Request no pictures and no sound.")] = False,
    into: Annotated[Path | None, typer.Option(help="Folder of all labels. [default: impair]", metavar="DIR")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Delete what was measured with this label.")] = False,
    compare: Annotated[bool, typer.Option("--compare", help="Only print the table of all labels.")] = False,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
    **simulated: Any,
) -> int:
    """Robots behind an impaired network: the trials of the paper's section 4.2.

    Simulated robots on MQTT and on Zenoh, with the original's encodings and with H.264 and Opus, each with its own
    network to its broker. In each trial the network has a low rate, loses packets, or both; an operator drives the
    robot and receives its video and audio. Needs mosquitto; without root, a proxy replaces network namespaces.

    With --robot, a real robot behind a network that you limit yourself: it is recorded while its pictures and sound
    are requested, it is never driven, and a table shows all labels side by side. Needs the extra "archive".

    \b
        pebble impair --quick
        pebble impair --trials base-start,256k,64k+5%
        pebble impair --link proxy --subjects "mqtt h264 opus"
        pebble impair --robot goob --url mqtt://192.168.1.2 --label 512k
        pebble impair --compare
    """
    _check_options(context, simulated)
    if compare:
        return _print_table(into or _INTO)
    if robot is not None:
        target = Target(url=url, robot=robot, password_file=password_file, ca_cert=ca_cert)
        return _measure(target, label, into or _INTO, seconds or _SECONDS, media=not no_media, replace=replace)
    return command_of(catalogue.find("impair"))(**simulated)


def _check_options(context: typer.Context, simulated: Collection[str]) -> None:
    """Raises PebbleError for options that do not belong together."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
    if "compare" in given:
        wrong, why = [name for name in given if name not in ("compare", "into")], "does not go with --compare"
    elif "robot" in given:
        wrong, why = [name for name in given if name in simulated], "is for simulated robots, --robot for a real one"
    else:
        wrong, why = [name for name in given if name not in simulated], "is for a real robot: add --robot ID"
    if wrong:
        raise PebbleError(f"--{wrong[0].replace('_', '-')} {why}")
    for name in ("url", "label"):
        if "robot" in given and name not in given:
            raise PebbleError(f"--{name} is missing: --robot needs --url and --label")


def _measure(target: Target, label: str | None, into: Path, seconds: float, *, media: bool, replace: bool) -> int:
    from rich.console import Console
    from rich.text import Text

    from pebble.bench.impair.real_robot import Plan, measure
    from pebble.commands.show import printable
    from pebble.runtime.signals import interrupted_by_signals

    plan = Plan(target=target, label=label or "", into=into, seconds=seconds, media=media, replace=replace)
    with interrupted_by_signals(), Console(stderr=True).status("") as status:
        measured = measure(plan, lambda text: status.update(Text(printable(text))))
    length = (measured.until_ns - measured.since_ns) / 1e9
    typer.echo(f"Measured {length:.0f} s into {plan.folder}; `pebble analyse {plan.folder}` draws it", err=True)
    return _print_table(plan.into)


def _print_table(into: Path) -> int:
    from rich.console import Console

    from pebble.bench.impair.real_robot import columns, table
    from pebble.commands.show import printable

    found, console = columns(into), Console()
    console.print(table(found))
    console.print("kbit/s: medians over active seconds, of payloads.", style="dim", soft_wrap=True)
    for column in found:
        for remark in column.remarks:
            text = printable(f"{column.measurement.label}: {remark}")
            console.print(text, markup=False, highlight=False, soft_wrap=True)
    return 0


class _Command(TyperCommand):
    """Imports the comparison when its options are needed: not for the list of all commands, which any system shows."""

    def get_params(self, ctx: Context) -> list[Parameter]:
        """The options of the comparison, and then those of a real robot."""
        if not self.params:
            simulated = inspect.signature(command_of(catalogue.find("impair"))).parameters.values()
            context, *real, _ = inspect.signature(impair, eval_str=True).parameters.values()
            app = typer.Typer(rich_markup_mode=None, add_completion=False)
            app.command("impair")(with_parameters(_as_impair(), [context, *simulated, *real]))
            whole = typer.main.get_command(app)
            self.params, self.callback = whole.params, whole.callback
        return super().get_params(ctx)


def _as_impair() -> Callable[..., int]:
    """The command, whose parameters may be declared anew."""

    def run(**given: Any) -> int:
        return impair(**given)

    run.__doc__ = impair.__doc__
    return run


def register(app: typer.Typer) -> None:
    app.command("impair", cls=_Command)(with_parameters(_as_impair(), []))
