"""A robot with scripted motor owners: their real latches, and the messages they publish."""

from __future__ import annotations

import json
from operator import sub
from typing import Any

from pebble.contract.payloads import EstopState
from pebble.motion.latch import Latch, reset_of, stop_of
from pebble.transports import Message, QoS

_WALL_MS = 1_760_000_000_000


def outgoing(base: str, metric: str, body: object, *, retain: bool = False) -> Message:
    """A message of a robot."""
    return Message(f"{base}/outgoing/{metric}", json.dumps(body).encode(), QoS.DELIVERED, retain=retain)


def capabilities(base: str, value: dict[str, Any], *, retain: bool = True) -> Message:
    return outgoing(base, "capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, retain=retain)


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
            self.latch.stop(name, by, why, _WALL_MS)
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
