"""``pebble check``: every problem of a config at once, or what it comes to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from pebble.config import Config, load, resolved
from pebble.errors import ConfigError
from pebble.links import check_kinds

SCHEMA = "schema.json"  # stands beside the configs, where `configs/*.json` finds it


def check(
    configs: Annotated[list[Path], typer.Argument(help="Config files.", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="Every key with its value, and nothing else.")] = False,
) -> int:
    """Every mistake of a config at once, or what it comes to.

    \b
        pebble check configs/goob.json
        pebble check configs/*.json
        pebble check --json configs/goob.json | jq .services.mqtt_bridge.heartbeat
    """
    good = [_check(path, as_json=as_json, first=path is configs[0]) for path in configs]
    return 0 if all(good) else 1


def register(app: typer.Typer) -> None:
    app.command("check")(check)


def _check(path: Path, *, as_json: bool, first: bool) -> bool:
    if path.name == SCHEMA:
        typer.echo(f"pebble: {path.name}: describes the other files for editors; it is no robot's", err=True)
        return True
    try:
        config = load(path)
        check_kinds(config)
    except ConfigError as error:
        for problem in error.problems:
            typer.echo(f"pebble: {path.name}: {problem}", err=True)
        return False
    if as_json:
        typer.echo(json.dumps(resolved(config), indent=2))
        return True
    if not first:
        typer.echo()
    _print(config, path)
    return True


def _print(config: Config, path: Path) -> None:
    from rich.console import Console
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    from pebble.commands.summary import facts, topics_of

    console = Console(highlight=False)
    console.print(Text.assemble((config.base, "bold"), f"  {path}"))
    grid = Table.grid(padding=(0, 2))
    for name, fact in facts(config):
        grid.add_row(Text(name, style="dim"), Text(fact))
    console.print(Padding(grid, (0, 0, 0, 2)))
    if config.robot.platform == "linux":
        table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
        for name in ("process", "", "topic"):
            table.add_column(name, overflow="fold")
        table.add_column("qos", justify="right")
        table.add_column("kept")
        for process, lines in topics_of(config):
            for number, line in enumerate(lines):
                table.add_row(
                    "" if number else Text(process, style="bold"),
                    "hears" if line.channel.direction == "incoming" else "says",
                    Text(line.topic, style="yellow") if line.renamed else Text(line.channel.suffix),
                    str(line.qos),
                    "yes" if line.kept else "",
                )
        console.print(Padding(table, (1, 0, 0, 2)))
    if config.warnings:
        grid = Table.grid(padding=(0, 2))
        for warning in config.warnings:
            grid.add_row(Text("warning", style="yellow"), Text(warning))
        console.print(Padding(grid, (1, 0, 0, 2)))
