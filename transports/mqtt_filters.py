"""Which filters a broker is told, so that no two of them overlap (T11). Pure: no I/O.

A broker may send a message once per matching filter. Measured on mosquitto 2.0.11: MQTT 5 always does, 3.1.1 never, and
bridge mode does for kept messages only. Overlapping wishes are therefore merged into one filter that covers them; what
it catches too much is sorted out by exact matching on arrival.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator


def overlap(one: str, other: str) -> bool:
    """Is there a topic that both filters match?"""
    left, right = one.split("/"), other.split("/")
    if "$" in (left[0][:1], right[0][:1]) and left[0] != right[0]:
        return False  # wildcards do not match a first level with a $
    for a, b in zip(left, right, strict=False):
        if a == "#" or b == "#":
            return True
        if a != b and "+" not in (a, b):
            return False
    longer = max(left, right, key=len)
    shorter = min(len(left), len(right))
    return len(left) == len(right) or longer[shorter] == "#"


def cover(one: str, other: str) -> str:
    """A filter that matches everything two overlapping filters match, level by level."""
    left, right = one.split("/"), other.split("/")
    levels: list[str] = []
    for a, b in zip(left, right, strict=False):
        if a == "#" or b == "#":
            return "/".join([*levels, "#"])
        levels.append(a if a == b else "+")
    return "/".join(levels if len(left) == len(right) else [*levels, "#"])


class BrokerFilters:
    """The filters one client has told its broker; never two that overlap."""

    def __init__(self) -> None:
        self._told: list[str] = []

    def __iter__(self) -> Iterator[str]:
        return iter(list(self._told))

    def add(self, wanted: str) -> tuple[str, list[str]]:
        """Return the filter to subscribe to (again: that is how kept copies are asked for), and those it replaces."""
        merged: set[str] = set()
        while True:
            meets = [told for told in self._told if told not in merged and overlap(told, wanted)]
            if not meets:
                break
            for told in meets:
                wanted = cover(wanted, told)
                merged.add(told)
        self._told = [*(told for told in self._told if told not in merged), wanted]
        return wanted, sorted(merged - {wanted})

    def prune(self, wanted: Iterable[str]) -> list[str]:
        """Forget, and return, the filters that none of ``wanted`` needs any more."""
        needs = list(wanted)
        idle = [told for told in self._told if not any(overlap(told, need) for need in needs)]
        self._told = [told for told in self._told if told not in idle]
        return idle
