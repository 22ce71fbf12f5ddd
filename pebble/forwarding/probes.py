"""Detects that two of a robot's connections lead to one broker: a probe sent on one arrives on the other. Pure.

The bridge publishes probes on its remote side, and announces each to the mirror on the robot's own transport, where
clients of the mirrored broker can neither read nor publish. A probe that comes from that broker is therefore the
bridge's if the bridge has announced it; anything else on that topic is not.
"""

import secrets
import threading
from collections import deque
from typing import Final

from pebble.contract import BRIDGE_PROBE, codec

_REMEMBERED = 64  # probes that may still arrive
_MAX_BYTES = 256  # of a probe

#: Published by the mirror on the robot's own transport: the bridge answers with a new probe.
PROBE_REQUEST: Final = codec.encode(BRIDGE_PROBE, {"question": True})

#: Published by the bridge there: its newest probe has arrived at the remote broker, or it has no connection.
NO_PROBE: Final = codec.encode(BRIDGE_PROBE, {"question": False})


def new_probe(now_ms: int) -> bytes:
    """Return a payload that no other client can have published before."""
    return codec.encode(BRIDGE_PROBE, {"t": now_ms, "nonce": secrets.token_hex(8)})


class Probes:
    """Probes that the bridge has announced and probes received from a broker, compared in either order.

    Each probe counts once, because a client may keep sending a copy, or retain one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._announced: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._seen: deque[bytes] = deque(maxlen=_REMEMBERED)

    def announce(self, payload: bytes) -> bool:
        """Note that the bridge has announced ``payload``; True if the broker has sent it already."""
        with self._lock:
            return _match(payload, self._seen, self._announced)

    def see(self, payload: bytes) -> bool:
        """Note that the broker has sent ``payload``; True if the bridge has announced it."""
        if len(payload) > _MAX_BYTES:
            return False
        with self._lock:
            return _match(payload, self._announced, self._seen)


def _match(payload: bytes, counterparts: deque[bytes], waiting: deque[bytes]) -> bool:
    """Return True if ``payload`` is in ``counterparts``, and remove it there; else add ``payload`` to ``waiting``."""
    if payload in counterparts:
        counterparts.remove(payload)
        return True
    waiting.append(payload)
    return False
