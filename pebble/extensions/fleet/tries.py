"""A limit on password tries: guessing would take years."""

import ipaddress
import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from functools import lru_cache

TRIES = 5
WINDOW_S = 60.0
_KEYS = 10_000  # addresses or names that are remembered; beyond that the oldest is forgotten


class Tries:
    """A count of tries for each key: at most TRIES within WINDOW_S. Thread-safe."""

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._times: OrderedDict[str, deque[float]] = OrderedDict()

    def take(self, key: str) -> float:
        """Count a try; return 0, or the seconds until the next try if there were too many."""
        now = self._monotonic()
        with self._lock:
            times = self._times.setdefault(key[:64], deque(maxlen=TRIES))
            self._times.move_to_end(key[:64])
            if len(self._times) > _KEYS:
                self._times.popitem(last=False)
            if len(times) == TRIES and now - times[0] < WINDOW_S:
                return WINDOW_S - (now - times[0])
            times.append(now)
            return 0.0

    def give_back(self, key: str) -> None:
        """Uncount a try, because its password was right."""
        with self._lock:
            times = self._times.get(key[:64])
            if times:
                times.pop()


@lru_cache(maxsize=256)
def network_of(address: str) -> str:
    """Return the part of an address that counts as one machine.

    For IPv6 it is the /64, because a machine can use every address in it.
    """
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if parsed.version == 4 or parsed.ipv4_mapped is not None:
        return str(parsed)
    return str(ipaddress.ip_network((parsed, 64), strict=False))
