"""The files of a mosquitto broker, made from a fleet: configuration, rules, passwords. Pure: text in, text out."""

import base64
import hashlib
import json
import os
import secrets
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pebble.config.web import is_loopback
from pebble.fleet.certificates import CA_CERT, SERVER_CERT, SERVER_KEY
from pebble.fleet.folder import ACL, CONF, PASSWORDS, PID, PLAIN_PORT, SECURITY, Fleet
from pebble.fleet.roles import Rule

#: As mosquitto's own tools. More would hold up the broker's one thread at each login, and gain nothing: passwords are
#: random, with 79 bits.
ITERATIONS = 101
_ALPHABET = "abcdefghjkmnpqrstuvwxyz23456789"  # no 0 o, 1 l i
_MAX_MESSAGE, MAX_CONNECTIONS = 1024 * 1024, 4000  # twice what one page shows
_SUBSCRIBES = {"publishClientSend": False, "publishClientReceive": False, "subscribe": True, "unsubscribe": True}
_ACL_TYPES, _SUBSCRIBE = {"write": "publishClientSend", "read": "publishClientReceive"}, "subscribePattern"


class Hashed(NamedTuple):
    """A password as a broker stores it."""

    salt: str
    hash: str
    iterations: int = ITERATIONS

    def is_of(self, password: str) -> bool:
        salt = base64.b64decode(self.salt)
        digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, self.iterations)
        return base64.b64encode(digest).decode() == self.hash


def new_password() -> str:
    """Four groups of four that can be typed on a phone."""
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(4)) for _ in range(4))


def hashed(password: str) -> Hashed:
    salt = os.urandom(12)
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, ITERATIONS)
    return Hashed(base64.b64encode(salt).decode(), base64.b64encode(digest).decode())


def conf_text(fleet: Fleet, folder: Path, plugin: Path | None, user: str) -> str:
    """`mosquitto.conf`; all paths are absolute."""
    server = fleet.brokers[0]
    where = f" {server.host}" if is_loopback(server.host) else ""
    tls = [f"cafile {folder / CA_CERT}", f"certfile {folder / SERVER_CERT}", f"keyfile {folder / SERVER_KEY}"]
    limit = f"max_connections {MAX_CONNECTIONS}"
    by = "setup`" if server.included else f"fleet init`; run `mosquitto -c {folder / CONF}`"
    lines = [f"# Written by `pebble {by}.", "per_listener_settings false"]
    lines.append("allow_anonymous false")
    if not server.included:
        lines += [f"user {user}", f"pid_file {folder / PID}", "log_dest stderr"]
        lines += ["persistence true", f"persistence_location {folder}/", "persistent_client_expiration 1d"]
    if plugin is None:
        lines += [f"acl_file {folder / ACL}", f"password_file {folder / PASSWORDS}"]
    else:
        lines += [f"plugin {plugin}", f"plugin_opt_config_file {folder / SECURITY}"]
    lines += [f"message_size_limit {_MAX_MESSAGE}", "set_tcp_nodelay true"]
    lines += [f"listener {server.port}{where}", *tls, "tls_version tlsv1.2", limit]
    if server.unencrypted is not None:
        lines += [f"listener {server.unencrypted}{where}", limit]
    if server.included:
        lines += [f"listener {PLAIN_PORT} 127.0.0.1", limit]
    return "\n".join(lines) + "\n"


# -- by the plugin


def role_of(name: str) -> str:
    """The plugin's name for the rules of one account."""
    return f"account-{name}"


def acls(rules: Iterable[Rule]) -> list[dict[str, Any]]:
    """Rules as the plugin has them. A subscription to what begins with `$` needs a rule."""
    return [
        {"acltype": type_, "topic": filter_, "priority": 0, "allow": True}
        for access, filter_ in rules
        for type_ in (_ACL_TYPES[access], *((_SUBSCRIBE,) if access == "read" and filter_.startswith("$") else ()))
    ]


def rules_in(acls: Iterable[Mapping[str, Any]]) -> set[Rule | str]:
    """The other way round; what is no rule of ours is a text."""
    access = {type_: one for one, type_ in _ACL_TYPES.items()} | {_SUBSCRIBE: "read"}
    return {
        Rule(access[one["acltype"]], one["topic"])
        if one["acltype"] in access and one["allow"]
        else f"{'allow' if one['allow'] else 'deny'} {one['acltype']} {one['topic']}"
        for one in acls
    }


def default_access() -> list[dict[str, Any]]:
    """What the plugin lets everybody do. Subscribing is free, because what is delivered is checked one by one: so a
    program that asks for more than it may see gets the rest, as with `acl`."""
    return [{"acltype": type_, "allow": allow} for type_, allow in _SUBSCRIBES.items()]


def security_text(fleet: Fleet, passwords: Mapping[str, Hashed]) -> str:
    """`dynamic-security.json`. Accounts without a password are left out: they cannot log in."""
    names = [name for name in fleet.accounts if name in passwords]
    clients = [
        {"username": name, "roles": [{"rolename": role_of(name)}]}
        | {"password": passwords[name].hash, "salt": passwords[name].salt, "iterations": passwords[name].iterations}
        for name in names
    ]
    roles = [{"rolename": role_of(name), "acls": acls(fleet.rules_of(name))} for name in names]
    whole = {"defaultACLAccess": _SUBSCRIBES, "clients": clients, "groups": [], "roles": roles}
    return json.dumps(whole, separators=(",", ":")) + "\n"


def passwords_in_security(text: str) -> dict[str, Hashed]:
    """Raises ValueError, KeyError for what is no such file."""
    return {
        one["username"]: Hashed(one["salt"], one["password"], one["iterations"])
        for one in json.loads(text)["clients"]
        if one.get("password")
    }


# -- by files


def acl_text(fleet: Fleet) -> str:
    """`acl`, of all accounts."""
    return "".join(
        f"user {name}\n" + "".join(f"topic {access} {filter_}\n" for access, filter_ in fleet.rules_of(name)) + "\n"
        for name in fleet.accounts
    )


def passwords_text(passwords: Mapping[str, Hashed]) -> str:
    """`passwords`, as `mosquitto_passwd` writes it."""
    return "".join(f"{name}:$7${one.iterations}${one.salt}${one.hash}\n" for name, one in passwords.items())


def passwords_in(text: str) -> dict[str, Hashed]:
    """Raises ValueError for what is no such file."""
    found = {}
    for line in filter(None, map(str.strip, text.splitlines())):
        name, _, rest = line.partition(":")
        _, kind, iterations, salt, hash_ = rest.split("$")
        if kind != "7":
            raise ValueError(f"{name}: a password of kind {kind}")
        found[name] = Hashed(salt, hash_, int(iterations))
    return found


def rules_in_acl(text: str) -> dict[str, set[Rule | str]]:
    """The rules of each account; those before the first one, which hold for everybody, are of the account ``""``."""
    found: dict[str, set[Rule | str]] = {}
    name = ""
    for line in filter(None, map(str.strip, text.splitlines())):
        word, _, rest = line.partition(" ")
        access, _, filter_ = rest.partition(" ")
        if word == "user":
            name = rest
            found.setdefault(name, set())
        elif word == "topic" and access in _ACL_TYPES:
            found.setdefault(name, set()).add(Rule(access, filter_))
        elif not word.startswith("#"):
            found.setdefault(name, set()).add(line)
    return found
