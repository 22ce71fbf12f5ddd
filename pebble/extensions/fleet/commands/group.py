"""``pebble fleet``: the accounts of a broker and their rights."""

import json
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated, Literal

import typer
from msgspec.structs import replace

from pebble.config.visible import shown
from pebble.errors import PebbleError
from pebble.extensions.fleet import applying, certificates, folder, pieces
from pebble.extensions.fleet.broker_files import new_password
from pebble.extensions.fleet.commands import lan
from pebble.extensions.fleet.commands.lan import LAZY_MODULES
from pebble.extensions.fleet.folder import CONF, ZENOH, Fleet, FleetError, Server
from pebble.extensions.fleet.people import People, has_user
from pebble.extensions.fleet.roles import Account, ProgramRole, Role
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.extensions.operator.commands.options import host_of, split_names
from pebble.runtime.as_owner import as_before, as_owner
from pebble.transports.hosts import HostPort

_HELP = """The accounts of a broker: robots, people and page servers, and what each may do.

\b
    pebble fleet init hall --host broker.lab       all files of a broker
    mosquitto -c hall/mosquitto.conf               the broker
    pebble fleet add ann --role driver             prints a password once
    pebble fleet add goob --role robot             prints a piece of config
    pebble fleet role ann maintainer
    pebble fleet remove ann
    pebble fleet check
"""
_Folder = Annotated[
    Path | None, typer.Option("--folder", help="Folder of the fleet; else the only one here.", metavar="FOLDER")
]
_Name = Annotated[str, typer.Argument(help="1 to 32 of a-z, 0-9, _ and -.", metavar="NAME", show_default=False)]
_Roles = Annotated[
    str,
    typer.Option(
        "--role",
        help="viewer, driver, maintainer, safety, admin, or several: driver,safety; else page, robot, neighbour, "
        "gateway, boards, hub, expander.",
        metavar="ROLE[,ROLE]",
    ),
]
_LEVELS: dict[str, Literal["login", "named"]] = {"login": "login", "named": "named"}


def init(
    folder_: Annotated[Path, typer.Argument(metavar="FOLDER", help="A new folder.", show_default=False)],
    host: Annotated[
        str | None,
        typer.Option(
            help="Name or address by which robots and people reach the broker; then those of spare ones and hubs.",
            metavar="HOST[,HOST]",
        ),
    ] = None,
    level: Annotated[str | None, typer.Option(help="login, or named: names in topics, too.", metavar="LEVEL")] = None,
    port: Annotated[int, typer.Option(help="Port of the broker, which is encrypted.", min=1, max=65535)] = folder.PORT,
    unencrypted: Annotated[
        int | None,
        typer.Option("--board-port", help="Also a port without TLS, for boards that have none.", min=1, max=65535),
    ] = None,
    plain: Annotated[
        bool | None, typer.Option("--plain/--no-plain", help="At level named: topics without names are allowed, too.")
    ] = None,
) -> int:
    """Write all files of a broker: authority, certificate, mosquitto.conf, accounts and rules.

    In a folder that is a fleet already it changes the level, and gives every account its rules again.

    \b
        pebble fleet init hall --host broker.lab
        pebble fleet init hall --host broker.lab,spare.lab,hub1.lab
        pebble fleet init hall --level named --plain
    """
    require_packages("pebble fleet")
    place = folder_.absolute()
    if level is not None and level not in _LEVELS:
        raise PebbleError(f'--level must be "login" or "named", not "{level}"')
    if (place / folder.FLEET).exists():
        return _init_again(place, host, level, plain)
    if host is None:
        raise PebbleError("--host is missing: the name or address by which robots and people reach the broker")
    first, *others = (host_of("--host", text) for text in split_names(host))
    server = Server(host=first, port=port, unencrypted=unencrypted)
    fleet = Fleet(level=_LEVELS[level or "login"], brokers=(server,), plain=bool(plain))
    with as_owner(place, *LAZY_MODULES, make=True):
        applying.make(place, fleet, others=others)
    typer.echo(f"{_shown(place)} has all files of a broker at {server.host}:{server.port}, level {fleet.level}.")
    typer.echo(f"Start it, then add who may use it:\n    mosquitto -c {_shown(place / CONF)}")
    for account in ("ann --role driver", "goob --role robot"):
        typer.echo(f"    pebble fleet add {account} --folder {_shown(place)}")
    if place.stat().st_uid == 0:
        typer.echo("It will run as root, as whom these files were made: a user of its own would do.")
    typer.echo(f"Keep {_shown(place)} secret, and a copy of it: its keys are in it.")
    return 0


