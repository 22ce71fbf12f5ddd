"""Reads hosts as people write them: a name or an address is understood, all else is refused with what to write."""

import re
from ipaddress import IPv4Address, IPv6Address
from typing import NamedTuple
from urllib.parse import unquote

from pebble.config.secret_text import without_secrets
from pebble.config.visible import hidden
from pebble.contract.identity import untypeable
from pebble.errors import PebbleError

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?").fullmatch  # LANs have names with _
_NUMBER = re.compile(r"[0-9]+|0[xX][0-9A-Fa-f]*").fullmatch  # as a last label: resolvers take the whole for an address
_ZONE = re.compile(r"[A-Za-z0-9_.-]{1,15}").fullmatch  # the name of a network card
_ZENOH = ("tcp", "tls", "quic", "udp", "ws", "wss")  # protocols whose address is a host and a port
_ENCRYPTED = ("mqtts", "ssl", "tls", "wss", "https")
_WEBSOCKET = ("ws", "wss", "http", "https")
_RULE = "must be a name or address: 1 to 63 letters, digits, - or _ between dots, 253 in all"


class HostError(PebbleError):
    """What is wrong with a host, and what to write instead, without a login that may be in it."""


class Address(NamedTuple):
    """The parts of a URL, or of another text that names a host."""

    scheme: str  # in lower case; "" without one
    user: str | None
    password: str | None
    host: str
    port: int | None
    bracketed: bool
    rest: str  # from the first / ? or # on


def host(text: str) -> str:
    """The host of a value that has no other keys beside it. Raises HostError."""
    return _host(text, keys=False)


def broker_host(text: str) -> str:
    """The value of the key ``host`` of a section with port, username and tls. Raises HostError."""
    found = _host(text, keys=True)
    if ":" in found and IPv6Address(found).is_link_local and "%" not in found:
        raise HostError(f'names no network card: write "{found}%eth0" with the name of yours')
    return found


def name_of_page(text: str) -> str:
    """A host with or without a port, as browsers send it. Raises HostError."""
    if text.count(":") == 1 and not _SCHEME.match(text):
        address = split(text)
        if address.user is None and address.port is not None and not address.rest:
            return f"{address.host}:{address.port}"
    return host(text)


def endpoint(text: str) -> str:
    """A Zenoh endpoint. Raises HostError."""
    protocol, _, place = text.partition("/")
    if "@" in place:
        raise HostError("holds a login, which Zenoh takes from no endpoint: remove it")
    if protocol in _ZENOH:
        address = re.split("[?#]", place, maxsplit=1)[0]  # what follows are Zenoh's own settings of it
        example = f'must be such as "{protocol}/192.168.1.7:7447"'
        try:
            found = split(re.sub(":0$", ":1", address))  # 0: any free port
        except HostError as error:
            raise HostError(f"{example}: it {error}") from None
        if found.rest or found.scheme or found.port is None:
            raise HostError(example)
    return text


def check_web_url(text: str) -> None:
    """Raise HostError for ``http://`` or ``https://`` without a host that is one. ``text`` holds no login."""
    if (scheme := _SCHEME.match(text)) and scheme[1].lower() in ("http", "https"):
        split(scheme[0] + re.split("[/?#]", text[scheme.end() :], maxsplit=1)[0])


def no_login(text: str) -> str:
    """A name, which is published and logged. Raises HostError if it holds a login, as ``user:password@`` is."""
    if without_secrets(text) != text:
        raise HostError("holds a login or a password, and is shown to everybody: remove it")
    return text


def typeable(text: str) -> str:
    """A name that people type, such as a robot's. Raises HostError for one that they cannot."""
    if why := untypeable(text):
        raise HostError(why)
    return no_login(text)


def no_url(text: str) -> str:
    """A path. Raises HostError for a URL, which may hold a login."""
    if "://" in text:
        raise HostError("is a URL: write a path")
    return no_login(text)


def split(text: str) -> Address:
    """Take a URL, or ``[user@]host[:port]``, apart. Raises HostError, which repeats nothing of ``text``."""
    if flaw := hidden(text):
        raise HostError(flaw)
    found = _SCHEME.match(text)
    scheme, after = (found[1].lower(), text[found.end() :]) if found else ("", text)
    end = next((place for place, char in enumerate(after) if char in "/?#\\"), len(after))
    authority, rest = after[:end], after[end:]
    if "@" in rest and (scheme or "@" in authority or ":" in authority):
        raise HostError("holds an @ after a / or ?: a password with such characters belongs into a key of its own")
    login, at, place = authority.rpartition("@")
    user, colon, password = login.partition(":")
    if place.endswith(":") and not place.endswith("::"):
        raise HostError("ends with a : and no port: remove it, or write the port behind it")
    bracketed = place.startswith("[")
    if bracketed:
        name, closed, port = place[1:].partition("]")
        if not closed or ":" not in name or (port and not port.startswith(":")):
            raise HostError('must be an address in brackets, such as "[::1]"')
        port = port[1:]
    elif scheme and place.count(":") > 1:
        raise HostError('holds an IPv6 address without brackets: write it such as "[::1]:1883"')
    else:
        name, _, port = place.partition(":") if place.count(":") == 1 else (place, "", "")
    return Address(
        scheme=scheme,
        user=unquote(user) if at else None,
        password=unquote(password) if colon else None,
        host=_understood(name),
        port=_port(port) if port else None,
        bracketed=bracketed,
        rest=rest,
    )


