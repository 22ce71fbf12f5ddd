"""``pebble fleet hub``: runs a Zenoh hub for several robots."""

from pathlib import Path
from typing import Annotated

import typer


def hub(
    file: Annotated[Path, typer.Argument(help="The hub's file, in JSON.", metavar="FILE", show_default=False)],
) -> int:
    """Run a Zenoh hub, to which robots connect; Ctrl-C ends it.

    FILE says where it listens. An example:

    \b
        {"listen": ["tls/0.0.0.0:7447"],
         "tls": {"enabled": true, "ca_cert": "ca.pem",
                 "client_cert": "hub1.pem", "client_key": "hub1.key"},
         "journal": "hub1.journal"}

    \b
        pebble fleet hub hub1.json
    """
    from pebble.extensions.fleet.files import load_hub
    from pebble.runtime.as_owner import require_own
    from pebble.runtime.hub import run_hub  # of Linux only
    from pebble.runtime.parent import set_up_logging
    from pebble.runtime.signals import EndSignal

    settings = load_hub(file)
    if settings.journal is not None:
        require_own(settings.journal.parent)
    set_up_logging("INFO")
    stop = EndSignal()
    here = f"on this machine --url zenoh:{settings.run_dir}"
    typer.echo(f"hub at {', '.join(settings.listen)}, {here}; Ctrl-C ends it", err=True)
    run_hub(settings, stop)
    return 0