def add(
    name: _Name,
    roles: _Roles,
    base: Annotated[
        list[str] | None,
        typer.Option(
            help="Base topic of a robot (default: pebble/robots/NAME) or neighbour; each that a gateway carries.",
            metavar="BASE",
        ),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="A robot that does not know names: its topics stay without them.")
    ] = False,
    board: Annotated[bool, typer.Option("--board", help="A robot that is a board: print local_mqtt.")] = False,
    people: Annotated[
        Path | None,
        typer.Option(help="Of a page on this machine: its database of people; remove acts there, too.", metavar="FILE"),
    ] = None,
    folder_: _Folder = None,
) -> int:
    """Add an account, and print its password: this once, and nowhere else.

    \b
        pebble fleet add ann --role driver,safety
        pebble fleet add goob --role robot
        pebble fleet add lamp --role robot --base a/b/lamp --plain --board
        pebble fleet add page-1 --role page
        pebble fleet add goob-lan --role neighbour --base pebble/robots/goob
    """
    role_names = tuple(dict.fromkeys(split_names(roles)))
    usual_bases = (f"pebble/robots/{name}",) if role_names == (ProgramRole.ROBOT,) else ()
    bases = tuple(base) if base else usual_bases
    database = "" if people is None else str(people.absolute())
    account = Account(roles=role_names, bases=bases, plain=plain, people=database)
    with _locked_fleet(folder_) as (place, fleet):
        if why := folder.refused(fleet, name, account):
            raise FleetError(why)
        if len(fleet.accounts) >= folder.MAX_ACCOUNTS:
            raise FleetError(f"{place} has {folder.MAX_ACCOUNTS} accounts already: remove one, or make another fleet")
        after = fleet.with_account(name, account)
        secret = new_password()
        is_neighbour = role_names == (ProgramRole.NEIGHBOUR,)  # which is at a hub, and nowhere else
        if is_neighbour:
            require_packages("pebble fleet")
            after = replace(after, hubs="here" if fleet.hubs == "none" else fleet.hubs)
        how = applying.apply(place, after, {name: secret})
        files = certificates.of_account(place, name, ()) if is_neighbour else None
        _print_account(place, after, name, secret, how, board=board)
        if files is not None:
            _print_certificate(place, after, name, files)
    return 0


def role_(
    name: _Name,
    roles: Annotated[str, typer.Argument(metavar="ROLE[,ROLE]", help="What it may do.", show_default=False)],
    folder_: _Folder = None,
) -> int:
    """Change what an account may do; it stays connected."""
    with _locked_fleet(folder_) as (place, fleet):
        account = _account(place, fleet, name)
        changed = replace(account, roles=tuple(dict.fromkeys(split_names(roles))))
        if why := folder.refused(fleet.without(name), name, changed):
            raise FleetError(why)
        after = replace(fleet, accounts={**fleet.accounts, name: changed})
        how = applying.apply(place, after)
    typer.echo(f"{name} is {', '.join(changed.roles)} now ({how})")
    return _print_left(_copies(place, after))  # 1 if somebody must copy the new rules to a broker or hub elsewhere


def password(name: _Name, folder_: _Folder = None) -> int:
    """Give an account a new password, print it this once, and end its connections."""
    with _locked_fleet(folder_) as (place, fleet):
        _account(place, fleet, name)
        secret = new_password()
        how = applying.apply(place, fleet, {name: secret})
    _print_account(place, fleet, name, secret, how)
    without_hubs = replace(fleet, hubs="none")  # their rules hold no passwords
    return _print_left(_copies(place, without_hubs))


