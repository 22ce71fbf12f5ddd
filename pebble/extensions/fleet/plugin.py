"""Converts a fleet made for mosquitto's dynamic-security plugin, by an earlier version, to one of files."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from pebble.extensions.fleet.applying import write_rules
from pebble.extensions.fleet.broker_files import Hashed
from pebble.extensions.fleet.folder import Fleet, FleetError, save
from pebble.ownership import read_plain

SECURITY = "dynamic-security.json"


def convert(folder: Path, fleet: Fleet) -> tuple[Fleet, list[str]]:
    """Write the plugin's passwords, and the access rules of ``fleet``, as files, and save the fleet.

    Return the fleet as saved, and a line for each account that was left out. Raises FleetError. The plugin's own file
    stays; mosquitto uses it until its configuration is changed.
    """
    file = folder / SECURITY
    try:
        clients = {client["username"]: client for client in json.loads(read_plain(file))["clients"]}
    except OSError as error:
        raise FleetError(f"{file}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise FleetError(f"{file} is no file of the dynamic-security plugin: restore it from a copy") from None
    after = replace(fleet, rules="files")
    hashed = {
        name: Hashed(client["salt"], client["password"], client["iterations"])
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
