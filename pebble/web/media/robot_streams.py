"""The streams that robots serve themselves, over WebRTC for example, and others that were entered for them.

They decide which origins the page may show in a frame.
"""

import ipaddress
import re
import socket
from collections.abc import Container
from typing import Any, Final

from pebble.client.page import WebSettings
from pebble.contract import STATUS, codec
from pebble.errors import PayloadError
from pebble.web.access.guard import canonical, host_names, is_loopback
from pebble.web.robots import Robots

KEYS: Final = ("webrtc_url", "webrtcUrl", "url")  # of the status; robots of the original use all of them
MAX_ORIGINS: Final = 16  # in one header
_MAX_URL: Final = 500
_MAX_STATUS: Final = 8 * 1024  # bytes of a status: those of 500 robots are read for a page
#: Nothing else may stand in a header; the page compares with the same rule.
_URL: Final = re.compile(
    r"(https?)://([a-z0-9](?:[a-z0-9.-]{0,252}[a-z0-9])?|\[[0-9a-f:.]{2,45}\])(:[0-9]{1,5})?(?:[/?#][!-~]*)?",
    re.IGNORECASE | re.ASCII,
)


class OwnHosts:
    """The hosts by which browsers may open this server, however they are spelt: they may have its cookie for them."""

    def __init__(self, settings: WebSettings) -> None:
        self._names = {canonical(_without_port(name)) for name in host_names(settings)}
        self._reached = not is_loopback(settings.host)  # at each address of this machine

    def __contains__(self, host: object) -> bool:
        name = _as_browsers_read(str(host))
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return not {name, "*." + name.partition(".")[2]}.isdisjoint(self._names) or name.endswith(".localhost")
        return (
            address.is_loopback or address.is_unspecified or name in self._names or (self._reached and _is_here(name))
        )


def _without_port(name: str) -> str:
    return name if name.count(":") > 1 and "]" not in name else re.sub(r":[0-9]+$", "", name)


def _as_browsers_read(host: str) -> str:
    """One spelling of a host: 127.1, 0x7f.1 and 2130706433 are 127.0.0.1."""
    name = host.strip("[]").rstrip(".")
    try:
        return socket.inet_ntoa(socket.inet_aton(name))
    except OSError:
        return canonical(name)


def _is_here(address: str) -> bool:
    """Whether it is an address of this machine."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as one:
            one.bind((address, 0))
    except OSError:
        return False
    return True


def origin(url: object, own: Container[str] = ()) -> str:
    """Scheme, host and port of a stream that may be shown; empty if it may not.

    Not of the page's own hosts, on whatever port: a browser sends the cookie of the login there as well.
    """
    found = _URL.fullmatch(url) if isinstance(url, str) and len(url) <= _MAX_URL else None
    if found is None:
        return ""
    scheme, host, port = (part.lower() if part else "" for part in found.groups())
    if host in own or not 0 < int(port[1:] or "1") <= 65535:
        return ""
    return f"{scheme}://{host}{port}"


def origins(robots: Robots, ref: str, own: Container[str]) -> list[str]:
    """The streams that robots report now, or that were entered for them; those for the page of ``ref`` first."""
    found: dict[str, None] = {}
    for one in (ref, robots.sources.get(ref, ref), *robots.components):
        if allowed := origin(robots.streams.get(one) or _reported(robots, one), own):
            found[allowed] = None
        if len(found) == MAX_ORIGINS:
            break
    return list(found)


def _reported(robots: Robots, ref: str) -> object:
    raw = bytes(robots.value(ref, STATUS.metric) or b"")
    if b"rl" not in raw or len(raw) > _MAX_STATUS:
        return None
    try:
        payload: Any = codec.plain(STATUS, raw)
    except PayloadError:
        return None
    value = payload.get("value") if isinstance(payload, dict) else None
    return next((value[key] for key in KEYS if value.get(key)), None) if isinstance(value, dict) else None
