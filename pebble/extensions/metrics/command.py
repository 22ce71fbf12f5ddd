"""``pebble exporter``: serves the metrics of a broker's robots to Prometheus."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from pebble.config.hosts import is_loopback
from pebble.config.text_files import read_password
from pebble.errors import PebbleError
from pebble.extensions.operator.client.connection import Target, resolve
from pebble.extensions.operator.commands.options import BrokerUrl, CaCert, PasswordFile, host_of
from pebble.runtime.connections import REMOTE_RECONNECT_S
from pebble.transports import MqttSettings


def exporter(
    url: BrokerUrl = None,
    host: Annotated[str, typer.Option(help="Address to listen on.", metavar="HOST")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0 is a free one.", metavar="PORT", min=0, max=65535)] = 9464,
    token_file: Annotated[
        Path | None, typer.Option(help="File with the token that Prometheus sends.", metavar="FILE")
    ] = None,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Serve metrics of all robots of a broker to Prometheus, until Ctrl-C. It sends nothing to robots.

    \b
        pebble exporter --url mqtt://127.0.0.1
        pebble exporter --url mqtt://127.0.0.1 --host 0.0.0.0 --token-file token
    """
    host = host_of("--host", host)
    token = "" if token_file is None else read_password(token_file, "--token-file")
    needs_token = token_file is not None or not is_loopback(host)  # a file that is given must not be empty
    if needs_token and not token:
        raise PebbleError(f"--host {host}: others could read everything: add --token-file FILE, with a token in it")
    _, settings, _, where = resolve(Target(url=url, password_file=password_file, ca_cert=ca_cert))
    if not isinstance(settings, MqttSettings):
        raise PebbleError("metrics are those of a broker: use --url mqtt://HOST[:PORT] or mqtts://…")
    from pebble.extensions.metrics.server import run

    # With QoS 1 a broker drops retained messages of a large fleet.
    settings = replace(settings, reconnect_max_s=REMOTE_RECONNECT_S, max_qos=0)
    run(settings, host, port, token, lambda address: typer.echo(f"Metrics of {where} at {address}; Ctrl-C ends it"))
    return 0
