"""``pebble fleet hub``: runs a Zenoh hub for several robots, and shows those that run."""

from pathlib import Path
from typing import Annotated

import typer

from pebble.errors import TransportError

FileArgument = Annotated[Path, typer.Argument(help="The hub's file, in JSON.", metavar="FILE", show_default=False)]
StateOption = Annotated[bool, typer.Option("--state", help="Show the hub that runs with FILE, and those linked to it.")]


def hub(file: FileArgument, state: StateOption = False) -> int:
    """Run a Zenoh hub, to which robots and other hubs connect; Ctrl-C ends it.

    FILE says where it listens and to which hubs it is linked; two or three of them keep the same state, and a robot
    that names them all goes on when one of them dies. An example:

    \b
        {"listen": ["tls/0.0.0.0:7447"], "connect": ["tls/hub2.lab:7447"],
         "tls": {"enabled": true, "ca_cert": "ca.pem",
                 "client_cert": "hub1.pem", "client_key": "hub1.key"},
         "journal": "hub1.journal"}

    \b
        pebble fleet hub hub1.json
        pebble fleet hub hub1.json --state
    """
    from pebble.config.hub_file import load_hub
    from pebble.runtime.connections import fleet_hub_settings

    settings = fleet_hub_settings(*load_hub(file))
    if state:
        from pebble.client.hubs import hub_states

        states = hub_states(settings)
        if not states:
            raise TransportError(f"no hub runs with {file}: start it with `pebble fleet hub {file}`")
        for one in states:
            linked = f"linked to {', '.join(one.hubs)}" if one.hubs else "linked to no other hub"
            if one.links < len(one.hubs):
                linked += f", {one.links or 'none'} of them directly"
            counts = f"{one.clients} clients, {one.wills} wills, {one.retained} retained messages, {one.merges} merges"
            typer.echo(f"hub {one.name}: {counts}; {linked}")
        return 0
    from pebble.runtime.hub import run_hub  # of Linux only
    from pebble.runtime.parent import set_up_logging
    from pebble.runtime.signals import EndSignal

    set_up_logging("INFO")
    stop = EndSignal()
    here = f"on this machine --url zenoh:{settings.run_dir}"
    typer.echo(f"hub at {', '.join(settings.listen)}, {here}; Ctrl-C ends it", err=True)
    run_hub(settings, stop)
    return 0
