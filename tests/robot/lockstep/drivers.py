"""Drivers in virtual time: they ask for control, drive with its keys or without one, and pretend to be scripts."""

from __future__ import annotations

from itertools import count
from typing import Any

import msgspec

from pebble.contract import (
    CONTROL,
    CONTROL_STATE,
    CONTROL_TAKE,
    DRIVE,
    ESTOP,
    ESTOP_RESET,
    ESTOP_STATE,
    codec,
)
from pebble.transports import Message, QoS
from tests.robot.lockstep.network import Connection, Network, Process

BASE = "pebble/robots/goob"
SCRIPT = "script"
STRANGER = "stranger"  # all commands without a key are of one driver: nobody can tell them apart
PERIOD_S = 0.1


class Commands:
    """Senders of commands by the speeds of the wheels, in thousandths: each command has its own."""

    def __init__(self) -> None:
        self._numbers = count()
        self._senders: dict[tuple[int, int], str] = {}

    def add(self, sender: str) -> tuple[float, float]:
        """Return ``x`` and ``z`` of a new command."""
        number = next(self._numbers)
        left, right = 300 + number % 697, 300 + number // 697  # 697 is a prime: neighbours differ
        self._senders[left, right] = sender
        return (left - right) / 2000, (left + right) / 2000

    def sender_of(self, speeds: tuple[int, int]) -> str:
        return self._senders[speeds]


class Driver(Process):
    """A page of a person, or a program that knows nothing of control."""

    def __init__(self, name: str, network: Network, commands: Commands) -> None:
        super().__init__(name, network.scheduler)
        self.alive = True
        self.id = (name.encode().hex() * 8)[:8]
        self.seen: dict[str, Any] = {}  # the newest state of control, by owner
        self.old_keys: list[str] = []  # under which it had control once
        self.old_stops: list[dict[str, str]] = []
        self._stop_numbers = count(int.from_bytes(name.encode()) << 16)
        self._stops: dict[str, Any] = {}
        self._commands = commands
        self._wants = self._gesture = 0
        self._connection = Connection(self, network).open(0.0)
        self._connection.subscribe(f"{BASE}/outgoing/#", self._receive, direct=True)

    # -- control

    def hold(self, for_ms: int = 3000, *, take: bool = False, period_s: float = 1.0, seconds: float = 1e9) -> None:
        """Ask, and go on asking."""
        self._wants += 1
        self._ask(self._wants, for_ms, take, period_s, self.scheduler.now + seconds)

    def _ask(self, number: int, for_ms: int, take: bool, period_s: float, until: float) -> None:
        if number != self._wants or self.scheduler.now >= until:
            return
        fields = {"id": self.id, "by": self.name, "for_ms": for_ms}
        self._publish((CONTROL_TAKE if take else CONTROL).topic(BASE), fields)
        self.scheduler.after(period_s, lambda: self._ask(number, for_ms, False, period_s, until))

    def let_go(self, *, release: bool = True) -> None:
        """Release control, or lose the connection."""
        self._wants += 1
        self._gesture += 1
        if release:
            self._publish(CONTROL.topic(BASE), {"id": self.id, "want": "release"})

    # -- driving

    @property
    def key(self) -> str:
        """As a page has it: the keys of all owners that show its id."""
        return " ".join(state.key for _, state in sorted(self.seen.items()) if state.id == self.id)

    def drive(self, key: str | None = None, **fields: Any) -> None:
        """One command; with ``key``, under that one."""
        key = self.key if key is None else key
        sender = SCRIPT if "run" in fields else self.name if key else STRANGER
        x, z = self._commands.add(sender)
        self._publish(DRIVE.topic(BASE), {"x": x, "z": z} | ({"key": key} if key else {}) | fields)

    def steer(self, seconds: float, key: str | None = None, **fields: Any) -> None:
        """Drive for so long."""
        self._gesture += 1
        self._steer(self._gesture, self.scheduler.now + seconds, key, fields)

    def _steer(self, gesture: int, until: float, key: str | None, fields: dict[str, Any]) -> None:
        if gesture == self._gesture and self.scheduler.now < until:
            if key is not None or self.key:  # a page without control sends nothing
                self.drive(key, **fields)
            self.scheduler.after(PERIOD_S, lambda: self._steer(gesture, until, key, fields))

    def zero(self, *, final: bool = False) -> None:
        self._publish(DRIVE.topic(BASE), {"x": 0, "z": 0} | ({"valid_ms": 0} if final else {}))

    def stop(self, *, named: bool = True) -> None:
        """Stop once, with a name of its own or without one."""
        fields = {"stop": f"{next(self._stop_numbers):016x}"} if named else {}
        if named:
            self.old_stops.append(fields)
        self._publish(ESTOP.topic(BASE), fields)

    def stop_again(self, number: int) -> None:
        """Repeat a stop of before, as who has seen no answer does."""
        if self.old_stops:
            self._publish(ESTOP.topic(BASE), self.old_stops[-1 - number % len(self.old_stops)])

    def reset(self) -> None:
        for state in self._stops.values():
            self._publish(ESTOP_RESET.topic(BASE), {"boot": state.boot, "count": state.count})

    # -- parts

    def publish_raw(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        self._connection.publish(topic, payload, qos=QoS.DELIVERED, retain=retain)

    def _publish(self, topic: str, fields: dict[str, Any]) -> None:
        self.publish_raw(topic, msgspec.json.encode(fields))

    def _receive(self, message: Message) -> None:
        owner = message.topic.rpartition("/")[2]
        if message.payload and message.topic == CONTROL_STATE.topic(BASE, owner=owner):
            state = self.seen[owner] = codec.decode(CONTROL_STATE, message.payload)
            if state.id == self.id and state.key not in self.old_keys:
                self.old_keys.append(state.key)
        elif message.payload and message.topic == ESTOP_STATE.topic(BASE, owner=owner):
            self._stops[owner] = codec.decode(ESTOP_STATE, message.payload)
