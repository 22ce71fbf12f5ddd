"""When the services of a component were seen to restart: robots count restarts, but do not date them. Pure."""

from collections import deque
from typing import Any, Final

import msgspec

from pebble.web.messages import RestartsView

MAX_SERVICES: Final = 64
MAX_NAME: Final = 64  # characters
MAX_TIMES: Final = 16  # of the newest restarts of one service


class Restarts:
    """Counts the restarts of one component. The first status shows only how many there were before."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._times: dict[str, deque[int]] = {}

    def receive(self, status: bytes, now_ms: int, *, dated: bool = True) -> bool:
        """Take a status; whether any service has restarted since the last one. ``dated`` False: of any time."""
        found = False
        for name, count in _counts(status).items():
            before = self._counts.get(name, count)
            if name not in self._counts and len(self._counts) >= MAX_SERVICES:
                continue
            self._counts[name] = count  # a robot that was restarted counts from 0
            if count > before and dated:
                times = self._times.setdefault(name, deque(maxlen=MAX_TIMES))
                times.extend([now_ms] * min(count - before, MAX_TIMES))
                found = True
        return found

    def view(self) -> RestartsView:
        return RestartsView(times={name: tuple(times) for name, times in self._times.items()})


def _counts(status: bytes) -> dict[str, int]:
    """By service. A status may be of any shape."""
    value: Any = msgspec.json.decode(status)
    services = value.get("value", value).get("services") if _is_status(value) else None
    if not isinstance(services, dict):
        return {}
    found = {name: one.get("restarts") for name, one in services.items() if isinstance(one, dict)}
    return {name: count for name, count in found.items() if type(count) is int and count >= 0 and len(name) <= MAX_NAME}


def _is_status(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("value", value), dict)
