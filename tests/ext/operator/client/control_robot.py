"""A robot that keeps control itself, without a broker: motor owners with their real leases, and what they publish."""

from __future__ import annotations

import json
import operator
from itertools import count

from pebble.contract import CONTROL, CONTROL_TAKE, DRIVE, codec
from pebble.contract.payloads import ControlRequest
from pebble.motion.lease import Lease
from pebble.transports import Message
from tests.ext.operator.client.estop_robot import outgoing

_keys = count(1)
_NOT = ("", "", "", "")  # no client


class Owner:
    """One motor owner. Times are seconds; ``receives``: whether requests reach it."""

    def __init__(self, base: str, name: str) -> None:
        self.base, self.name = base, name
        self.receives = True
        self.named = False  # its names are checked
        self.start(0.0)

    def start(self, now: float) -> None:
        """It is started again: nobody has control."""
        self.lease = Lease(round(1000 * now), operator.sub, lambda _bytes: f"{next(_keys):08x}", 0)

    @property
    def by(self) -> str:
        """Who has control; "" nobody."""
        return str(self.lease.holder[2]) if self.lease.key else ""

    def receive(self, message: Message, now: float) -> None:
        metric, now_ms = message.topic.removeprefix(f"{self.base}/incoming/"), round(1000 * now)
        if metric == DRIVE.metric:
            drive = json.loads(message.payload)
            if any(drive.get(axis) for axis in "xyz"):
                self.drive(drive.get("key", ""), now)
        if not self.receives or metric not in (CONTROL.metric, CONTROL_TAKE.metric):
            return
        request: ControlRequest = codec.decode(CONTROL, message.payload)
        client = "", request.id, request.by, request.device
        if request.ends():
            self.lease.release(client, now_ms)
        else:
            self.lease.hold(client, int(request.for_ms), metric == CONTROL_TAKE.metric, now_ms)

    def drive(self, key: str, now: float) -> bool:
        """Whether a command with this key moves it."""
        now_ms = round(1000 * now)
        self.lease.tick(now_ms)
        return not self.lease.refuses(True, False, key, "", now_ms)

    def state(self) -> Message:
        lease = self.lease
        (_, name, by, device), (_, asks_id, asks, _) = lease.holder or _NOT, lease.asker or _NOT
        state = {"by": by, "id": name, "key": lease.key, "device": device, "asks": asks, "asks_id": asks_id}
        more = {"others": lease.others, "named": self.named, "boot": "5f0c2a91"}
        return outgoing(self.base, f"control/{self.name}", state | more, retain=True)


class KeepingRobot:
    """All motor owners of one robot."""

    def __init__(self, base: str, *owners: str) -> None:
        self.owners = [Owner(base, name) for name in owners or ("serial",)]

    def take(self, messages: list[Message], now: float) -> list[Message]:
        """Messages reach it, or only time; what it then publishes."""
        for owner in self.owners:
            owner.lease.tick(round(1000 * now))
            for message in messages:
                owner.receive(message, now)
        changed = [owner for owner in self.owners if owner.lease.changed]
        for owner in changed:
            owner.lease.changed = False
        return [owner.state() for owner in changed]

    def states(self) -> list[Message]:
        return [one.state() for one in self.owners]
