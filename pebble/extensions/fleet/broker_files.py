"""The files of a mosquitto broker, made from a fleet: configuration, rules, passwords. Pure: text in, text out."""

import base64
import hashlib
import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from pebble.config.hosts import is_loopback
from pebble.extensions.fleet.certificates import CA_CERT, SERVER_CERT, SERVER_KEY
from pebble.extensions.fleet.folder import ACL, CONF, PASSWORDS, PID, PLAIN_PORT, Fleet

#: As mosquitto's own tools. More would hold up the broker's one thread at each login, and gain nothing: passwords are
#: random, with 79 bits.
ITERATIONS = 101
_ALPHABET = "abcdefghjkmnpqrstuvwxyz23456789"  # no 0 o, 1 l i
_MAX_MESSAGE, MAX_CONNECTIONS = 1024 * 1024, 4000  # twice what one page shows


class Hashed(NamedTuple):
    """A hashed password, as the broker stores it."""

    salt: str
    hash: str
    iterations: int = ITERATIONS

    def is_of(self, password: str) -> bool:
        salt = base64.b64decode(self.salt)
        digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, self.iterations)
        return base64.b64encode(digest).decode() == self.hash


def new_password() -> str:
    """Return a new password of four groups of four letters, easy to type on a phone."""
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(4)) for _ in range(4))


def hashed(password: str) -> Hashed:
    salt = os.urandom(12)
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, ITERATIONS)
    return Hashed(base64.b64encode(salt).decode(), base64.b64encode(digest).decode())


def conf_text(fleet: Fleet, folder: Path, user: str) -> str:
    """Return the text of `mosquitto.conf`. All its paths are absolute.

    If the machine's own mosquitto includes the text, it is only a part, without user, pid file, log and persistence.
    """
    server = fleet.brokers[0]
    where = f" {server.host}" if is_loopback(server.host) else ""
    tls = [f"cafile {folder / CA_CERT}", f"certfile {folder / SERVER_CERT}", f"keyfile {folder / SERVER_KEY}"]
    limit = f"max_connections {MAX_CONNECTIONS}"
    made_by = "`pebble setup`" if server.included else f"`pebble fleet init`; run `mosquitto -c {folder / CONF}`"
    lines = [f"# Written by {made_by}.", "per_listener_settings false"]
    lines.append("allow_anonymous false")
    if not server.included:
        lines += [f"user {user}", f"pid_file {folder / PID}", "log_dest stderr"]
        lines += ["persistence true", f"persistence_location {folder}/", "persistent_client_expiration 1d"]
    lines += [f"acl_file {folder / ACL}", f"password_file {folder / PASSWORDS}"]
    lines += [f"message_size_limit {_MAX_MESSAGE}", "set_tcp_nodelay true"]
    lines += [f"listener {server.port}{where}", *tls, "tls_version tlsv1.2", limit]
    if server.unencrypted is not None:
        lines += [f"listener {server.unencrypted}{where}", limit]
    if server.included:  # for programs of this machine: see Server
        lines += [f"listener {PLAIN_PORT} 127.0.0.1", limit]
    return "\n".join(lines) + "\n"


def acl_text(fleet: Fleet) -> str:
    """Return the text of the file `acl`: the rules of all accounts."""
    lines = []
    for name in fleet.accounts:
        rules = (f"topic {access} {filter_}" for access, filter_ in fleet.rules_of(name))
        lines += [f"user {name}", *rules, ""]
    return "".join(f"{line}\n" for line in lines)


def passwords_text(passwords: Mapping[str, Hashed]) -> str:
    """Return the text of the file `passwords`, in the form that `mosquitto_passwd` writes."""
    return "".join(f"{name}:$7${hashed.iterations}${hashed.salt}${hashed.hash}\n" for name, hashed in passwords.items())


def passwords_in(text: str) -> dict[str, Hashed]:
    """Return the hashed passwords in the text of a file `passwords`, by account. Raises ValueError for other lines."""
    passwords = {}
    for line in filter(None, map(str.strip, text.splitlines())):
        name, _, rest = line.partition(":")
        _, kind, iterations, salt, hash_ = rest.split("$")
        if kind != "7":
            raise ValueError(f"{name}: a password of kind {kind}")
        passwords[name] = Hashed(salt, hash_, int(iterations))
    return passwords


def rules_in(acl: str) -> Iterator[str]:
    """Yield rules as ``ACCOUNT: RULE``; the account is ``everybody`` for a rule before the first account.

    The word ``topic``, with which :func:`acl_text` begins each rule, is left out; any other first word stays.
    """
    name = "everybody"
    for line in filter(None, map(str.strip, acl.splitlines())):
        word, _, rest = line.partition(" ")
        if word == "user":
            name = rest
        elif not word.startswith("#"):
            yield f"{name}: {rest if word == 'topic' else line}"
