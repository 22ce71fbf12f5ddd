"""Changes of a fleet, at its brokers: live where mosquitto runs, in its files where it does not.

The plugin writes its own copy over its file, so that one is never touched while mosquitto runs.
"""

import getpass
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from pebble.config.web import is_loopback
from pebble.fleet import broker_files, certificates, dynsec
from pebble.fleet.broker_client import Place, RefusedError, UnreachableError
from pebble.fleet.folder import (
    ACL,
    ADMIN,
    ADMIN_PASSWORD,
    CONF,
    PASSWORDS,
    PID,
    SECURITY,
    ZENOH,
    Fleet,
    FleetError,
    Server,
    save,
)
from pebble.fleet.roles import Account, Role
from pebble.fleet.whole_file import write

_LOOPBACK = "127.0.0.1"
_ANEW = f"(stop mosquitto, then `pebble fleet password {ADMIN}`)"
PLUGINS = ("/usr/lib", "/usr/local/lib", "/opt/homebrew/lib")
PLUGIN = "mosquitto_dynamic_security.so"
_STARTING_S = 3.0  # a small board loads many accounts


def found_plugin() -> Path | None:
    """Where mosquitto's dynamic-security plugin is installed."""
    for folder in map(Path, PLUGINS):
        for found in (folder / PLUGIN, *folder.glob(f"*/{PLUGIN}")):
            if found.is_file():
                return found
    return None


def make(
    folder: Path,
    fleet: Fleet,
    plugin: Path | None,
    passwords: Mapping[str, str] | None = None,
    others: Sequence[str] = (),
) -> str:
    """Write all files of a new fleet, and its account for changes. Returns that one's password. Raises PebbleError.

    ``passwords``: of the accounts that it begins with. ``others``: machines of the fleet that the broker's certificate
    names, too, and that its authority may sign for. A broker that is ``included`` has its configuration elsewhere.
    """
    if (folder / CONF).exists():
        raise FleetError(f"{folder / CONF} exists already: name another folder")
    server = fleet.brokers[0]
    password = broker_files.new_password()
    fleet = fleet.with_account(ADMIN, Account(roles=(Role.ADMIN,)))
    certificates.init(folder, [*names_of(server), *others])
    folder.chmod(0o700)
    given = {**(passwords or {}), ADMIN: password}
    _write_rules(folder, fleet, {name: broker_files.hashed(one) for name, one in given.items()})
    write(folder / ADMIN_PASSWORD, f"{password}\n".encode(), 0o600, FleetError)
    if not server.included:
        write_conf(folder, fleet, plugin)
    save(folder, fleet)
    return password


def names_of(server: Server) -> list[str]:
    """The names in the broker's certificate; by the last ones this machine changes accounts."""
    return list(dict.fromkeys((server.host, "localhost", _LOOPBACK)))


def write_conf(folder: Path, fleet: Fleet, plugin: Path | None) -> None:
    text = broker_files.conf_text(fleet, folder, plugin, getpass.getuser())
    write(folder / CONF, text.encode(), 0o644, FleetError)


def conf_differences(folder: Path, fleet: Fleet) -> Iterator[str]:
    """Lines of `mosquitto.conf` that are not what :func:`write_conf` wrote: another listener is another door.

    They may be there for a reason, so no command takes them back.
    """
    file = folder / CONF
    try:
        found = file.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise FleetError(f"{file}: {error.strerror}") from None
    plugin = next((Path(line.split()[1]) for line in found if line.startswith("plugin /")), None)
    user = next((line.split()[1] for line in found if line.startswith("user ")), "")
    wanted = broker_files.conf_text(fleet, folder, plugin, user).splitlines()
    own = (line for line in found if line.strip() and line not in wanted)
    yield from (f"{file}: has a line of its own: {line}: remove it there, then restart mosquitto" for line in own)
    lacking = (line for line in wanted if line not in found)
    yield from (f"{file}: is without the line: {line}: add it there, then restart mosquitto" for line in lacking)


