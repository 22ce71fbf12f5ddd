"""The robot's other self-describing MCUs, and the channels that their manifests claim. Pure."""

from dataclasses import dataclass

#: A retained manifest may have outlived its device. We ask; if its bridge does not publish it again within 5 s, it is
#: removed.
CONFIRM_S = 5.0

_MOST = 256  # a robot has a handful; limits forged ones


@dataclass(frozen=True, slots=True)
class _PeerDevice:
    claims: frozenset[str]
    confirm_by: float | None  # None: published by a running process


class PeerDevices:
    """Claims by device. A retained manifest counts, too, until its device had time to confirm it."""

    def __init__(self) -> None:
        self._peers: dict[str, _PeerDevice] = {}  # by uid

    def add(self, uid: str, claims: frozenset[str], now: float, *, retained: bool) -> None:
        if uid in self._peers or len(self._peers) < _MOST:
            self._peers[uid] = _PeerDevice(claims, now + CONFIRM_S if retained else None)

    def forget(self, uid: str) -> None:
        """Forget a device: it has withdrawn its manifest, or is this one."""
        self._peers.pop(uid, None)

    def claimants(self, claim: str) -> list[str]:
        """Return the uids of all devices that claim this channel, sorted."""
        return sorted(uid for uid, peer in self._peers.items() if claim in peer.claims)

    @property
    def due(self) -> float | None:
        """Time at which the next confirmation times out; None if none is pending."""
        return min((peer.confirm_by for peer in self._peers.values() if peer.confirm_by is not None), default=None)

    def left_over(self, now: float) -> list[str]:
        """Forget the devices that were not confirmed in time, and return their uids."""
        late = [uid for uid, peer in self._peers.items() if peer.confirm_by is not None and peer.confirm_by <= now]
        for uid in late:
            del self._peers[uid]
        return late
