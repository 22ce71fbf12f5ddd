"""Readers of host names and addresses as people write them. An error says what to write instead."""

import re
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

from pebble.config.secret_text import without_secrets
from pebble.config.visible import hidden
from pebble.contract.identity import composed, untypeable
from pebble.errors import PebbleError

_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?").fullmatch  # LANs have names with _
_NUMBER = re.compile(r"[0-9]+|0[xX][0-9A-Fa-f]*").fullmatch  # as a last label: resolvers take the whole for an address
_ZONE = re.compile(r"\[([0-9A-Fa-f:.]+)%25([^]]+)\]")  # of a URL, where % is written so (RFC 6874)
_ZENOH = ("tcp", "tls", "quic", "udp", "ws", "wss")  # protocols whose address is a host and a port
_RULE = 'must be a name or a whole address, such as "broker.lan" or "192.168.1.7": port, login and tls have own keys'


class HostError(PebbleError):
    """An error that says what is wrong with a host and what to write. It repeats nothing of the text."""


class UrlParts(NamedTuple):
    """The parts of a URL, or of another text that names a host."""

    scheme: str  # in lower case; "" without one
    user: str | None
    password: str | None
    host: str
    port: int | None
    rest: str  # the path, and what follows it


def host(text: str) -> str:
    """Return a bare name or address in the spelling that resolvers and certificates use. Raises HostError."""
    if flaw := hidden(text):
        raise HostError(flaw)
    try:
        return _address(text) if ":" in text else _name(text)
    except ValueError:
        raise HostError(_RULE) from None


def broker_host(text: str) -> str:
    """Return the host of a broker from ``text``. Raises HostError."""
    name = host(text)
    if ":" in name and IPv6Address(name).is_link_local and "%" not in name:
        raise HostError(f'names no network card: write "{name}%eth0" with the name of yours')
    return name


def name_of_page(text: str) -> str:
    """Return a name under which browsers reach a page, HOST or HOST:PORT, as they send it. Raises HostError."""
    if text.count(":") != 1:
        return host(text)
    address = _only_place(text)
    return f"{address.host}:{address.port}"


def endpoint(text: str) -> str:
    """Return a Zenoh endpoint. Raises HostError."""
    text = _with_zone(text)
    protocol, _, place = text.partition("/")
    if "@" in place:
        raise HostError("holds a login, which Zenoh takes from no endpoint: remove it")
    if protocol in _ZENOH:
        address = re.split("[?#]", place, maxsplit=1)[0]  # what follows are Zenoh's own settings of it
        try:
            has_port = _only_place(re.sub(":0$", ":1", address)).port is not None  # `split` refuses 0, any free port
        except HostError:
            has_port = False
        if not has_port:
            raise HostError(f'must be such as "{protocol}/192.168.1.7:7447"')
    return text


def no_login(text: str) -> str:
    """Return ``text``, a name that is published and logged. Raises HostError for a login such as ``user:password@``."""
    if without_secrets(text) != text:
        raise HostError("holds a login or a password, and is shown to everybody: remove it")
    return text


def typeable(text: str) -> str:
    """Return ``text``, a name that people type, such as a robot's. Raises HostError if no keyboard writes it."""
    if why := untypeable(text):
        raise HostError(why)
    return no_login(text)


def no_url(text: str) -> str:
    """Return ``text``, a path. Raises HostError for a URL, which may hold a login."""
    if "://" in text:
        raise HostError("is a URL: write a path")
    return no_login(text)


def split(text: str) -> UrlParts:
    """Split a URL, or ``[user@]host[:port]``, into its parts. Raises HostError."""
    if flaw := hidden(text):
        raise HostError(flaw)
    if "://" not in text:  # urlsplit finds a host behind // only, and an IPv6 address in brackets only
        text = f"//[{text}]" if text.count(":") > 1 and "[" not in text else f"//{text}"
    text = _with_zone(text)
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        raise HostError("must end with HOST, HOST:PORT or [ADDRESS]:PORT, with a port from 1 to 65535") from None
    if port == 0:
        raise HostError("holds the port 0: write one from 1 to 65535")
    return UrlParts(
        scheme=parts.scheme,
        user=None if parts.username is None else unquote(parts.username),
        password=None if parts.password is None else unquote(parts.password),
        host=host(parts.hostname or ""),
        port=port,
        rest=parts.path + parts.query + parts.fragment,
    )


def _only_place(text: str) -> UrlParts:
    """Return the parts of ``HOST[:PORT]``. Raises HostError for a text with more parts."""
    address = split(text)
    if address.scheme or address.rest or address.user is not None:
        raise HostError("must be HOST or HOST:PORT alone")
    return address


def _address(text: str) -> str:
    """Return an IPv6 address, written with or without brackets. Raises ValueError."""
    bare = text[1:-1] if text.startswith("[") and text.endswith("]") else text
    return str(IPv6Address(_with_zone(f"[{bare}]")[1:-1]))


def _with_zone(text: str) -> str:
    """Return ``text`` with the zone of an IPv6 address written plainly: ``[fe80::1%eth0]`` for ``[fe80::1%25eth0]``."""
    return _ZONE.sub(lambda match: f"[{match[1]}%{unquote(match[2])}]", text)


def _name(text: str) -> str:
    """Return a host name, or an IPv4 address, in ASCII (RFC 3490). Raises ValueError."""
    name = text.removesuffix(".")
    if not name.isascii():
        spelled = name.encode("idna")
        if spelled.decode("idna").lower() != composed(name.lower()):  # ß for example: old and new rules differ
            raise ValueError(text)
        name = spelled.decode()
    labels = name.split(".")
    if _NUMBER(labels[-1]):
        return str(IPv4Address(name))
    if len(name) > 253 or not all(map(_LABEL, labels)):
        raise ValueError(text)
    return name


def is_loopback(host: str) -> bool:
    """True if ``host`` is an address of this machine that no other machine reaches."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