def remove(name: _Name, folder_: _Folder = None) -> int:
    """Remove an account everywhere, and end its connections; say where it may still get in."""
    with _locked_fleet(folder_) as (place, fleet):
        account = _account(place, fleet, name)
        after = fleet.without(name)
        is_person = not set(account.roles) & set(ProgramRole)  # it has no role of a program
        unfinished = list(_remove_from_pages(fleet, name)) if is_person else []
        unfinished += _copies(place, after)
        try:
            how = applying.apply(place, after)
            typer.echo(f"{name} is removed and disconnected ({how})")
        except FleetError as error:
            unfinished += [*str(error).splitlines(), f"{name} may still get in there: give this command again"]
    return _print_left(unfinished)


def zenoh(
    only_here: Annotated[
        bool, typer.Option("--only-here", help="All hubs run on this machine and read the file there: no copies.")
    ] = False,
    folder_: _Folder = None,
) -> int:
    """Write the accounts' rules for Zenoh hubs, too, and write them again at each later change.

    \b
        pebble fleet zenoh --only-here
    """
    require_packages("pebble fleet")
    with _locked_fleet(folder_) as (place, fleet):
        after = replace(fleet, hubs="here" if only_here else "elsewhere")
        applying.write_zenoh(place, after)
        folder.save(place, after)
    file = place / ZENOH
    typer.echo(f"{_shown(file)} has the rules of {len(after.accounts)} accounts. For a robot's hub, in its config:")
    typer.echo(f'    "transport": {{"access": "{file}", …}}')
    typer.echo("For a hub of its own, in the settings that it is started with:")
    typer.echo(f'    "access": "{file}"')
    if not only_here:
        typer.echo("On other machines: a copy of it, after each change (hubs read it again when it changes).")
    return 0


def certificate(
    name: _Name,
    hosts: Annotated[
        list[str] | None,
        typer.Argument(metavar="HOST…", help="Where it listens itself, as a robot's hub does.", show_default=False),
    ] = None,
    folder_: _Folder = None,
) -> int:
    """Write a certificate with the name of an account, for Zenoh, and print what belongs into its config.

    \b
        pebble fleet certificate goob
        pebble fleet certificate goob goob.local 192.168.1.7
    """
    require_packages("pebble fleet")
    with _locked_fleet(folder_) as (place, fleet):
        account = _account(place, fleet, name)
        is_hub = ProgramRole.HUB in account.roles
        if is_hub and not hosts:
            raise FleetError(f"{name} is a hub: name where others reach it, `pebble fleet certificate {name} HOST`")
        taken = set(fleet.accounts)
        if not is_hub:  # a hub may have a broker's names, as both may run on one machine
            taken.update(certificates.hosts_of(host for server in fleet.brokers for host in applying.names_of(server)))
        host_names = set(certificates.hosts_of(hosts)) if hosts else set[str]()
        if conflicts := host_names & (taken - {name}):
            raise FleetError(f"{name} cannot be {min(conflicts)}: that is a broker of this fleet, or another account")
        files = certificates.of_account(place, name, hosts or ())
        _print_certificate(place, fleet, name, files)
    return 0


def list_(folder_: _Folder = None) -> int:
    """Print the accounts and what each is."""
    place = _place(folder_)
    with as_owner(place):
        fleet = folder.load(place)
    brokers = ", ".join(f"{server.host}:{server.port}" for server in fleet.brokers)
    typer.echo(f"{_shown(place)}: level {fleet.level}, broker {brokers}")
    for name, account in fleet.accounts.items():
        what = [", ".join(account.roles), *account.bases, *(["plain"] if account.plain or fleet.plain else [])]
        typer.echo(f"{name:<32}  {'  '.join(what)}")
    return 0


