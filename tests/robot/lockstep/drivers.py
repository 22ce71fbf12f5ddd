"""Drivers in virtual time, and who has control of a robot.

Drivers ask for control, drive with its keys or without one, and pretend to be scripts. Whether who loses control was
silent before is judged by what the operators' broker had.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping
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
from pebble.contract.payloads import ControlTurn, ControlVouched
from pebble.transports import Message, QoS
from tests.robot.lockstep.network import Connection, Network, Process, Scheduler

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
        self.let_go_at = self.took_at = -1e9
        self._connection = Connection(self, network).open(0.0)
        self._connection.subscribe(f"{BASE}/outgoing/#", self._receive, direct=True)

    # -- control

    def hold(self, for_ms: int = 3000, *, take: bool = False, period_s: float = 1.0, seconds: float = 1e9) -> None:
        """Ask, and go on asking."""
        self._wants += 1
        self.took_at = self.scheduler.now if take else self.took_at
        self._ask(self._wants, for_ms, take, period_s, self.scheduler.now + seconds)

    def _ask(self, number: int, for_ms: int, take: bool, period_s: float, until: float) -> None:
        if number != self._wants or self.scheduler.now >= until:
            return
        fields = {"id": self.id, "by": self.name, "for_ms": for_ms}
        self._publish((CONTROL_TAKE if take else CONTROL).topic(BASE), fields)
        self.scheduler.after(period_s, lambda: self._ask(number, for_ms, False, period_s, until))

    def let_go(self, *, release: bool = True) -> None:
        """Release control, or lose the connection."""
        self.let_go_at = self.scheduler.now
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


_REQUESTS = (CONTROL.topic(BASE), CONTROL_TAKE.topic(BASE))
_DRIVE = DRIVE.topic(BASE)
_IDLE_S, _MOST_S = 5.0, 30.0
_ROUND_S = 0.002  # times are whole milliseconds
_SETTLED_S = 15.0  # so long a release or a take may be under way
_TICK_S = 1.3  # until what is over has ended; its state is published twice a second


class Holders:
    """Checks each handover of the first owner; times are those of the scheduler."""

    def __init__(self, scheduler: Scheduler, owner: str) -> None:
        self._scheduler, self._owner = scheduler, owner
        self._heard: defaultdict[str, list[float]] = defaultdict(list)  # by id, or key: at the operators' broker
        self._moved: defaultdict[str, list[float]] = defaultdict(list)  # by key
        self._for_s: dict[str, float] = {}  # by id: the shortest
        self._arrived: defaultdict[str, float] = defaultdict(float)  # by id, or key: at the owner, the newest
        self._moves_arrived: defaultdict[str, float] = defaultdict(float)  # by key: the same
        self._vouched: list[float] = []  # until when, as the bridge has said
        self._held = ControlTurn(boot="", turn=0)
        self._since = 0.0

    def heard(self, _sender: Process, message: Message) -> None:
        """The operators' broker has a message for the robot."""
        fields = _fields(message)
        for name in self._names(message, fields):
            self._heard[name].append(self._scheduler.now)
            if _moves(fields):
                self._moved[name].append(self._scheduler.now)

    def arrived(self, message: Message) -> None:
        """The first owner has a message."""
        fields = _fields(message)
        for name in self._names(message, fields):
            self._arrived[name] = self._scheduler.now
            if _moves(fields):
                self._moves_arrived[name] = self._scheduler.now

    def vouched(self, vouched: ControlVouched) -> None:
        self._vouched = [*self._vouched, vouched.end / 1000][-20:]

    def granted(self, turn: ControlTurn, drivers: Mapping[str, Driver]) -> None:
        """The first owner shows who has control."""
        now, held = self._scheduler.now, self._held
        if turn.key:
            last = max(self._arrived[turn.id], self._arrived[turn.key])
            if turn.key == held.key:
                self._scheduler.check(now - last < _MOST_S + _TICK_S, "control does not end after 30 s")
        if (turn.boot, turn.turn) == (held.boot, held.turn):
            return
        self._held, since, self._since = turn, self._since, now
        if held.key and turn.boot == held.boot and turn.turn == held.turn + 1 and held.id != turn.id:
            self._passed_on(held, since, turn, drivers)

    def _passed_on(self, held: ControlTurn, since: float, turn: ControlTurn, drivers: Mapping[str, Driver]) -> None:
        now = self._scheduler.now
        if now - drivers[held.id].let_go_at < _SETTLED_S:
            return
        if turn.key and now - drivers[turn.id].took_at < _SETTLED_S:
            return
        heard = sorted([*self._heard[held.id], *self._heard[held.key], since])
        arrived = max(self._arrived[held.id], self._arrived[held.key])
        silent = now - arrived >= _MOST_S - _ROUND_S or self._was_without(heard, self._for_s[held.id])
        moved = sorted([*self._moved[held.key], since])
        arrived = max(self._moves_arrived[held.key], since)
        idle = now - arrived >= _MOST_S - _ROUND_S or self._was_without(moved, _IDLE_S)
        self._scheduler.check(silent or (idle and turn.key != ""), "control is lost, though its holder was not silent")

    def _was_without(self, times: list[float], seconds: float) -> bool:
        """True if there is a moment until which the bridge has vouched, and nothing came for so long before."""
        before = [(end, bisect_right(times, end - _ROUND_S)) for end in self._vouched]
        return any(at and end - times[at - 1] >= seconds - _ROUND_S for end, at in before)

    def _names(self, message: Message, fields: dict[str, Any]) -> list[str]:
        """The id of a request, or the keys of a drive command."""
        if message.topic in _REQUESTS and fields:
            if fields.get("want") == "release":
                return []
            self._for_s[fields["id"]] = min(self._for_s.get(fields["id"], 10.0), fields["for_ms"] / 1000)
            return [fields["id"]]
        return [key for key in fields.get("key", "").split(" ") if key] if message.topic == _DRIVE else []


def _moves(fields: dict[str, Any]) -> bool:
    return bool(fields.get("x") or fields.get("z"))


def _fields(message: Message) -> dict[str, Any]:
    """What it says; a probe says nothing."""
    interesting = message.topic in (*_REQUESTS, _DRIVE) and message.payload.strip()
    return msgspec.json.decode(message.payload) if interesting else {}