def apply(folder: Path, before: Fleet, after: Fleet, passwords: Mapping[str, str] | None = None) -> str:
    """Make all brokers of the fleet know ``after``, then write `fleet.json`. Returns how, in words.

    Raises FleetError if a broker does not know it then; `fleet.json` stays as it is, and hubs and all others know it.
    """
    new = passwords or {}
    if after.hubs != "none":
        write_zenoh(folder, after)
    how = change_brokers(folder, before, after, new)
    if ADMIN in new:
        write(folder / ADMIN_PASSWORD, f"{new[ADMIN]}\n".encode(), 0o600, FleetError)
    save(folder, after)
    return how


def copies(folder: Path, fleet: Fleet) -> Iterator[str]:
    """Where copies of the folder's rules count, which no command reaches: there nothing changes until they are new."""
    if fleet.rules == "files":
        anew = f"its copies of {folder / ACL} and {PASSWORDS}: copy them again, and send it SIGHUP"
        yield from (f"broker {server.host}:{server.port} obeys {anew}" for server in fleet.brokers[1:])
    if fleet.hubs == "elsewhere":
        yield f"Zenoh hubs obey their copies of {folder / ZENOH}: copy it again, they have read it within two seconds"


def write_zenoh(folder: Path, fleet: Fleet) -> None:
    """Write the rules for Zenoh hubs; one that reads them here obeys within a second or two. Raises FleetError."""
    from pebble.fleet.zenoh_rules import zenoh_text  # Zenoh, which few fleets need

    write(folder / ZENOH, zenoh_text(fleet), 0o644, FleetError)


def zenoh_differences(folder: Path, fleet: Fleet) -> Iterator[str]:
    """Whether the rules for Zenoh hubs are not those of the table."""
    from pebble.fleet.zenoh_rules import zenoh_text

    file = folder / ZENOH
    if fleet.hubs != "none" and not (file.is_file() and file.read_bytes() == zenoh_text(fleet)):
        yield f"{file} does not hold the rules of the table"


def change_brokers(folder: Path, before: Fleet, after: Fleet, passwords: Mapping[str, str]) -> str:
    """The same without `fleet.json`."""
    if after.rules == "files":
        return _apply_files(folder, before, after, passwords)
    wanted = list(dynsec.changes(before, after, passwords))
    return _apply_commands(folder, after, lambda _control: wanted, before, passwords)


def repair(folder: Path, fleet: Fleet) -> str:
    """Give every account the rules of the table again."""
    if fleet.rules == "files":
        return _apply_files(folder, fleet, fleet, {})
    return _apply_commands(folder, fleet, partial(dynsec.repairs, fleet), fleet, {})


def pid_of(folder: Path) -> int | None:
    """The process of the mosquitto of this folder, on this machine; None: it does not run."""
    try:
        pid = int((folder / PID).read_text(encoding="utf-8"))
        name = Path(f"/proc/{pid}/cmdline").read_bytes()
    except (OSError, ValueError):
        return None
    return pid if b"mosquitto" in name else None


