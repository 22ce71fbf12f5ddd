"""A robot that keeps control itself, without a broker: its motor owners answer requests by their states."""

from __future__ import annotations

import json
from typing import Any

from pebble.contract import CONTROL, CONTROL_STATE, CONTROL_TAKE, DRIVE, codec
from pebble.contract.payloads import ControlRequest, ControlState
from pebble.transports import Message

IDLE_S = 5.0  # who has moved nothing for so long is not asked


class Owner:
    """One motor owner, by the table of docs/operator-page.md. Times are seconds."""

    def __init__(self, base: str, name: str) -> None:
        self.base, self.name = base, name
        self.hears, self.others = True, False
        self.keys = 0
        self.start(0.0)

    def start(self, now: float) -> None:
        """It is started again: nobody has control."""
        self.holder: ControlRequest | None = None
        self.asker: ControlRequest | None = None
        self.key = ""
        self.heard = self.asked = self.moved = now

    def receive(self, message: Message, now: float) -> None:
        metric = message.topic.removeprefix(f"{self.base}/incoming/")
        if metric == DRIVE.metric:
            self.drive(json.loads(message.payload).get("key", ""), now)
        if not self.hears or metric not in (CONTROL.metric, CONTROL_TAKE.metric):
            return
        request: ControlRequest = codec.decode(CONTROL, message.payload)
        holds = self.holder is not None and self.holder.id == request.id
        if request.want == "release":
            if holds:
                self.end(now)
            elif self.asker is not None and self.asker.id == request.id:
                self.asker = None
        elif holds:
            self.heard = now
        elif self.holder is None or metric == CONTROL_TAKE.metric or now - self.moved >= IDLE_S:
            self.give(request, now)
        elif self.asker is None or self.asker.id == request.id:
            self.asker, self.asked = request, now

    def drive(self, key: str, now: float) -> bool:
        """Whether a command with this key moves it."""
        if not self.key or self.key not in key:
            return False
        self.heard = self.moved = now
        return True

    def tick(self, now: float) -> None:
        if self.asker is not None and now - self.asked >= self.asker.for_ms / 1000:
            self.asker = None
        if self.holder is not None and now - self.heard >= self.holder.for_ms / 1000:
            self.end(now)

    def give(self, request: ControlRequest, now: float) -> None:
        self.keys += 1
        self.holder, self.asker, self.key = request, None, f"{self.name[0]}{self.keys:07x}"
        self.heard = self.moved = now

    def end(self, now: float) -> None:
        asker, self.holder, self.asker, self.key = self.asker, None, None, ""
        if asker is not None:
            self.give(asker, now)

    def state(self) -> Message:
        holder, asker = self.holder, self.asker
        state = ControlState(
            by="" if holder is None else holder.by,
            id="" if holder is None else holder.id,
            key=self.key,
            device="" if holder is None else holder.device,
            asks="" if asker is None else asker.by,
            asks_id="" if asker is None else asker.id,
            others=self.others,
            boot="5f0c2a91",
        )
        topic = CONTROL_STATE.topic(self.base, owner=self.name)
        return Message(topic, codec.encode(CONTROL_STATE, state), retain=True)


class KeepingRobot:
    """All motor owners of one robot, and what its capabilities are."""

    def __init__(self, base: str, *owners: str) -> None:
        self.base = base
        self.owners = [Owner(base, name) for name in owners or ("serial",)]

    def capabilities(self, **drive: Any) -> Message:
        value = {
            "drive": {"available": True, "controls": True, "arbitrates": True, "control": True, **drive},
            "estop": {"available": True, "owners": [one.name for one in self.owners]},
        }
        payload = json.dumps({"schema": "pebble-capabilities/v1", "t": 1, "value": value}).encode()
        return Message(f"{self.base}/outgoing/capabilities", payload, retain=True)

    def take(self, messages: list[Message], now: float) -> list[Message]:
        """Requests reach it, or only time; what it then publishes."""
        before = self.states()
        for owner in self.owners:
            owner.tick(now)
            for message in messages:
                owner.receive(message, now)
        return [one for one in self.states() if one not in before]

    def states(self) -> list[Message]:
        return [one.state() for one in self.owners]
