"""``pebble fleet lan`` and ``pebble fleet up``: where the robots of a LAN meet, from its files to its programs.

Each robot and each board is a *neighbour* at the hub of the LAN: it may receive messages of the others.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from pebble.errors import PebbleError
from pebble.extensions.fleet import applying, certificates, folder, pieces
from pebble.extensions.fleet.broker_files import new_password
from pebble.extensions.fleet.folder import CONF, Fleet, FleetError, Server
from pebble.extensions.fleet.roles import Account, ProgramRole
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.extensions.operator.commands.options import host_of
from pebble.extensions.operator.places import mosquitto_path
from pebble.ownership import read_plain
from pebble.runtime.as_owner import as_owner, require_own
from pebble.runtime.whole_file import write

HUB_FILE, GATEWAY_FILE, ROBOTS = "hub.json", "gateway.json", "robots"
_LOCK = ".up"
#: Modules that commands import only when needed; `as_owner` imports them first, as the owner may not read them.
LAZY_MODULES = ("pebble.extensions.fleet.authority", "pebble.extensions.fleet.zenoh_rules")
GATEWAY = "lan-gateway"  # the account of the boards' gateway
_SHARED = ("online",)  # what all receive of each other until their configs say more
_LOOK_S, _END_S = 0.5, 5.0

_Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="A new folder.", show_default=False)]


def lan(
    folder_: _Folder,
    robots: Annotated[list[str], typer.Argument(metavar="ROBOT…", help="Ids of the robots.", show_default=False)],
    host: Annotated[str, typer.Option(help="Name or address of this machine in the LAN.", metavar="HOST")],
    boards: Annotated[
        list[str] | None,
        typer.Option("--board", help="Id of an ESP32 on Wi-Fi; may be given several times.", metavar="ID"),
    ] = None,
    port: Annotated[int, typer.Option(help="Of the broker for boards.", min=1, max=65535)] = folder.PORT,
) -> int:
    """Write all files of a LAN whose robots receive each other: of its hub, and for boards of a broker and a gateway.

    For each robot there is a folder with its certificate and what its config needs.
    Until their configs say more, robots receive that the others are there, and no
    script drives another robot.

    \b
        pebble fleet lan hall goob fred --board minilamp --host hub.lab
        pebble fleet up hall
        pebble up hall/robots/goob/goob.json     # on the robot
    """
    require_packages("pebble fleet")
    place, shown, boards = folder_.absolute(), str(folder_), boards or []
    if (place / folder.FLEET).exists():
        raise FleetError(f"{shown} is a fleet already: add to it with `pebble fleet add`, or name another folder")
    server = Server(host=host_of("--host", host), port=port)
    fleet = _accounts(Fleet(level="login", brokers=(server,), hubs="here"), robots, boards)
    passwords = {name: new_password() for name in fleet.accounts}
    with as_owner(place, *LAZY_MODULES, make=True):
        applying.make(place, fleet, passwords)
        applying.write_zenoh(place, folder.load(place))
        for name in (*robots, *boards):
            certificates.of_account(place, _neighbour(name), ())
        _write(place / HUB_FILE, pieces.hub_file(certificates.SERVER_CERT.removesuffix(".pem")))
        for name in robots:
            _write_robot(place, fleet, name, [other for other in (*robots, *boards) if other != name])
        if boards:
            _write_boards(place, fleet, boards, passwords)
    typer.echo(f"{shown} has all files of a LAN with {', '.join((*robots, *boards))}. On this machine, {server.host}:")
    typer.echo(f"    pebble fleet up {shown}")
    typer.echo(f"On each robot, with a copy of its folder in {shown}/{ROBOTS}; what it has of its own, add there:")
    for name in robots:
        typer.echo(f"    pebble up {name}.json")
    for name in boards:
        typer.echo(f"    pebble flash {name}.json     # or, simulated: pebble sim minilamp --broker {name}.json")
    typer.echo(f"Keep {shown} secret: its keys and passwords are in it.")
    return 0


def up(folder_: Annotated[Path, typer.Argument(metavar="FOLDER", help="Of the fleet.", show_default=False)]) -> int:
    """Run the hub of a LAN on this machine, until Ctrl-C; with boards, also the broker and the gateway.

    Where they shall run after a restart of the machine, use the units in configs/systemd.

    \b
        pebble fleet up hall
    """
    from pebble.extensions.media.child import Child
    from pebble.runtime.signals import EndSignal
    from pebble.transports.peers import FileLock

    place = folder_.absolute()
    require_own(place)
    if not (place / HUB_FILE).is_file():
        raise FleetError(f"{folder_ / HUB_FILE} is missing: name a folder that `pebble fleet lan` has made")
    commands = _commands(place)
    if (lock := FileLock.take(place / _LOCK)) is None:
        raise FleetError(f"{folder_} runs already: another `pebble fleet up` holds {folder_ / _LOCK}")
    ends = EndSignal()
    running: dict[str, Child] = {}
    with ExitStack() as stack:
        stack.callback(lock.release)
        for name, command in commands.items():
            program = running[name] = Child(command, os.environ, tie=signal.SIGTERM)
            stack.callback(program.finish, _END_S)  # ended one after the other, the newest first
            stack.callback(program.signal, signal.SIGTERM)
        typer.echo(f"{', '.join(running)} of {folder_}; Ctrl-C ends them", err=True)
        while not ends.wait(_LOOK_S):
            for name, program in running.items():
                if (code := program.wait(0.0)) is not None:
                    raise PebbleError(
                        f"{name} has ended with code {code}, so all others end, too: read what it said, and start again"
                    )
    return 0


def _commands(place: Path) -> dict[str, list[str]]:
    """Return the programs to run for this LAN, by name. Raises PebbleError."""
    pebble = [sys.executable, "-Pm", "pebble"]  # -P: imports nothing from the current folder
    hub = {"hub": [*pebble, "fleet", "hub", str(place / HUB_FILE)]}
    if not (place / GATEWAY_FILE).exists():
        return hub
    mosquitto = mosquitto_path()
    if mosquitto is None:
        raise PebbleError("mosquitto is not installed: sudo apt install mosquitto")
    # a broker that runs already is not started again
    broker = {} if applying.pid_of(place) else {"broker": [mosquitto, "-c", str(place / CONF)]}
    return broker | hub | {"gateway": [*pebble, "fleet", "gateway", str(place / GATEWAY_FILE)]}


def _accounts(fleet: Fleet, robots: list[str], boards: list[str]) -> Fleet:
    """Return the fleet with an account for each neighbour at the hub, and for boards and their gateway at the broker.

    Raises FleetError.
    """
    bases = {name: f"pebble/robots/{name}" for name in (*robots, *boards)}
    for name, times in Counter((*robots, *boards)).items():
        if times > 1:
            raise FleetError(f"{name} is named {times} times")
    wanted = [(_neighbour(name), ProgramRole.NEIGHBOUR, [base]) for name, base in bases.items()]
    wanted += [(name, ProgramRole.ROBOT, [bases[name]]) for name in boards]
    if boards:
        wanted.append((GATEWAY, ProgramRole.BOARDS, [bases[name] for name in boards]))
    for name, role, account_bases in wanted:
        account = Account(roles=(role,), bases=tuple(account_bases))
        if why := folder.refused(fleet, name, account):
            raise FleetError(why)
        fleet = fleet.with_account(name, account)
    return fleet


def _write_boards(place: Path, fleet: Fleet, boards: list[str], passwords: dict[str, str]) -> None:
    """Write the boards' configs, and the file and password of their gateway."""
    for name in boards:
        piece = pieces.of_broker(fleet, name, passwords[name], board=True)
        piece["robot"]["platform"] = "esp32"
        _write(_folder_of(place, name) / f"{name}.json", piece)
    gateway = pieces.boards_file(fleet, GATEWAY, "")  # "": the certificates are in the file's own folder
    for neighbour in gateway["neighbours"].values():
        neighbour["shares"] = list(_SHARED)  # the metrics that others receive of this board
    _write(place / GATEWAY_FILE, gateway)
    write(place / f"{GATEWAY}-password", f"{passwords[GATEWAY]}\n".encode(), 0o600, FleetError)