def passwords_of(folder: Path, fleet: Fleet) -> dict[str, broker_files.Hashed]:
    """Read those of the fleet's accounts from its files. Raises FleetError."""
    file = folder / (SECURITY if fleet.rules == "plugin" else PASSWORDS)
    read = broker_files.passwords_in_security if fleet.rules == "plugin" else broker_files.passwords_in
    try:
        found = read(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise FleetError(f"{file}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise FleetError(f"{file} cannot be read: restore it from a copy, or make a new fleet") from None
    return {name: one for name, one in found.items() if name in fleet.accounts}


def places(folder: Path, server: Server, *, own: bool) -> Iterator[Place]:
    """Where to reach a broker: that of this folder at this machine first."""
    ca = folder / certificates.CA_CERT
    if own and not is_loopback(server.host):
        yield Place(_LOOPBACK, server.port, ca)
    yield Place(server.host, server.port, ca)


def admin_password(folder: Path) -> str:
    """Raises FleetError."""
    file = folder / ADMIN_PASSWORD
    try:
        return file.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise FleetError(f"{file}: {error.strerror} {_ANEW}") from None


def control(folder: Path, server: Server, *, own: bool) -> dynsec.Control | None:
    """A connection that may change accounts; None: the broker of this folder does not run. Raises FleetError."""
    pid = pid_of(folder) if own else None
    if own and pid is None and not (folder / ADMIN_PASSWORD).exists():
        return None  # so that it can be made anew
    why: UnreachableError | None = None
    for place in places(folder, server, own=own):
        try:
            return dynsec.Control(place, ADMIN, admin_password(folder))
        except UnreachableError as error:
            why = error
        except RefusedError as error:
            raise FleetError(f"{error} {_ANEW}") from None
    if pid is not None:
        raise FleetError(f"{why}, but mosquitto runs there (process {pid}): end it, or wait until it answers")
    if not own:
        raise FleetError(f"{why}: it was not changed")
    return None


# -- inside


def _apply_commands(
    folder: Path,
    after: Fleet,
    commands: Callable[[dynsec.Control], Iterable[dynsec.Command]],
    before: Fleet,
    new: Mapping[str, str],
) -> str:
    how, failed = "", list[str]()
    for number, server in enumerate(after.brokers):
        try:  # a broker that is away keeps no other one from knowing it
            connection = control(folder, server, own=number == 0)
            if connection is None:
                known = passwords_of(folder, before)
                _write_rules(folder, after, known | {name: broker_files.hashed(one) for name, one in new.items()})
                how = f"in {folder / SECURITY}: mosquitto does not run"
                continue
            with connection:
                if ADMIN in new:
                    raise FleetError(f"mosquitto runs: stop it first, because it is changed by the account {ADMIN}")
                connection.send(commands(connection))
            how = how or "at once"
        except FleetError as error:
            failed.append(str(error))
    if failed:
        raise FleetError("\n".join(failed))
    return how


def _apply_files(folder: Path, before: Fleet, after: Fleet, new: Mapping[str, str]) -> str:
    known = passwords_of(folder, before)
    _write_rules(folder, after, known | {name: broker_files.hashed(one) for name, one in new.items()})
    pid = pid_of(folder)
    if pid is None:
        return f"in {folder / ACL}: mosquitto does not run"
    try:
        _await_handler(pid)
        os.kill(pid, signal.SIGHUP)
    except OSError as error:
        raise FleetError(f"mosquitto (process {pid}): {error.strerror}; send it SIGHUP: sudo kill -HUP {pid}") from None
    return "at once"


def _await_handler(pid: int) -> None:
    """Wait while mosquitto starts: it listens before it handles SIGHUP, which would end it (2.0.11, measured)."""
    deadline = time.monotonic() + _STARTING_S
    while time.monotonic() < deadline:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
        caught = next((line.split()[1] for line in status.splitlines() if line.startswith("SigCgt:")), "0")
        if int(caught, 16) >> (signal.SIGHUP - 1) & 1:
            return
        time.sleep(0.01)


def _write_rules(folder: Path, fleet: Fleet, passwords: Mapping[str, broker_files.Hashed]) -> None:
    known = {name: passwords[name] for name in fleet.accounts if name in passwords}
    texts: dict[str, Callable[[], str]] = (
        {SECURITY: lambda: broker_files.security_text(fleet, known)}
        if fleet.rules == "plugin"
        else {PASSWORDS: lambda: broker_files.passwords_text(known), ACL: lambda: broker_files.acl_text(fleet)}
    )
    for name, text in texts.items():
        write(folder / name, text().encode(), 0o600, FleetError)
