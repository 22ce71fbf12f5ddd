"""``pebble impair``: simulated robots behind an impaired network."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand

from pebble.commands.bench import command_named

if TYPE_CHECKING:
    from typer._click.core import Command, Context, Parameter


def impair() -> None:
    """Robots behind an impaired network: the trials of the paper's section 4.2.

    Simulated robots on MQTT and on Zenoh, with the original's encodings and with H.264 and Opus, each with its own
    network to its broker. In each trial the network has a low rate, loses packets, or both; an operator drives the
    robot and receives its video and audio. Needs mosquitto and network namespaces, so usually root.

    \b
        pebble impair --quick
        pebble impair --trials base-start,256k,64k+5%
        pebble impair --subjects "mqtt h264 opus"
    """


class _Command(TyperCommand):
    """Imports the comparison when its options are needed: not for the list of all commands, which any system shows."""

    @cached_property
    def _declared(self) -> Command:
        return command_named("impair")

    def get_params(self, ctx: Context) -> list[Parameter]:
        return [*self._declared.params, *super().get_params(ctx)]

    def invoke(self, ctx: Context) -> Any:
        return self._declared.invoke(ctx)


def register(app: typer.Typer) -> None:
    app.command("impair", cls=_Command)(impair)
