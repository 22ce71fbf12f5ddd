"""Parts of configs for a fleet's accounts: the address to connect to, and the credentials."""

from __future__ import annotations

from typing import Any

from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.folder import ZENOH, Fleet
from pebble.extensions.fleet.roles import ProgramRole

HUB_PORT = 7447


def of_broker(fleet: Fleet, name: str, secret: str, *, board: bool) -> dict[str, Any]:
    """Return the part of a robot's config that connects it to the fleet's broker; ``secret``: its password.

    ``board``: the robot is an MCU alone, whose only broker is ``local_mqtt``.
    """
    server = fleet.brokers[0]
    login = {"host": server.host, "port": server.port, "username": name, "password": secret}
    link = login | {"tls": {"enabled": True, "ca_cert": certificates.CA_CERT}}
    part = {"local_mqtt": link} if board else {"services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": link}}}
    return {**_who(fleet, name), **part}


def of_certificate(fleet: Fleet, name: str) -> dict[str, Any]:
    """Return the settings of an account that has a certificate; empty if its roles need none.

    A hub gets its whole file, a robot or a neighbour the part of its config that connects it to the hub. The files that
    the settings name, of the account and of the authority, are expected in the same folder.
    """
    roles = fleet.accounts[name].roles
    at_hub = _at_hub(fleet, name, certificates.CA_CERT, name)  # its certificate's files have the account's name
    if ProgramRole.HUB in roles:
        return hub_file(name) | {"journal": f"{name}.journal"}
    if ProgramRole.ROBOT in roles:
        remote = {"kind": "zenoh", **at_hub}
        return {**_who(fleet, name), "services": {"mqtt_bridge": {"enabled": True, "remote": remote}}}
    if ProgramRole.NEIGHBOUR in roles:
        return {"robot": _who(fleet, name)["robot"], "services": {"neighbours": {"enabled": True, "lan": at_hub}}}
    return {}


def hub_file(keys: str) -> dict[str, Any]:
    """Return the file of a hub that uses the rules in its folder.

    ``keys``: the path of its certificate and key without their suffix.
    """
    return {"listen": [f"tls/0.0.0.0:{HUB_PORT}"], "tls": _tls(certificates.CA_CERT, keys), "access": ZENOH}


def boards_file(fleet: Fleet, name: str, below: str) -> dict[str, Any]:
    """Return the config file of the boards' gateway, which logs in as ``name``; its password is in a file beside it.

    The gateway also connects to the LAN's hub, once for each board, with the account that the board has as a neighbour.
    ``below``: the prefix in that file for paths of certificates, which are in the fleet's folder.
    """
    server, ca = fleet.brokers[0], below + certificates.CA_CERT
    login = {"username": name, "password_file": f"{name}-password", "tls": {"enabled": True, "ca_cert": ca}}
    neighbours = {
        account.bases[0]: {"lan": _at_hub(fleet, neighbour, ca, f"{below}{certificates.ACCOUNTS}/{neighbour}")}
        for neighbour, account in fleet.accounts.items()
        if ProgramRole.NEIGHBOUR in account.roles and account.bases[0] in fleet.accounts[name].bases
    }
    return {"id": name, "boards": {"host": server.host, "port": server.port, **login}, "neighbours": neighbours}


def _at_hub(fleet: Fleet, name: str, ca: str, keys: str) -> dict[str, Any]:
    """Return the settings by which this account connects to the fleet's hub."""
    return {"account": name, "connect": [f"tls/{fleet.brokers[0].host}:{HUB_PORT}"], "tls": _tls(ca, keys)}


def _tls(ca: str, keys: str) -> dict[str, Any]:
    return {"enabled": True, "ca_cert": ca, "client_cert": f"{keys}.pem", "client_key": f"{keys}.key"}


def _who(fleet: Fleet, name: str) -> dict[str, Any]:
    """Return the robot section and the security level of an account's config.

    The robot section names the account's base: messages below any other base would be dropped in silence.
    """
    account = fleet.accounts[name]
    parts = dict(zip(("system", "type", "id"), account.bases[0].split("/"), strict=True))
    defaults = {"system": "pebble", "type": "robots"}
    robot = {key: part for key, part in parts.items() if part != defaults.get(key)}
    level = "login" if account.plain else fleet.level  # a plain robot takes commands without account names
    return {"robot": robot, "security": {"level": level}}
