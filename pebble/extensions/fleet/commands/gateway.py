"""``pebble fleet gateway``: carries robots of a Zenoh hub, or of a LAN's broker, to the broker of their operators."""

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Protocol

import typer

from pebble.errors import PebbleError
from pebble.runtime.signals import EndSignal

log = logging.getLogger(__name__)


def gateway(
    file: Annotated[Path, typer.Argument(help="The gateway's file, in JSON.", metavar="FILE", show_default=False)],
) -> int:
    """Carry robots of a Zenoh hub, or of a LAN's broker, to an MQTT broker and back; Ctrl-C ends it.

    Operators at the broker see, drive and stop them as if they were there. There
    is one gateway for a LAN, which systemd starts again; a second one does not
    start while it hears the first. An example:

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
        pebble fleet gateway gate-1.json

    Boards cannot speak Zenoh. For them, give their broker on the LAN as "boards"
    instead of "hub". With "neighbours" as well, robots at the LAN's hub can
    receive from the boards and drive them.
    """
    from pebble.extensions.fleet.files import gateway_transports, load_gateway
    from pebble.extensions.fleet.gateway.gateway import Gateway, will
    from pebble.runtime.parent import Notifier, set_up_logging
    from pebble.services.neighbours.board import of_board

    settings, name, run_dir = load_gateway(file)
    set_up_logging("INFO")
    programs: list[_Program] = []
    near = [*settings.hub.connect]  # on the side of the robots
    if (boards := settings.boards) is not None:
        near.append(f"{boards.host}:{boards.port}")
        programs += [of_board(base, robot, boards, run_dir) for base, robot in settings.neighbours.items()]
    if (mqtt := settings.operators) is not None:
        transports = gateway_transports(settings, mqtt, run_dir, will(name))
        programs.append(Gateway(name, settings.robots, *transports))
    far = [f"{mqtt.host}:{mqtt.port}"] if mqtt is not None else []  # and on the other side
    far += [endpoint for robot in settings.neighbours.values() for endpoint in robot.lan.connect]
    typer.echo(
        f"gateway {name} between {', '.join(near)} and {', '.join(dict.fromkeys(far))}; Ctrl-C ends it", err=True
    )
    return _run_together(programs, Notifier().ready)


class _Program(Protocol):
    def run(self, ready: Callable[[], None] = ...) -> None: ...

    def quit(self) -> None: ...


def _run_together(programs: list[_Program], ready: Callable[[], None]) -> int:
    """Run programs until a signal, or until one of them ends; return the exit code: 1 if one has failed."""
    ends, failed = EndSignal(), threading.Event()

    def run(program: _Program) -> None:
        try:
            program.run()
        except PebbleError as error:
            log.error("%s", error)
            failed.set()
        except Exception:  # the process boundary: its manager starts it again
            log.exception("%s has failed", type(program).__name__)
            failed.set()
        finally:
            ends.set()

    threads = [threading.Thread(target=run, args=(program,)) for program in programs]
    for thread in threads:
        thread.start()
    ready()
    ends.wait()
    for program in programs:
        program.quit()
    for thread in threads:
        thread.join()
    return int(failed.is_set())
