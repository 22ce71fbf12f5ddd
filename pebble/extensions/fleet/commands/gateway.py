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
    return _Together(programs).run(Notifier().ready)


class _Program(Protocol):
    def run(self, ready: Callable[[], None] = ...) -> None: ...

    def quit(self) -> None: ...


class _Together:
    """Programs that end together, at a signal or when one of them fails."""

    def __init__(self, programs: list[_Program]) -> None:
        self._programs, self._failed = programs, False

    def run(self, ready: Callable[[], None]) -> int:
        ends = EndSignal()
        threads = [threading.Thread(target=self._run, args=(program, ends)) for program in self._programs]
        for thread in threads:
            thread.start()
        ready()
        ends.wait()
        for program in self._programs:
            program.quit()
        for thread in threads:
            thread.join()
        return int(self._failed)

    def _run(self, program: _Program, ends: EndSignal) -> None:
        try:
            program.run()
        except PebbleError as error:
            log.error("%s", error)
            self._failed = True
        except Exception:  # the process boundary: its manager starts it again
            log.exception("%s has failed", type(program).__name__)
            self._failed = True
        finally:
            ends.set()
