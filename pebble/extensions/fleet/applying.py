"""Applies changes of a fleet: writes the files of brokers and hubs from its table, and makes mosquitto reload them.

Also finds what differs between table and files, and certificates that expire soon.
"""

import json
import os
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from pebble.config.text_files import NotTextError, text_of
from pebble.extensions.fleet import broker_files, certificates
from pebble.extensions.fleet.folder import ACL, CONF, PASSWORDS, PID, ZENOH, Fleet, FleetError, Server, save
from pebble.ownership import read_plain
from pebble.runtime.as_owner import as_before
from pebble.runtime.whole_file import is_root, set_mode, write

_LOOPBACK = "127.0.0.1"
_PLUGIN, _SECURITY = "dynamic_security", "dynamic-security.json"  # in the name of its library; its file
_STARTING_S = 3.0  # a small board loads many accounts
_SOON_DAYS = 30  # before a certificate ends


def make(folder: Path, fleet: Fleet, passwords: Mapping[str, str] | None = None, others: Sequence[str] = ()) -> None:
    """Write all files of a new fleet. Raises PebbleError.

    ``passwords``: those of its first accounts. ``others``: more machines of the fleet, which the broker's certificate
    also names and for which its authority may sign. An ``included`` broker gets no `mosquitto.conf`: it has its own.
    """
    if (folder / CONF).exists():
        raise FleetError(f"{folder / CONF} exists already: name another folder")
    if not str(folder).isprintable():
        raise FleetError(f"{folder}: this name cannot stand in {CONF}: name another folder")
    server = fleet.brokers[0]
    certificates.init(folder, [*names_of(server), *others])
    set_mode(folder, 0o700)
    write_rules(folder, fleet, {name: broker_files.hashed(password) for name, password in (passwords or {}).items()})
    if not server.included:
        write_conf(folder, fleet)
    save(folder, fleet)


def names_of(server: Server) -> list[str]:
    """Return the names for the broker's certificate; the last ones are for programs on the broker's machine."""
    return list(dict.fromkeys((server.host, "localhost", _LOOPBACK)))


def write_conf(folder: Path, fleet: Fleet) -> None:
    text = broker_files.conf_text(fleet, folder, folder.owner())
    write(folder / CONF, text.encode(), 0o644, FleetError)


def conf_differences(folder: Path, fleet: Fleet) -> Iterator[str]:
    """Yield in words each line of `mosquitto.conf` that :func:`write_conf` would not write, and each that it lacks.

    A line too many may open another listener, or may have a reason, so no command removes it.
    """
    file = folder / CONF
    lines = _text(file).splitlines()
    user = next((line.split()[1] for line in lines if line.startswith("user ")), "")
    wanted = broker_files.conf_text(fleet, folder, user).splitlines()
    too_many = (line for line in lines if line.strip() and line not in wanted)
    yield from (f"{file}: has a line of its own: {line}: remove it there, then restart mosquitto" for line in too_many)
    lacking = (line for line in wanted if line not in lines)
    yield from (f"{file}: is without the line: {line}: add it there, then restart mosquitto" for line in lacking)


def _text(file: Path) -> str:
    """Return the text of a file of the folder. Raises FleetError."""
    try:
        return text_of(read_plain(file))
    except OSError as error:
        raise FleetError(f"{file}: {error.strerror}") from None
    except NotTextError as error:
        raise FleetError(f"{file} {error}") from None


def apply(folder: Path, fleet: Fleet, passwords: Mapping[str, str] | None = None) -> str:
    """Write the rules, make broker and hubs use them, then write `fleet.json`; return in words what was done.

    ``passwords``: new ones. Raises FleetError if the broker does not use the rules; then `fleet.json` stays as it is.
    """
    if obeys_plugin(folder):
        why = "mosquitto still obeys its dynamic-security plugin: `pebble fleet apply` prints the lines to change"
        raise FleetError(f"{folder / CONF}: {why}")
    if fleet.hubs != "none":
        write_zenoh(folder, fleet)
    new = {name: broker_files.hashed(password) for name, password in (passwords or {}).items()}
    write_rules(folder, fleet, passwords_of(folder) | new)
    how = _reload(folder)
    save(folder, fleet)
    return how


