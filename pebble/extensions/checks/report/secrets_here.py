"""The passwords and keys on this machine, found so that a report can mask them."""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from pebble.config import Config
from pebble.config.masking import values_of
from pebble.config.secret_text import HIDDEN
from pebble.config.types import Secret
from pebble.errors import PebbleError
from pebble.extensions.operator.places import Places
from pebble.ownership import read_plain
from pebble.runtime.as_owner import as_owner

_SHORTEST = 4  # characters: a shorter one is in every text
_LARGEST = 1 << 20  # bytes of a file of passwords; others are no such files
#: Below the root: what Pebble and its brokers have, and the keys of this machine and of its networks.
_PLACES = (
    *("etc/pebble", "var/lib/pebble", "var/lib/pebble-web", "var/lib/pebble-record", "etc/mosquitto", "etc/credstore"),
    *("etc/default/pebble*", "etc/systemd/system/pebble*", "etc/ssh/*_key"),
    *("etc/NetworkManager/system-connections", "etc/wpa_supplicant/*.conf", "etc/netplan"),
)
_PROGRAMS = (".py", ".sh", ".js", ".html", ".md")
_NOTHING = frozenset({"true", "false", "none", "null"})
_names_secrets = re.compile(r"passw|secret|token|credential|psk|\.key$|_key$", re.IGNORECASE).search
#: A key that says so, and its value: in JSON, in a file of settings, in an option or a query.
_settings = re.compile(
    r"""["']?\b[\w.-]*(?:passw(?:or)?d|passwd|secret|token|credential|psk|api_key|private-key|wep-key0|pwd)\b["']?"""
    r"""[ \t]*[=: ][ \t]*(?:"((?:[^"\\\n]|\\.){1,512})"|'([^'\n]{1,512})'|([^\s"'#&,{}\[\]()][^"'#\n&,{}()]{0,511}))""",
    re.IGNORECASE,
).findall
_logins = re.compile(r"://[^\s/@:\"']{0,64}:([^\s/@\"']{1,200})@").findall
_keys = re.compile(r"-----BEGIN [A-Z ]*PRIVATE KEY-----\n(.*?)-----END", re.DOTALL).findall


class Secrets(NamedTuple):
    """Secrets of a machine.

    ``unread``: files that could not be searched; ``short``: files with a secret too short to be masked safely.
    """

    known: frozenset[str]
    unread: tuple[str, ...]
    short: tuple[str, ...]

    def hidden(self, text: str) -> str:
        """Return ``text`` with each secret masked by stars, in every form in which it may be written."""
        for value in sorted(self.known, key=len, reverse=True):
            for form in _forms(value):
                text = text.replace(form, HIDDEN)
        return text


def secrets_of(places: Places, config: Config | None, more: Collection[Path] = ()) -> Secrets:
    """Find the secrets on this machine. ``more``: further files and folders to search."""
    folders = [path for pattern in _PLACES for path in sorted(places.root.glob(pattern))]
    values: list[tuple[str, str]] = []  # the secrets, each with the place where it is written
    if config is not None:
        folders += [config.folder, config.state_dir(), *filter(Path.is_file, values_of(config, Path))]
        values += [(str(secret), "the config") for secret in values_of(config, Secret)]
        values += [(value, f"${name}") for name in config.password_variables if (value := os.environ.get(name))]
    unread: set[str] = set()
    for file in dict.fromkeys(_walk([*folders, *more], unread)):
        try:
            with as_owner(file.parent):
                if file.is_file() and file.stat().st_size <= _LARGEST:
                    values += [(value, str(file)) for value in values_in(file.name, read_plain(file))]
        except (OSError, PebbleError):
            unread.add(str(file))
    maskable = frozenset(value for value, _ in values if len(value) >= _SHORTEST)
    short = {where for value, where in values if len(value) < _SHORTEST}
    return Secrets(maskable, tuple(sorted(unread)), tuple(sorted(short)))


def values_in(name: str, raw: bytes) -> Iterator[str]:
    """Yield the secrets in a file, found by the file's name and by its keys."""
    text = raw.decode(errors="replace")
    yield from _logins(text)
    for key in _keys(text):
        yield from _long_ones(key.splitlines())
    if name.endswith(_PROGRAMS):  # have "password=" in them, and no password
        return
    for match in _settings(text):
        value = next(filter(None, match), "").strip()  # in the group that has matched
        if value.lower() not in _NOTHING:
            yield from {value, _decoded(value)}
    # A file such as `mqtt-password`, in which each line is a secret: neither of keys nor JSON, which are read above.
    if _names_secrets(name) and "-----BEGIN" not in text and not text.lstrip().startswith("{"):
        for line in filter(None, map(str.strip, text.splitlines())):
            _, colon, hashed = line.partition(":$")
            if colon:  # USER:$7$ITERATIONS$SALT$HASH, of mosquitto
                yield from _long_ones(hashed.split("$"))
            else:
                yield line


def _long_ones(parts: Iterable[str]) -> Iterator[str]:
    """Yield the parts of a key or hash that are so long that no other text contains them."""
    return (part.strip() for part in parts if len(part.strip()) >= 4 * _SHORTEST)


def _decoded(value: str) -> str:
    try:
        return str(json.loads(f'"{value}"'))
    except ValueError:
        return value


def _walk(places: Iterable[Path], unread: set[str]) -> Iterator[Path]:
    for place in places:
        if place.is_file():
            yield place
        elif place.is_dir():
            for folder, _, names in os.walk(place, onerror=lambda error: unread.add(str(error.filename))):
                yield from (Path(folder, name) for name in sorted(names))


def _forms(value: str) -> Iterator[str]:
    """Yield the forms in which a secret may be written: plain, in JSON, in a URL, in base64."""
    yield from (value, json.dumps(value)[1:-1], quote(value, safe=""))
    yield base64.b64encode(value.encode()).rstrip(b"=").decode()
