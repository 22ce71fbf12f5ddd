"""Every password and key on a machine that a robot could have to do with, to be searched for in what leaves it."""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from msgspec.structs import fields

from pebble.config import Config
from pebble.config.secret_text import is_secret
from pebble.config.types import Secret, Section
from pebble.setup.places import Places

SHORTEST = 4  # characters: a shorter one is in every text
_LARGEST = 1 << 20  # bytes of a file of passwords; others are no such files
_LONGEST_LINE = 1024
_KEY_LINE = 16  # characters of a line of a key: a shorter last one may be anything
_HASH_PART = 16
#: Below the root: what Pebble and its brokers have, and the keys of this machine and of its networks.
_PLACES = (
    *("etc/pebble", "var/lib/pebble", "var/lib/pebble-web", "var/lib/pebble-record", "etc/mosquitto", "etc/credstore"),
    *("etc/default/pebble*", "etc/systemd/system/pebble*", "etc/ssh/*_key"),
    *("etc/NetworkManager/system-connections", "etc/wpa_supplicant/*.conf", "etc/netplan"),
)
_NOT = ("_file", "-file", "_env", "key-mgmt", "key_mgmt")  # at the end of a key: it names no secret itself
_SOURCES = (".py", ".sh", ".js", ".html", ".md")  # programs have "password=" in them, and no password
_WORDS = ("true", "false", "none", "null")
_named = re.compile(r"passw|secret|token|credential|psk|\.key$|_key$", re.IGNORECASE).search
_setting = re.compile(r'^\s*"?([\w.-]{1,60})"?\s*[=: ]\s*"?([^"#\n]{1,512}?)"?\s*,?\s*$').match
_assigned = re.compile(r"[\w-]*(?:pass|secret|token|pwd)[\w-]*=[\"']?(=*[^\s\"'&=][^\s\"'&]*)", re.IGNORECASE).findall
_login = re.compile(r"://[^\s/@:\"']{0,64}:([^\s/@\"']{1,200})@").findall
_key = re.compile(r"-----BEGIN [A-Z ]*PRIVATE KEY-----\n(.*?)-----END", re.DOTALL).findall


class Hidden(NamedTuple):
    """One secret, and where it is written."""

    where: str
    value: str


class Secrets(NamedTuple):
    """``unread`` are files that could hold more, ``short`` the places of those that are too short to search for."""

    known: tuple[Hidden, ...]
    unread: tuple[str, ...]
    short: tuple[str, ...]

    def found_in(self, name: str, content: bytes) -> str:
        """Where the first secret in ``content`` is written; empty if there is none in it."""
        for where, value in self.known:
            if any(form in content or form in name.encode() for form in _forms(value)):
                return where
        return ""


def secrets_of(places: Places, config: Config | None, more: Collection[Path] = ()) -> Secrets:
    """What is known on this machine. ``more``: further files and folders that may hold some."""
    found = list(_of_config(config))
    unread: list[str] = []
    folders = [path for pattern in _PLACES for path in sorted(places.root.glob(pattern))]
    if config is not None:
        folders += [config.folder, config.state_dir(), *_files_of(config)]
        found += [Hidden(f"${name}", value) for name in config.password_variables if (value := os.environ.get(name))]
    for file in dict.fromkeys(_walk([*folders, *more], unread)):
        try:
            if file.stat().st_size <= _LARGEST:
                found += [Hidden(str(file), value) for value in values_in(file.name, file.read_bytes())]
        except OSError:
            unread.append(str(file))
    short = {where for where, value in found if len(value) < SHORTEST}
    known = {value: where for where, value in reversed(found) if len(value) >= SHORTEST}
    return Secrets(
        tuple(Hidden(where, value) for value, where in known.items()), tuple(sorted(set(unread))), tuple(sorted(short))
    )


def values_in(name: str, raw: bytes) -> Iterator[str]:
    """The secrets in one file, by its name and by the keys in it."""
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        return
    keys = _key(text)
    for body in keys:
        yield from (line.strip() for line in body.splitlines() if len(line.strip()) >= _KEY_LINE)
    yield from _login(text)
    if name.endswith(_SOURCES):
        return
    yield from (value for value in _assigned(text) if value.lower() not in _WORDS)
    with suppress(ValueError, RecursionError):  # most are no JSON
        yield from _in_json(json.loads(text))
        return
    is_named = _named(name) is not None and not keys and "-----BEGIN" not in text
    for line in filter(None, map(str.strip, text.splitlines())):
        if len(line) > _LONGEST_LINE or line.startswith("#"):
            continue
        if is_named:
            yield from _in_line(line)
        elif (pair := _setting(line)) and _is_key(pair[1]) and pair[2].lower() not in _WORDS:
            yield pair[2].strip()


def _in_line(line: str) -> Iterator[str]:
    """A password, or the hash of one behind the name of its account."""
    _, colon, rest = line.partition(":")
    if colon and rest.startswith("$"):
        yield from (part for part in rest.split("$") if len(part) >= _HASH_PART)
    else:
        yield line


def _in_json(value: Any, key: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _in_json(item, name)
    elif isinstance(value, list):
        for item in value:
            yield from _in_json(item, key)
    elif isinstance(value, str) and value and _is_key(key):
        yield value


def _is_key(key: str) -> bool:
    return (is_secret(key) or key.lower() in ("psk", "wep-key0", "private-key")) and not key.lower().endswith(_NOT)


def _of_config(value: object, key: str = "") -> Iterator[Hidden]:
    """Those that the config has read from wherever it was told to."""
    if isinstance(value, Secret):
        yield Hidden(f"the config's {key}", str(value))
    elif isinstance(value, Section):
        for one in fields(value):
            yield from _of_config(getattr(value, one.name), f"{key}.{one.encode_name}".lstrip("."))
    elif isinstance(value, dict):
        for name, item in value.items():
            yield from _of_config(item, f"{key}.{name}")


def _files_of(value: object) -> Iterator[Path]:
    """The files that a config names."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, Section):
        for one in fields(value):
            if one.name not in ("recordings", "folder", "directory", "run_dir", "cwd", "run_folder"):
                yield from _files_of(getattr(value, one.name))
    elif isinstance(value, dict):
        for item in value.values():
            yield from _files_of(item)


def _walk(places: Iterable[Path], unread: list[str]) -> Iterator[Path]:
    def note(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError | NotADirectoryError):
            unread.append(str(error.filename))

    for place in places:
        if place.is_file():
            yield place
            continue
        for folder, _, names in os.walk(place, onerror=note):
            yield from (file for name in sorted(names) if (file := Path(folder, name)).is_file())


def _forms(value: str) -> set[bytes]:
    """How it may be written: as it is, in JSON, in an address, and as base64."""
    raw = value.encode()
    return {raw, json.dumps(value)[1:-1].encode(), quote(value, safe="").encode(), base64.b64encode(raw).rstrip(b"=")}