def _write_robot(place: Path, fleet: Fleet, name: str, others: list[str]) -> None:
    """Write a robot's folder: its config, in which it listens to the ``others``, and its certificate."""
    piece = pieces.of_certificate(fleet, _neighbour(name))
    section = piece["services"]["neighbours"]
    section |= {"shares": list(_SHARED), "listens": {other: list(_SHARED) for other in others}}
    robot_folder = _folder_of(place, name)
    config = {"robot": piece["robot"], "transport": {"kind": "zenoh"}, "services": piece["services"]}
    _write(robot_folder / f"{name}.json", config)
    for suffix, mode in ((".pem", 0o644), (".key", 0o600)):
        file = place / certificates.ACCOUNTS / f"{_neighbour(name)}{suffix}"
        write(robot_folder / file.name, read_plain(file), mode, FleetError)


def _folder_of(place: Path, name: str) -> Path:
    """Return the folder to be copied to a robot."""
    robot_folder = place / ROBOTS / name
    robot_folder.mkdir(parents=True, exist_ok=True)
    write(robot_folder / certificates.CA_CERT, read_plain(place / certificates.CA_CERT), 0o644, FleetError)
    return robot_folder


def _neighbour(name: str) -> str:
    return f"{name}-lan"


def _write(file: Path, content: dict[str, Any]) -> None:
    write(file, json.dumps(content, indent=2).encode() + b"\n", 0o600, FleetError)
