"""``pebble foxglove``: shows robots live in the Foxglove app."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pebble.config.hosts import is_loopback
from pebble.errors import PebbleError
from pebble.extensions.operator.client.connection import Target, resolve
from pebble.extensions.operator.commands import show
from pebble.extensions.operator.commands.options import BrokerUrl, CaCert, PasswordFile, host_of
from pebble.runtime.connections import REMOTE_RECONNECT_S
from pebble.transports import MqttSettings

if TYPE_CHECKING:
    from pebble.extensions.foxglove.run import Summary


def foxglove(
    config: Annotated[
        Path | None,
        typer.Argument(help="A robot's config file: show this robot.", metavar="CONFIG", show_default=False),
    ] = None,
    url: BrokerUrl = None,
    robot: Annotated[str | None, typer.Option(help="Only this robot; all, unless given.", metavar="ROBOT")] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.", metavar="HOST")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0 is a free one.", metavar="PORT", min=0, max=65535)] = 8765,
    no_login: Annotated[
        bool, typer.Option("--no-login", help="With --host: other machines may watch and listen.")
    ] = False,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Show robots live in the Foxglove app: pictures, sound, logs, poses and all telemetry, until Ctrl-C.

    Cameras and microphones run while a panel shows them. Foxglove can send nothing to a robot.

    \b
        pebble foxglove goob.json
        pebble foxglove --url mqtt://127.0.0.1
        pebble foxglove --url mqtt://127.0.0.1 --robot goob --port 8766
    """
    if (config is None) == (url is None):
        raise PebbleError("which robots is missing: name either a robot's config file or --url mqtt://BROKER")
    host = host_of("--host", host)
    if not is_loopback(host) and not no_login:
        raise PebbleError(
            f"--host {host}: other machines could watch and listen without a login, because Foxglove's protocol has "
            f"none: use `ssh -L {port}:127.0.0.1:{port} MACHINE` from there, or add --no-login"
        )
    from pebble.extensions.foxglove.run import Settings, run

    target = Target(
        config=config,
        url=url,
        robot=robot,
        remote=config is not None,
        password_file=password_file,
        ca_cert=ca_cert,
        program="foxglove",
    )
    _, broker, names, where = resolve(target)
    if not isinstance(broker, MqttSettings):
        raise PebbleError("Foxglove needs the robots' broker: use --url mqtt://HOST[:PORT] or mqtts://…")
    broker = replace(broker, reconnect_max_s=REMOTE_RECONNECT_S)
    _print_end(run(Settings(broker, where, names.base, host, port), _print_ready))
    return 0


def _print_ready(address: str) -> None:
    typer.echo(f"Foxglove opens {address} (Open connection, Foxglove WebSocket); Ctrl-C ends it")
    if not is_loopback(address.removeprefix("ws://").rpartition(":")[0].strip("[]")):
        typer.echo("pebble: everybody on the network can watch and listen, without a login and unencrypted", err=True)


def _print_end(summary: Summary) -> None:
    line = f"Showed {show.counted(summary.robots, 'robot')} in {show.counted(summary.published, 'message')}"
    if summary.dropped:
        line += f", {summary.dropped:,} dropped"
    if summary.refused:
        line += f", {summary.refused:,} that cannot be shown"
    typer.echo(line, err=True)
