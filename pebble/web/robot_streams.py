"""The streams that robots serve themselves, over WebRTC for example, and others that were entered for them.

They decide which origins the page may show in a frame.
"""

from __future__ import annotations

import re
from typing import Any, Final

from pebble.contract import STATUS, codec
from pebble.errors import PayloadError
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


def origin(url: object, own_host: str = "") -> str:
    """Scheme, host and port of a stream that may be shown; empty if it may not.

    Not of the page's own host, on whatever port: a browser sends the cookie of the login there as well.
    """
    found = _URL.fullmatch(url) if isinstance(url, str) and len(url) <= _MAX_URL else None
    if found is None:
        return ""
    scheme, host, port = (part.lower() if part else "" for part in found.groups())
    if host.strip("[]") == own_host.lower().strip("[]").rstrip(".") or not 0 < int(port[1:] or "1") <= 65535:
        return ""
    return f"{scheme}://{host}{port}"


def origins(robots: Robots, ref: str, own_host: str) -> list[str]:
    """Of all that robots report now, or that were entered for them; those for the page of ``ref`` first."""
    found: dict[str, None] = {}
    for one in (ref, robots.sources.get(ref, ref), *robots.components):
        if allowed := origin(robots.streams.get(one) or _reported(robots, one), own_host):
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
