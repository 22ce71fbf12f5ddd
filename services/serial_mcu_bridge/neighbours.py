"""The other self-describing MCUs of this robot, known by their kept manifests, and what they claim. Pure."""

from __future__ import annotations

from dataclasses import dataclass

#: A manifest kept by the fabric may be a left-over. Whoever stands for it says it again when asked; else it is one.
CONFIRM_S = 5.0

_MOST = 256  # a robot has a handful; strangers may invent as many as they like


@dataclass(frozen=True, slots=True)
class _Neighbour:
    claims: frozenset[str]
    doubted_until: float | None  # None: it has spoken


class Neighbours:
    """Who claims what. A neighbour whose manifest is only a kept copy counts too, until it proves to be a left-over."""

    def __init__(self) -> None:
        self._of: dict[str, _Neighbour] = {}

    def hear(self, uid: str, claims: frozenset[str], now: float, *, kept: bool) -> None:
        if uid in self._of or len(self._of) < _MOST:
            self._of[uid] = _Neighbour(claims, now + CONFIRM_S if kept else None)

    def forget(self, uid: str) -> None:
        """It has taken its manifest back, or is our own."""
        self._of.pop(uid, None)

    def claimants(self, claim: str) -> list[str]:
        """Everybody who claims this channel, in a fixed order."""
        return sorted(uid for uid, neighbour in self._of.items() if claim in neighbour.claims)

    @property
    def due(self) -> float | None:
        """When the next doubt ends; None without doubts."""
        return min((one.doubted_until for one in self._of.values() if one.doubted_until is not None), default=None)

    def left_over(self, now: float) -> list[str]:
        """Those for whom nobody stood up in time. They are forgotten."""
        gone = [uid for uid, one in self._of.items() if one.doubted_until is not None and one.doubted_until <= now]
        for uid in gone:
            del self._of[uid]
        return gone