def apply_(folder_: _Folder = None) -> int:
    """Write all rules again from the table, and let the broker read them.

    A fleet that an earlier version made for mosquitto's plugin becomes one of
    files; the lines of mosquitto.conf to change are printed.

    \b
        pebble fleet apply
    """
    with _locked_fleet(folder_, any_rules=True) as (place, fleet):
        unfinished = list[str]()
        if fleet.rules == "plugin":
            fleet, unfinished = applying.convert(place, fleet)
        if applying.obeys_plugin(place):  # it reads no files before mosquitto.conf is changed
            unfinished += applying.conf_differences(place, fleet)
        else:
            typer.echo(f"{_shown(place)} knows {len(fleet.accounts)} accounts ({applying.apply(place, fleet)})")
        unfinished += _copies(place, fleet)
    return _print_left(unfinished)


def check_(folder_: _Folder = None) -> int:
    """Compare the broker's files with the table, and name each rule too many or too few.

    \b
        pebble fleet check
    """
    require_packages("pebble fleet")
    with _locked_fleet(folder_) as (place, fleet):
        by_hand, rules = applying.by_hand(place, fleet), applying.of_rules(place, fleet)  # `apply` mends only the rules
    code = _print_left(by_hand + rules)
    if rules:
        typer.echo(f"pebble: `pebble fleet apply --folder {_shown(place)}` writes the rules again", err=True)
    if not code:
        typer.echo(f"The files of {_shown(place)} have its {len(fleet.accounts)} accounts, and their rules.")
    return code


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_HELP, rich_markup_mode=None)
    for command in (init, add, role_, password, remove, list_, apply_, check_, zenoh, certificate, lan.lan, lan.up):
        group.command(command.__name__.rstrip("_"))(command)
    app.add_typer(group, name="fleet")


# -- inside


def _init_again(place: Path, host: str | None, level: str | None, plain: bool | None) -> int:
    """Change the level of a fleet that exists, and whether its topics are plain; None leaves either as it is."""
    if host is not None:
        raise PebbleError(f"{_shown(place)} is a fleet already, so leave out --host; another host needs another folder")
    with _locked_fleet(place) as (_, fleet):
        after = replace(
            fleet,
            level=fleet.level if level is None else _LEVELS[level],
            plain=fleet.plain if plain is None else plain,
        )
        how = applying.apply(place, after)
    typer.echo(f"{_shown(place)} has level {after.level}{' and plain topics' if after.plain else ''} ({how})")
    return _print_left(_copies(place, after))


@contextmanager
def _locked_fleet(folder_: Path | None, *, any_rules: bool = False) -> Iterator[tuple[Path, Fleet]]:
    """Yield a fleet and its folder, locked against changes by others. Raises PebbleError.

    Root acts as the folder's owner meanwhile. ``any_rules``: also a fleet whose rules mosquitto still takes from its
    plugin, not from files.
    """
    place = _place(folder_)
    with as_owner(place, *LAZY_MODULES), folder.locked(place):
        fleet = folder.load(place)
        if fleet.rules == "plugin" and not any_rules:
            shown = _shown(place)
            raise FleetError(f"{shown} is for mosquitto's plugin: `pebble fleet apply --folder {shown}` makes it files")
        yield place, fleet


def _place(folder_: Path | None) -> Path:
    """Return ``folder_``; None: the only folder with a fleet, the current one or one in it. Raises PebbleError."""
    if folder_ is not None:
        return folder_.absolute()
    folders = [Path(), *sorted(path for path in Path().iterdir() if path.is_dir() and not path.name.startswith("."))]
    fleets = [path.absolute() for path in folders if (path / folder.FLEET).is_file()]
    if len(fleets) != 1:
        names = ", ".join(map(_shown, fleets))
        why = f"there are several fleets here, {names}" if fleets else "there is no fleet here"
        raise PebbleError(f"{why}: name one with --folder FOLDER")
    return fleets[0]