def copies(folder: Path, fleet: Fleet) -> Iterator[str]:
    """Yield the places to which the folder's rules were copied. A change applies there once they are copied again."""
    again = f"its copies of {folder / ACL} and {PASSWORDS}: copy them again, and send it SIGHUP"
    yield from (f"broker {server.host}:{server.port} obeys {again}" for server in fleet.brokers[1:])
    if fleet.hubs == "elsewhere":
        yield f"Zenoh hubs obey their copies of {folder / ZENOH}: copy it again, they have read it within two seconds"


def write_zenoh(folder: Path, fleet: Fleet) -> None:
    """Write the rules for Zenoh hubs; a hub that reads them here obeys within two seconds. Raises FleetError."""
    from pebble.extensions.fleet.zenoh_rules import zenoh_text  # Zenoh, which few fleets need

    write(folder / ZENOH, zenoh_text(fleet), 0o644, FleetError)


def _zenoh_differences(folder: Path, fleet: Fleet) -> Iterator[str]:
    """Yield a line if the rules for Zenoh hubs differ from the table."""
    from pebble.extensions.fleet.zenoh_rules import zenoh_text

    file = folder / ZENOH
    if fleet.hubs != "none" and not (file.is_file() and read_plain(file) == zenoh_text(fleet)):
        yield f"{file} does not hold the rules of the table"


def pid_of(folder: Path) -> int | None:
    """Return the process id of this folder's mosquitto on this machine; None if it does not run."""
    try:
        pid = int(read_plain(folder / PID))
    except (OSError, ValueError):
        return None
    with as_before():  # as root again, if inside of as_owner: only root sees all processes
        return pid if _is_broker(pid) else None


def _is_broker(pid: int) -> bool:
    """True if this process is mosquitto. The pid file is no proof: the folder's owner can write any number there."""
    try:
        if is_root():  # other users see the file of their own processes only; an upgrade adds " (deleted)" to its name
            return bytes(Path(f"/proc/{pid}/exe").readlink()).removesuffix(b" (deleted)").endswith(b"/mosquitto")
        return b"mosquitto" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def obeys_plugin(folder: Path) -> bool:
    """True if mosquitto uses the dynamic-security plugin, by its configuration or in the running process."""
    pid = pid_of(folder)
    lines = _text(folder / CONF).splitlines() if (folder / CONF).exists() else []
    if any(line.startswith("plugin ") and _PLUGIN in line for line in lines):
        return True
    # If mosquitto runs as another user, only root can read this. Then only root can make it reload its files, too.
    with suppress(OSError), as_before():  # as root again, if this command began as root
        return _PLUGIN in Path(f"/proc/{pid}/maps").read_text(encoding="utf-8")
    return False


def passwords_of(folder: Path) -> dict[str, broker_files.Hashed]:
    """Return the hashed passwords in the broker's file, by account. Raises FleetError."""
    file = folder / PASSWORDS
    try:
        return broker_files.passwords_in(_text(file))
    except ValueError:
        raise FleetError(f"{file} cannot be read: restore it from a copy, or make a new fleet") from None


def write_rules(folder: Path, fleet: Fleet, passwords: Mapping[str, broker_files.Hashed]) -> None:
    """Write the two files that mosquitto reads. Raises FleetError.

    Accounts without a password cannot log in.
    """
    stored = {name: passwords[name] for name in fleet.accounts if name in passwords}
    for name, text in ((PASSWORDS, broker_files.passwords_text(stored)), (ACL, broker_files.acl_text(fleet))):
        write(folder / name, text.encode(), 0o600, FleetError)


def _reload(folder: Path) -> str:
    """Make mosquitto reload its files, and disconnect accounts that lost their access; return what was done."""
    pid = pid_of(folder)
    if pid is None:
        return f"in {folder / ACL}: mosquitto does not run"
    try:
        with as_before():  # the broker may run as another user than the folder's
            process = os.pidfd_open(pid)
            try:
                if _is_broker(pid):  # and no other process that has got its number meanwhile
                    if not _handles_signal(pid):  # not yet: it has just started
                        raise FleetError(f"mosquitto (process {pid}) would end by SIGHUP: give this command again")
                    signal.pidfd_send_signal(process, signal.SIGHUP)
            finally:
                os.close(process)
    except OSError as error:
        raise FleetError(f"mosquitto (process {pid}): {error.strerror}; send it SIGHUP: sudo kill -HUP {pid}") from None
    return "at once"


