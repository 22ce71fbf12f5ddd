"""``pebble web user`` and ``pebble web audit``: who may use the operator page, and who did what."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from pebble.config import load
from pebble.config.config import default_state_folder
from pebble.errors import PebbleError
from pebble.extensions.fleet.audit import Audit, Entry
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Role
from pebble.extensions.operator.commands.show import print_table
from pebble.extensions.operator.places import Places
from pebble.extensions.page.config import PEOPLE, WebHandler, WebInterface
from pebble.runtime.as_owner import as_owner

PLACES = Places()
TLS = "tls"

_USER_HELP = """Who may use the operator page, and as what.

A password is asked for, or read as one line from standard input. Changes count at once, also for who is logged in.

\b
    pebble web user add alice --role driver
    pebble web user list
    pebble web user role alice admin
    pebble web user password alice
    pebble web user remove alice
"""
_ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="The database of a robot's own page.", metavar="CONFIG")
]
PeopleOption = Annotated[
    Path | None, typer.Option("--people", help="Database of users and sessions.", metavar="FILE", show_default=False)
]
_Name = Annotated[str, typer.Argument(help="1 to 32 of a-z, 0-9, _ and -.", metavar="NAME", show_default=False)]
_RoleOption = Annotated[Role, typer.Option(help="What the person may do; everybody may stop a robot.")]
_RoleArgument = Annotated[Role, typer.Argument(help="What the person may do.", metavar="ROLE", show_default=False)]


def audit(
    limit: Annotated[int, typer.Option("--limit", "-n", help="Entries to print.", min=1, max=100_000)] = 50,
    config: _ConfigOption = None,
    people: PeopleOption = None,
) -> int:
    """Print who did what to which robot, the newest last. A row with × 9 stands for nine more like it in one minute.

    \b
        pebble web audit --limit 200
    """
    file = _file(config, people)
    with as_owner(file.parent), closing(Audit(file)) as log:
        entries = log.read(limit)
    if not entries:
        typer.echo(f"{file} has no entries yet")
        return 0
    columns = ("time", "what", "robot", "user", "device", "address", "detail")
    print_table(columns, (_columns(entry) for entry in entries))
    return 0


def _columns(entry: Entry) -> tuple[str, ...]:
    at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(entry.at))
    what = entry.what if entry.count == 1 else f"{entry.what} × {entry.count:,}"
    return at, what, entry.ref, entry.user, entry.device, entry.address, entry.detail


# -- people


def add(name: _Name, role: _RoleOption = Role.DRIVER, config: _ConfigOption = None, people: PeopleOption = None) -> int:
    """Add a person, and ask for the password."""
    file = _file(config, people)
    with opened(file) as database:
        database.check_name(name)
        database.add(name, _read_password(), role)
    typer.echo(f"{name} may log in as {role.value} ({file})")
    return 0


def list_(config: _ConfigOption = None, people: PeopleOption = None) -> int:
    """Print names and roles."""
    file = _file(config, people)
    with opened(file) as database:
        users = database.list()
    for user in users:
        typer.echo(f"{user.name:<32}  {user.role.value}")
    if not users:
        typer.echo(f"{file} has no user yet: pebble web user add NAME")
    return 0


def remove(name: _Name, config: _ConfigOption = None, people: PeopleOption = None) -> int:
    """Remove a person, and end the person's sessions."""
    with opened(_file(config, people)) as database:
        database.remove(name)
    typer.echo(f"{name} is removed and logged out")
    return 0


def password(name: _Name, config: _ConfigOption = None, people: PeopleOption = None) -> int:
    """Change a password, and end the person's sessions."""
    with opened(_file(config, people)) as database:
        database.set_password(name, _read_password())
    typer.echo(f"{name} has a new password and is logged out")
    return 0


def role_(name: _Name, role: _RoleArgument, config: _ConfigOption = None, people: PeopleOption = None) -> int:
    """Change what a person may do."""
    with opened(_file(config, people)) as database:
        database.set_role(name, role)
    typer.echo(f"{name} is {role.value} now")
    return 0


def register_people(group: typer.Typer) -> None:
    """Add ``user`` and ``audit`` to the commands of ``pebble web``."""
    users = typer.Typer(help=_USER_HELP, rich_markup_mode=None)
    for name, command in (("add", add), ("list", list_), ("remove", remove), ("password", password), ("role", role_)):
        users.command(name)(command)
    group.add_typer(users, name="user")
    group.command("audit")(audit)


def default_folder() -> Path:
    """Return the default folder of certificates, users and the audit log."""
    return default_state_folder("web", os.environ)


def _file(config: Path | None, people: Path | None) -> Path:
    """Return ``people``; without it the database of ``config``'s page, of this machine's robot's, or the user's own."""
    if people is not None:
        return people.absolute()
    if config is None:
        config = _config_of_machine()
    if config is None:
        return (default_folder() / PEOPLE).absolute()
    loaded = load(config)
    return loaded.section(WebInterface).people or loaded.state_dir() / PEOPLE


def _config_of_machine() -> Path | None:
    """Return the config that `pebble setup` wrote, if its robot serves a page.

    Raises PebbleError if it may not be read.
    """
    file = PLACES.config
    try:
        if not file.exists():
            return None
        file.read_bytes()  # before load, which does not say what to do
    except PermissionError:
        raise PebbleError(
            f"{file}: this user may not read it: use sudo, or name another database, --people FILE"
        ) from None
    return file if load(file).section(WebHandler).enabled else None


@contextmanager
def opened(file: Path | None) -> Iterator[People]:
    """Open a database of people; root opens it as the owner of its folder."""
    with as_owner(Path() if file is None else file.parent), closing(People(file)) as people:
        yield people


def _read_password() -> str:
    """Read a password, never from the command line, which all users of the machine can read.

    Raises PebbleError.
    """
    if sys.stdin.isatty():
        return str(typer.prompt("Password", hide_input=True, confirmation_prompt=True, err=True))
    line = sys.stdin.readline().rstrip("\r\n")
    if not line:
        raise PebbleError("no password: enter it at the prompt, or as one line of standard input")
    return line