def _shown(path: Path) -> str:
    """Return a path relative to the current folder, if it is below it."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def _account(place: Path, fleet: Fleet, name: str) -> Account:
    if name not in fleet.accounts:
        raise FleetError(f"{_shown(place / folder.FLEET)} has no account {name!r}: `pebble fleet list` lists them")
    return fleet.accounts[name]


def _print_account(place: Path, fleet: Fleet, name: str, secret: str, how: str, *, board: bool = False) -> None:
    """Print how an account logs in, and what uses it; ``how``: what `applying.apply` has done to admit it."""
    account = fleet.accounts[name]
    if ProgramRole.NEIGHBOUR in account.roles:  # it logs in nowhere: its certificate admits it to the hub
        typer.echo(f"{name} is {account.bases[0]} at the hub of a LAN ({how}).")
        return
    typer.echo(f"{name} may log in as {', '.join(account.roles)} ({how})")
    typer.echo(f"    password: {secret}")
    typer.echo("It is shown this once.")
    ca = _shown(place / certificates.CA_CERT)
    if ProgramRole.ROBOT in account.roles:
        typer.echo(f"For its config, which no other user may read, with a copy of {ca} beside it:")
        typer.echo(json.dumps(pieces.of_broker(fleet, name, secret, board=board), indent=2))
        return
    url = f"mqtts://{name}@{HostPort(fleet.brokers[0].host, fleet.brokers[0].port)}"
    if ProgramRole.PAGE in account.roles:
        typer.echo(f"    pebble web --url {url} --ca-cert {ca} --password-file FILE")
    elif ProgramRole.HUB in account.roles:
        typer.echo("A hub needs none, but a certificate:")
        typer.echo(f"    pebble fleet certificate {name} HOST")
    elif ProgramRole.BOARDS in account.roles:
        typer.echo(
            f"The file of that gateway, with its password in {name}-password, and what each board grants to add:"
        )
        typer.echo(json.dumps(pieces.boards_file(fleet, name, f"{_shown(place)}/"), indent=2))
    elif ProgramRole.EXPANDER in account.roles:
        typer.echo(f"    pebble topic expand {url} --ca-cert {ca} --password-file FILE")
    elif ProgramRole.GATEWAY not in account.roles:  # else the login stands in the gateway's own file
        does = "watch" if account.roles == (Role.VIEWER,) else "drive"
        typer.echo(f"    pebble {does} ROBOT --url {url} --ca-cert {ca} --password-file FILE")


def _print_certificate(place: Path, fleet: Fleet, name: str, files: tuple[Path, Path]) -> None:
    """Print the paths of an account's certificate and key, and the lines for its config."""
    roles, until = fleet.accounts[name].roles, certificates.show(files[0]).until
    typer.echo(f"{' and '.join(map(_shown, files))} are for {name}, until {until:%Y-%m-%d}.")
    copies = " and ".join(map(_shown, (files[0], place / certificates.CA_CERT)))
    typer.echo(
        f"Move the key to its machine, with copies of {copies} beside it. `pebble fleet check` watches the date."
    )
    if ProgramRole.HUB in roles:
        typer.echo(f"And a copy of {_shown(place / ZENOH)}. The file of that hub:")
    if piece := pieces.of_certificate(fleet, name):
        typer.echo(json.dumps(piece, indent=2))


def _copies(place: Path, fleet: Fleet) -> Iterator[str]:
    """Yield the copies of the rules on other machines, which a change here does not reach, each with what to do."""
    return applying.copies(Path(_shown(place)), fleet)


def _print_left(lines: Iterable[str]) -> int:
    """Print what is left to do by hand, such as copying the rules; return the exit code: 1 if there is anything."""
    code = 0
    for line in lines:
        typer.echo(f"pebble: {shown(line)}", err=True)
        code = 1
    return code


def _remove_from_pages(fleet: Fleet, name: str) -> Iterator[str]:
    """Remove the person from the lists of page servers on this machine; yield a line for each that it cannot change."""
    for page, account in fleet.accounts.items():
        if ProgramRole.PAGE not in account.roles:
            continue
        if not account.people:
            yield f"{page} has people of its own: if {name} is one, `pebble web user remove {name}` on its machine"
            continue
        file = Path(account.people)
        with as_before(), as_owner(file.parent):  # root again (if it was), then the file's owner, not the fleet's
            if not file.is_file():
                yield f"{page}: {file} is not there: who is in it may still get in by that page"
            elif has_user(file, name):
                with closing(People(file)) as people:
                    people.remove(name)
                typer.echo(f"{name} is removed from the people of {page} and logged out there")
