"""``pebble gateway``: carries robots of a Zenoh hub to an MQTT broker."""

import signal
from pathlib import Path
from typing import Annotated

import typer

FileArgument = Annotated[Path, typer.Argument(help="The gateway's file, in JSON.", metavar="FILE", show_default=False)]


def gateway(file: FileArgument) -> int:
    """Carry robots of a Zenoh hub to an MQTT broker and back; Ctrl-C ends it.

    Operators at the broker see, drive and stop them as if they were there. Run
    two or three on different machines: they share the robots, and when one dies
    the others take its robots. An example:

    \b
        {"id": "gate-1",
         "hub": {"connect": ["tls/hub1.lab:7447", "tls/hub2.lab:7447"],
                 "tls": {"enabled": true, "ca_cert": "ca.pem",
                         "client_cert": "gate-1.pem",
                         "client_key": "gate-1.key"}},
         "mqtt": {"host": "broker.lab", "port": 8883, "username": "gate-1",
                  "password_file": "gate-1-password",
                  "tls": {"enabled": true, "ca_cert": "ca.pem"}},
         "robots": ["pebble/robots/+"]}

    \b
        pebble gateway gate-1.json
    """
    from pebble.config.gateway_file import load_gateway
    from pebble.runtime.connections import gateway_transports
    from pebble.runtime.parent import Notifier, set_up_logging
    from pebble.services.gateway.gateway import Gateway
    from pebble.services.gateway.heartbeats import will

    settings, name, run_dir = load_gateway(file)
    set_up_logging("INFO")
    program = Gateway(name, settings.robots, *gateway_transports(settings, run_dir, will(name)))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: program.quit())
    where = f"{settings.mqtt.host}:{settings.mqtt.port}"
    typer.echo(f"gateway {name} between {', '.join(settings.hub.connect)} and {where}; Ctrl-C ends it", err=True)
    program.run(ready=Notifier().ready)
    return 0