def _host(text: str, *, keys: bool) -> str:
    if flaw := hidden(text):
        raise HostError(flaw)
    try:
        return _understood(text)
    except HostError as error:
        if text == "*":
            raise HostError('must be one name or address, not "*"; all of this machine are "0.0.0.0"') from None
        if re.search(r"[,;]", text) and "@" not in text:
            raise HostError("is a list: write one name or address") from None
        if not re.search(r"[:/?#@\[]", text) or re.search(
            r"^[^:@]*[/\\].*:|^[A-Za-z]:\\", text
        ):  # or a Zenoh endpoint, or a file
            raise error from None
    return _refuse(split(text), keys)


def _refuse(found: Address, keys: bool) -> str:
    """Raise the HostError for what is more than a host."""
    what = next(
        kind
        for kind, there in (
            ("is a URL", found.scheme),
            ("holds a login", found.user is not None),
            ("holds a path", found.rest),
            ("holds a port", found.port is not None or not found.bracketed),
            ("has brackets", True),
        )
        if there
    )
    raise HostError(f"{_shown(found)} {what}: write {_instead(found) if keys else _quoted(found.host)}")


def _instead(found: Address) -> str:
    parts = [f'"host": {_quoted(found.host)}']
    if found.port is not None:
        parts.append(f'"port": {found.port}')
    elif found.scheme in ("mqtts", "ssl", "tls"):
        parts.append('"port": 8883')
    if found.scheme in _ENCRYPTED:
        parts.append('"tls": {"enabled": true}')
    text = ", ".join(parts)
    if found.user is not None:
        text += ', and the login into "username" and "password_file"'
    return f"{text} (the broker's port of MQTT, not of WebSocket)" if found.scheme in _WEBSOCKET else text


def _shown(found: Address) -> str:
    """What was written, as far as it was understood and may be shown."""
    name = f"[{found.host}]" if found.bracketed else found.host
    port = "" if found.port is None else f":{found.port}"
    scheme = f"{found.scheme}://" if found.scheme else ""
    return _quoted(
        f"{scheme}{'' if found.user is None else '***@'}{name}{port}{'/…' if len(found.rest) > 1 else found.rest}"
    )


def _quoted(text: str) -> str:
    return f'"{text}"'


def _port(text: str) -> int:
    number = int(text) if text.isascii() and text.isdigit() and len(text) <= 5 else 0
    if not 1 <= number <= 65535:
        raise HostError("holds a port that is no number from 1 to 65535")
    return number


def _understood(text: str) -> str:
    """A bare name or address in the spelling that resolvers and certificates use. Raises HostError."""
    if ":" in text:
        return _ipv6(text)
    name = (text if text.isascii() else _ascii(text)).removesuffix(".")
    labels = name.split(".")
    if _NUMBER(labels[-1]):
        try:
            return str(IPv4Address(name))
        except ValueError:
            raise HostError('is no whole address: write four numbers up to 255, such as "192.168.1.7"') from None
    if len(name) > 253 or not all(len(label) <= 63 and _LABEL(label) for label in labels):
        raise HostError(_RULE)
    return name


def _ipv6(text: str) -> str:
    address, percent, zone = text.partition("%")
    try:
        IPv6Address(address)
    except ValueError:
        raise HostError(_RULE) from None
    if percent and not _ZONE(zone):
        raise HostError('must name a network card after the %, such as "fe80::1%eth0"')
    return text


def _ascii(text: str) -> str:
    """A name with other letters as the name service spells it, where it has one spelling (RFC 3490)."""
    import unicodedata  # few names need it

    try:
        name = text.encode("idna").decode()
        back = name.encode().decode("idna")
    except UnicodeError:
        raise HostError(_RULE) from None
    if back.lower() != unicodedata.normalize(
        "NFC", text.lower()
    ):  # ß for example, which old and new rules spell differently
        raise HostError(
            "holds a letter that name services spell in several ways: write the name in ASCII, such as xn--…"
        )
    return name
