"""``pebble impair``: robots behind an impaired network."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperCommand

from pebble.bench.comparison import find
from pebble.client.connection import Target
from pebble.commands.bench import command_of
from pebble.commands.options import CaCert, PasswordFile
from pebble.commands.show import printable
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals

if TYPE_CHECKING:
    from typer._click.core import Command, Context, Parameter


def impair(
    robot: Annotated[
        str | None,
        typer.Option(help="Measure this real robot; the options below belong to it.", metavar="[SYSTEM/TYPE/]ID"),
    ] = None,
    url: Annotated[str | None, typer.Option(help="Its broker.", metavar="mqtt[s]://[USER@]HOST[:PORT]")] = None,
    label: Annotated[str | None, typer.Option(help="Name of the present limit, such as 512k.")] = None,
    seconds: Annotated[float, typer.Option(help="Measure for this long.", min=1)] = 120,
    no_media: Annotated[bool, typer.Option("--no-media", help="Request no pictures and no sound.")] = False,
    into: Annotated[Path, typer.Option(help="Folder of all labels.", metavar="DIR")] = Path("impair"),
    replace: Annotated[bool, typer.Option("--replace", help="Delete what was measured with this label.")] = False,
    compare: Annotated[bool, typer.Option("--compare", help="Only print the table of all labels.")] = False,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Robots behind an impaired network: the trials of the paper's section 4.2.

    Simulated robots on MQTT and on Zenoh, with the original's encodings and with H.264 and Opus, each with its own
    network to its broker. In each trial the network has a low rate, loses packets, or both; an operator drives the
    robot and receives its video and audio. Needs mosquitto and network namespaces, so usually root.

    With --robot, a real robot behind a network that you limit yourself: it is recorded while its pictures and sound
    are requested, it is never driven, and a table shows all labels side by side. Needs the extra "archive".

    \b
        pebble impair --quick
        pebble impair --trials base-start,256k,64k+5%
        pebble impair --subjects "mqtt h264 opus"
        pebble impair --robot goob --url mqtt://192.168.1.2 --label 512k
        pebble impair --compare
    """
    from pebble.bench.impair.real_robot import Plan, compared, measure

    if not compare:
        if url is None or label is None:
            raise PebbleError(f"--{'url' if url is None else 'label'} is missing: --robot needs --url and --label")
        target = Target(url=url, robot=robot, password_file=password_file, ca_cert=ca_cert)
        plan = Plan(target=target, label=label, into=into, seconds=seconds, media=not no_media, replace=replace)
        with interrupted_by_signals(), Console(stderr=True).status("") as status:
            took_s = measure(plan, lambda text: status.update(Text(printable(text))))
        typer.echo(f"Measured {took_s:.0f} s into {plan.folder}; `pebble analyse {plan.folder}` draws it", err=True)
    console, (table, notes) = Console(), compared(into)
    console.print(table)
    for line in ("kbit/s: medians over active seconds, of payloads.", *map(printable, notes)):
        console.print(line, style="dim", markup=False, highlight=False, soft_wrap=True)
    return 0


class _Command(TyperCommand):
    """Has the options of the comparison, too, and runs that unless a real robot or a table is wanted.

    The comparison is imported when its options are needed: not for the list of all commands, which any system shows.
    """

    @cached_property
    def _simulated(self) -> Command:
        app = typer.Typer(rich_markup_mode=None, add_completion=False)
        app.command()(command_of(find("impair")))
        return typer.main.get_command(app)

    def get_params(self, ctx: Context) -> list[Parameter]:
        return [*self._simulated.params, *super().get_params(ctx)]

    def invoke(self, ctx: Context) -> Any:
        """Raises PebbleError for options that do not belong together."""
        simulated = {one.name for one in self._simulated.params}
        sources = {name: ctx.get_parameter_source(name) for name in ctx.params}
        given = [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
        real, why = "compare" in given or "robot" in given, "is for a real robot: add --robot ID"
        wrong = [name for name in given if (name in simulated) == real]
        if "compare" in given:
            wrong, why = [name for name in given if name not in ("compare", "into")], "does not go with --compare"
        elif real:
            why = "is for simulated robots, --robot for a real one"
        if wrong:
            raise PebbleError(f"--{wrong[0].replace('_', '-')} {why}")
        ctx.params = {name: value for name, value in ctx.params.items() if (name in simulated) != real}
        return super().invoke(ctx) if real else self._simulated.invoke(ctx)


def register(app: typer.Typer) -> None:
    app.command("impair", cls=_Command)(impair)