def _handles_signal(pid: int) -> bool:
    """True if mosquitto handles SIGHUP within _STARTING_S. At first SIGHUP would end it (2.0.11, measured)."""
    deadline = time.monotonic() + _STARTING_S
    while time.monotonic() < deadline:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
        mask = next((line.split()[1] for line in status.splitlines() if line.startswith("SigCgt:")), "0")
        if int(mask, 16) >> (signal.SIGHUP - 1) & 1:  # a bit for each signal that it handles
            return True
        time.sleep(0.01)
    return False


# -- what differs


def by_hand(folder: Path, fleet: Fleet) -> list[str]:
    """Return the differences that no command removes, each with what to do. Raises FleetError."""
    return [*conf_differences(folder, fleet), *_certificates(folder, fleet)]


def of_rules(folder: Path, fleet: Fleet) -> list[str]:
    """Return the differences of accounts and rules, which `pebble fleet apply` removes. Raises FleetError."""
    return [*_zenoh_differences(folder, fleet), *_of_acl(folder, fleet), *_of_passwords(folder, fleet)]


def _certificates(folder: Path, fleet: Fleet) -> Iterator[str]:
    renewals = {folder / certificates.SERVER_CERT: f"`pebble cert renew --folder {folder}`, then restart mosquitto"}
    for name in fleet.accounts:
        file = folder / certificates.ACCOUNTS / f"{name}.pem"
        if file.exists():
            renewals[file] = f"`pebble fleet certificate {name}`, with its hosts, and move it to its machine"
    for file, how in renewals.items():
        days = certificates.show(file).days_left
        if days < _SOON_DAYS:
            yield f"{file} ends in {days:.0f} days: {how}"


def _of_acl(folder: Path, fleet: Fleet) -> Iterator[str]:
    present_rules = dict.fromkeys(broker_files.rules_in(_text(folder / ACL)))
    wanted = dict.fromkeys(broker_files.rules_in(broker_files.acl_text(fleet)))
    yield from (f"one rule too many: {rule}" for rule in present_rules if rule not in wanted)
    yield from (f"one rule too few: {rule}" for rule in wanted if rule not in present_rules)


def _of_passwords(folder: Path, fleet: Fleet) -> Iterator[str]:
    stored = passwords_of(folder)
    yield from (f"{name}: an account too many: the broker lets it in" for name in stored.keys() - fleet.accounts)
    yield from (f"{name}: has no password: `pebble fleet password {name}`" for name in fleet.accounts - stored.keys())


# -- a fleet that an earlier version made for mosquitto's dynamic-security plugin


def convert(folder: Path, fleet: Fleet) -> tuple[Fleet, list[str]]:
    """Write the plugin's passwords, and the access rules of ``fleet``, as files, and save the fleet.

    Return the fleet as saved, and a line for each account that was left out. Raises FleetError. The plugin's own file
    stays; mosquitto uses it until its configuration is changed.
    """
    file = folder / _SECURITY
    try:
        clients = {client["username"]: client for client in json.loads(read_plain(file))["clients"]}
    except OSError as error:
        raise FleetError(f"{file}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise FleetError(f"{file} is no file of the dynamic-security plugin: restore it from a copy") from None
    after = replace(fleet, rules="files")
    hashed = {
        name: broker_files.Hashed(client["salt"], client["password"], client["iterations"])
        for name, client in clients.items()
        if _gets_in(name, client)
    }
    write_rules(folder, after, hashed)
    save(folder, after)
    return after, list(_left_out(fleet, clients))


def _left_out(fleet: Fleet, clients: dict[str, dict[str, Any]]) -> Iterator[str]:
    for name in sorted(clients.keys() - fleet.accounts.keys()):
        yield f"{name}: is an account of the plugin that fleet.json does not have: left out"
    for name in fleet.accounts:
        if not _gets_in(name, clients.get(name, {})):
            yield f"{name}: has no password that is valid at the plugin: `pebble fleet password {name}` gives a new one"


def _gets_in(name: str, client: dict[str, Any]) -> bool:
    """True if the plugin accepts this account's login and has its role, and the password has the form of our files."""
    has_role = any(role.get("rolename") == f"account-{name}" for role in client.get("roles", ()))
    return has_role and not client.get("disabled") and all(map(client.get, ("salt", "password", "iterations")))
