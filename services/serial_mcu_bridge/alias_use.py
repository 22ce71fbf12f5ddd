"""Which of a device's aliases are in use just now: those that nobody else claims."""

from __future__ import annotations

import logging
from collections.abc import Callable

from pebble.services.serial_mcu_bridge.device import Alias, Device, Route
from pebble.services.serial_mcu_bridge.neighbours import Neighbours
from pebble.transports import Subscription


class AliasUse:
    """``begin`` starts the use of an alias (and returns what listens to it, if anything does), ``end`` ends it."""

    def __init__(
        self,
        log: logging.Logger,
        neighbours: Neighbours,
        begin: Callable[[Device, Route, Alias], Subscription | None],
        end: Callable[[Alias], None],
    ) -> None:
        self._log, self._neighbours, self._begin, self._end = log, neighbours, begin, end
        self.settled = False  # others have had the time to object
        self._device: Device | None = None
        self._used: dict[str, tuple[Alias, Subscription | None]] = {}  # by claim
        self._rivals: dict[str, list[str]] = {}  # by claim, as last told

    def __contains__(self, alias: Alias) -> bool:
        return alias.claim in self._used

    def introduce(self, device: Device) -> None:
        """Its claims are told to the others; none is in use yet."""
        self._device, self.settled = device, False

    def permit(self, device: Device) -> None:
        """Whoever wanted to object has done so."""
        if device is self._device:
            self.settled = True
            self.settle()

    def settle(self) -> None:
        """Use what nobody else claims, and give up what somebody does: then it is nobody's."""
        if self._device is None:
            return
        for route in self._device.routes.values():
            if route.alias is not None:
                self._settle(self._device, route, route.alias)

    def leave(self) -> None:
        """The device has gone."""
        for claim in list(self._used):
            self._give_up(claim)
        self._device, self.settled = None, False
        self._rivals.clear()

    def _settle(self, device: Device, route: Route, alias: Alias) -> None:
        rivals = self._neighbours.claimants(alias.claim)
        self._tell(device, alias.claim, rivals)
        if rivals:
            self._give_up(alias.claim)
        elif self.settled and alias.claim not in self._used:
            self._used[alias.claim] = alias, None  # what begins may speak at once
            self._used[alias.claim] = alias, self._begin(device, route, alias)

    def _give_up(self, claim: str) -> None:
        if claim in self._used:
            alias, subscription = self._used.pop(claim)
            if subscription is not None:
                subscription.close()
            self._end(alias)

    def _tell(self, device: Device, claim: str, rivals: list[str]) -> None:
        before = self._rivals.pop(claim, [])
        if rivals:
            self._rivals[claim] = rivals
        if rivals and not before:
            others = " and ".join(rivals)
            text = "%s and %s both claim %s: nobody has it until one of them leaves, both use mcu/… only"
            self._log.warning(text, device.uid, others, claim)
        elif before and not rivals:
            self._log.info("%s: %s is ours again", device.uid, claim)
