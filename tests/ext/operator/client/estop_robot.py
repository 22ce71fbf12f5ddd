"""Robots with scripted motor owners: their real latches and leases, and the messages they publish."""

from __future__ import annotations

import json
from itertools import count
from operator import sub
from typing import Any

from pebble.contract import CONTROL, CONTROL_TAKE, DRIVE, codec
from pebble.contract.payloads import ControlRequest, EstopState
from pebble.motion.latch import Latch, reset_of, stop_of
from pebble.motion.lease import Lease
from pebble.transports import Message, QoS

NOBODY = ("", "", "", "")
_keys = count(1)


def outgoing(base: str, metric: str, body: object, *, retain: bool = False) -> Message:
    """A message of a robot."""
    return Message(f"{base}/outgoing/{metric}", json.dumps(body).encode(), QoS.DELIVERED, retain=retain)


def capabilities(base: str, value: dict[str, Any]) -> Message:
    return outgoing(base, "capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, retain=True)


def estop_state(**changes: Any) -> EstopState:
    """The state of a motor owner that is free."""
    free = {"latched": False, "boot": "b1", "count": 0, "recent": [], "by": "", "why": "", "since": 0}
    return EstopState(**{**free, **changes})


class Owner:
    """One motor owner. ``persisted`` is what it publishes about its file."""

    def __init__(self, base: str, name: str, *, boot: str = "00c0ffee", persisted: bool | None = True) -> None:
        self.base, self.name, self.persisted = base, name, persisted
        self.latch = Latch(boot, 8, sub)

    def state(self, *, retain: bool = False) -> Message:
        return outgoing(self.base, f"estop/{self.name}", self.latch.state(self.persisted), retain=retain)

    def take(self, message: Message) -> None:
        """Handle a stop or a reset that was published to its robot."""
        body = json.loads(message.payload)
        if message.topic == f"{self.base}/incoming/estop":
            name, by, why = stop_of(body)
            self.latch.stop(name, by, why, 1_760_000_000_000)
        elif message.topic == f"{self.base}/incoming/estop-reset":
            reset = reset_of(body)
            assert reset is not None
            self.latch.reset(*reset, age=0, now=0)


class Robot:
    """Motor owners behind one set of capabilities."""

    def __init__(self, base: str, *names: str, persisted: bool | None = True, **more: Any) -> None:
        self.base = base
        self.owners = [
            Owner(base, name, boot=f"{number:08x}", persisted=persisted) for number, name in enumerate(names)
        ]
        self.value = {
            "drive": {"available": True, "topic": f"{base}/incoming/drive-values", "arbitrates": True},
            "estop": {"available": True, "owners": list(names)},
            **more,
        }

    def capabilities(self) -> Message:
        return capabilities(self.base, self.value)

    def take(self, messages: list[Message]) -> list[Message]:
        """Handle what was published; return the new states of the owners that got a stop or reset."""
        for message in messages:
            for owner in self.owners:
                owner.take(message)
        stops = [message for message in messages if "/incoming/estop" in message.topic]
        return [owner.state() for owner in self.owners] if stops else []


class Keeper:
    """One motor owner that keeps control. Times are seconds; ``receives``: whether requests reach it."""

    def __init__(self, base: str, name: str) -> None:
        self.base, self.name = base, name
        self.receives = True
        self.named = False  # its names are checked
        self.start(0.0)

    def start(self, now: float) -> None:
        """It is started again: nobody has control."""
        self.lease = Lease(round(1000 * now), sub, lambda _bytes: f"{next(_keys):08x}", 0)

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
        (_, name, by, device), (_, asks_id, asks, _) = lease.holder or NOBODY, lease.asker or NOBODY
        state = {"by": by, "id": name, "key": lease.key, "device": device, "asks": asks, "asks_id": asks_id}
        more = {"others": lease.others, "named": self.named, "boot": "5f0c2a91"}
        return outgoing(self.base, f"control/{self.name}", state | more, retain=True)


class KeepingRobot:
    """All motor owners of one robot."""

    def __init__(self, base: str, *owners: str) -> None:
        self.owners = [Keeper(base, name) for name in owners or ("serial",)]

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
