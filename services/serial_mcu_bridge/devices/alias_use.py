"""Decides which aliases, extra channels of a device's interfaces, are in use: those that no other device claims."""

import logging
from collections.abc import Callable, Mapping

from pebble.services.serial_mcu_bridge.devices.device import Alias, Device, Route
from pebble.services.serial_mcu_bridge.devices.peers import PeerDevices
from pebble.transports import Subscription


class AliasUse:
    """The aliases in use. ``begin`` starts to use an alias and returns its subscription, if any; ``end`` ends use."""

    def __init__(
        self,
        log: logging.Logger,
        peers: PeerDevices,
        begin: Callable[[Device, Route, Alias], Subscription | None],
        end: Callable[[Alias], None],
        owners: Mapping[str, str],
    ) -> None:
        """Store the arguments; ``owners``: by channel, the uid that the config names; only that device may use it."""
        self._log, self._peers, self._begin, self._end, self._owners = log, peers, begin, end, owners
        self.permitted = False  # other devices have had time to object
        self._device: Device | None = None
        self.used: dict[str, tuple[Alias, Subscription | None]] = {}  # by `Alias.claim`
        self._rivals: dict[str, list[str]] = {}  # by claim: the other devices that have it, as last logged

    def __contains__(self, alias: Alias) -> bool:
        return alias.claim in self.used

    def announce(self, device: Device) -> None:
        """Store a device whose manifest was just published. None of its aliases is in use yet."""
        self._device, self.permitted = device, False

    def permit(self, device: Device) -> None:
        """Start using aliases, because other devices have had time to object."""
        if device is self._device:
            self.permitted = True
            self.update()

    def update(self) -> None:
        """Use aliases that no other device claims, and release the rest: of two claimants neither uses the alias."""
        if self._device is None:
            return
        for route in self._device.routes.values():
            if route.alias is not None:
                self._update(self._device, route, route.alias)

    def withdraw(self) -> None:
        """Release all aliases, because the device is gone."""
        for claim in list(self.used):
            self._release(claim)
        self._device, self.permitted = None, False
        self._rivals.clear()

    def _update(self, device: Device, route: Route, alias: Alias) -> None:
        """Use an alias, or release it while another device claims it or the config names another owner."""
        owner = self._owners.get(alias.claim.partition("/")[2])  # a claim is a channel with its direction before it
        rivals = self._peers.claimants(alias.claim)
        if owner is not None:
            rivals = [] if owner == device.uid else [owner]
        self._log_conflict(device, alias.claim, rivals, owner)
        if rivals:
            self._release(alias.claim)
        elif self.permitted and alias.claim not in self.used:
            self.used[alias.claim] = alias, None  # counts as used already, so that begin can publish on it
            self.used[alias.claim] = alias, self._begin(device, route, alias)

    def _release(self, claim: str) -> None:
        if claim in self.used:
            alias, subscription = self.used.pop(claim)
            if subscription is not None:
                subscription.close()
            self._end(alias)

    def _log_conflict(self, device: Device, claim: str, rivals: list[str], owner: str | None) -> None:
        """Log when a conflict about a claim begins, and when it ends."""
        before = self._rivals.pop(claim, [])
        if rivals:
            self._rivals[claim] = rivals
        if rivals and not before and owner is not None:
            self._log.info("%s: %s is %s's by the config", device.uid, claim, owner)
        elif rivals and not before:
            others = " and ".join(rivals)
            text = "%s and %s both claim %s: neither has it until one of them leaves, both use mcu/… only"
            self._log.warning(text, device.uid, others, claim)
        elif before and not rivals:
            self._log.info("%s: %s is in use again", device.uid, claim)
