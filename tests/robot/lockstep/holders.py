"""Who has control of a robot, and whether it was silent before it lost control: by what the operators' broker had."""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import msgspec

from pebble.contract import CONTROL, CONTROL_TAKE, DRIVE
from pebble.contract.payloads import ControlTurn, ControlVouched
from pebble.transports import Message
from tests.robot.lockstep.drivers import BASE, Driver
from tests.robot.lockstep.network import Process, Scheduler

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
