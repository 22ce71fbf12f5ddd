"""A robot that pebble plays at a broker for a client that drives: what it publishes, and everything that it is sent."""

from __future__ import annotations

import json
import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

import msgspec

from pebble import contract as c
from pebble.client.connection import Target, connected, resolve
from pebble.conform.component import ask_person
from pebble.contract import channel_of, codec
from pebble.contract.levels import LEVELS
from pebble.contract.names import without_name
from pebble.contract.payloads import (
    Capabilities,
    ControlState,
    Drive,
    EstopCommand,
    EstopState,
    Heartbeat,
    LinkLevel,
    LinkState,
)
from pebble.errors import PayloadError, PebbleError
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create

_OPENS_S = 3.0
_PRESENT_S = 1.2  # a robot that is there sends a heartbeat
_STEP_S = 0.005
_HEARTBEAT_S = 0.25
_OWNER = "motors"
_MOST = 50_000  # commands that are kept
_RECENT = 8
_LONGEST_LIFE_S = 10.0  # of control without a request


@dataclass(frozen=True, slots=True)
class Sent:
    """One message to the robot, when it arrived (monotonic), and its value by the contract; ``wrong``: why it has none.

    ``raw`` is its JSON as it was sent, before anything is clamped.
    """

    at: float
    metric: str  # below the base, without a name: ``incoming/drive-values``
    account: str
    payload: bytes
    qos: int
    channel: c.Channel | None
    value: Any = None
    raw: Any = None
    wrong: str = ""

    @property
    def moves(self) -> bool:
        return isinstance(self.value, Drive) and self.value.moves


class Inbox:
    """Everything that a robot is sent, by its base topic; the newest of it is kept."""

    def __init__(self, base: str) -> None:
        self.sent: deque[Sent] = deque(maxlen=_MOST)
        self._base = base
        self._arrived: deque[tuple[Message, float]] = deque(maxlen=_MOST)

    def take(self, message: Message) -> None:
        """Keep it until it is read. Safe from any thread."""
        self._arrived.append((message, time.monotonic()))

    def read(self) -> Iterator[tuple[Message, Sent]]:
        """What has arrived since the last time."""
        while self._arrived:
            message, at = self._arrived.popleft()
            one = self._parsed(message, at)
            self.sent.append(one)
            yield message, one

    def of(self, channel: c.Channel, since: float = 0.0) -> list[Sent]:
        return [one for one in self.sent if one.channel is channel and one.at >= since]

    def moving(self, since: float = 0.0) -> list[Sent]:
        """The commands that would turn wheels."""
        return [one for one in self.of(c.DRIVE, since) if one.moves]

    def _parsed(self, message: Message, at: float) -> Sent:
        named = without_name(message.topic)
        topic = message.topic if named is None else named.topic
        metric = topic.removeprefix(f"{self._base}/")
        channel = channel_of(metric)
        value: Any = None
        raw: Any = None
        wrong = ""
        try:
            raw = json.loads(message.payload)
            raw = raw["value"] if isinstance(raw, dict) and isinstance(raw.get("value"), dict) else raw
            value = None if channel is None else codec.decode(channel, message.payload)
        except (PayloadError, ValueError, RecursionError) as error:
            wrong = f"{metric}: {error}"
        account = "" if named is None else named.account
        return Sent(at, metric, account, message.payload, message.qos, channel, value, raw, wrong)


class StandIn:
    """The robot. Its checks let time pass by :meth:`wait`, which also takes what has arrived and sends heartbeats."""

    def __init__(self, target: Target, transport: Transport, base: str, *, named: bool) -> None:
        self.base, self.named = base, named
        self.ask = ask_person
        self.person_s = 180.0  # until a person has done it
        self.inbox = Inbox(base)
        self.stalled_s = 0.0  # is not measured: a person would have to do all again
        self.alive = True  # whether heartbeats are sent
        self.other = ""  # who has control instead of the client under test
        self.confirms = True  # whether a stop is confirmed
        self.stop = EstopState(latched=False, boot=secrets.token_hex(4), count=0, recent=[], by="", why="", since=0)
        self.control = ControlState(by="", id="", key="", named=named, boot=self.stop.boot)
        self._ends = self._heartbeat_at = 0.0
        self._target, self._transport = target, transport
        transport.subscribe(f"{base}/{c.INCOMING}/#", self.inbox.take, qos=QoS.DELIVERED, direct=True)
        self._publish(
            c.CAPABILITIES, Capabilities(t=_ms(), schema="pebble-capabilities/v1", value=self._capabilities())
        )
        self._publish(c.ESTOP_STATE, self.stop, owner=_OWNER)
        self._publish(c.CONTROL_STATE, self.control, owner=_OWNER)
        self.link("wide")

    def _capabilities(self) -> dict[str, Any]:
        return {
            "drive": {"available": True, "controls": True, "control": True},
            "estop": {"available": True, "owners": [_OWNER]},
            "named": self.named,
        }

    # -- time

    def wait(self, condition: Callable[[], object], seconds: float) -> bool:
        """Be a robot until ``condition``; False: not within ``seconds``."""
        end = time.monotonic() + seconds
        while True:
            for message, one in self.inbox.read():
                self._receive(message, one)
            now = time.monotonic()
            if self.alive and now >= self._heartbeat_at:
                self._heartbeat_at = now + _HEARTBEAT_S
                self._publish(c.ONLINE, Heartbeat(t=_ms()))
            if self.control.key and not self.other and now >= self._ends:
                self._pass_on("", "")
            if condition():
                return True
            if now >= end:
                return False
            time.sleep(_STEP_S)

    def look(self, seconds: float) -> float:
        """Only let time pass; returns when that began."""
        began = time.monotonic()
        self.wait(lambda: False, seconds)
        return began

    def retained(self) -> list[str]:
        """The topics of commands that the broker has retained."""
        found: deque[Message] = deque(maxlen=_MOST)
        with connected(self._target) as (beside, _):
            beside.subscribe(f"{self.base}/{c.INCOMING}/#", found.append, qos=QoS.DELIVERED, direct=True)
            self.look(1.0)
        return sorted({one.topic.removeprefix(f"{self.base}/") for one in list(found) if one.retain and one.payload})

    # -- what the robot does

    def _receive(self, message: Message, one: Sent) -> None:
        channel, value = one.channel, one.value
        if message.retain or one.wrong:
            return
        if channel is c.ESTOP and isinstance(value, EstopCommand):
            self.latch(str(value.stop))
        elif channel is c.ESTOP_RESET and (value.boot, value.count) == (self.stop.boot, self.stop.count):
            self.free()
        elif channel in (c.CONTROL, c.CONTROL_TAKE):
            self._lease(value, take=channel is c.CONTROL_TAKE)
        elif channel is c.DRIVE and value.key == self.control.key:
            self._ends = max(self._ends, one.at + 1.0)

    def latch(self, name: str) -> None:
        """A stop of this name has arrived."""
        if self.confirms and name not in self.stop.recent:
            self._stop_is(latched=True, count=self.stop.count + 1, recent=[name, *self.stop.recent][:_RECENT])

    def free(self) -> None:
        self._stop_is(latched=False)

    def _stop_is(self, **changes: Any) -> None:
        self.stop = msgspec.structs.replace(self.stop, **changes)
        self._publish(c.ESTOP_STATE, self.stop, owner=_OWNER)

    def _lease(self, request: Any, *, take: bool) -> None:
        mine = request.id == self.control.id
        if request.want == "release":
            if mine:
                self._pass_on("", "")
        elif self.other:
            self._publish_control(asks=request.by, asks_id=request.id)
        elif mine or take or not self.control.key:
            self._ends = time.monotonic() + min(max(request.for_ms / 1000, 1.0), _LONGEST_LIFE_S)
            if not mine:
                self._pass_on(request.id, request.by)

    def _pass_on(self, id_: str, by: str) -> None:
        key = secrets.token_hex(4) if id_ else ""
        self._publish_control(id=id_, by=by, key=key, asks="", asks_id="")

    def _publish_control(self, **changes: Any) -> None:
        self.control = msgspec.structs.replace(self.control, **changes)
        self._publish(c.CONTROL_STATE, self.control, owner=_OWNER)

    def give_to(self, other: str) -> None:
        """Another client, of this name, has control from now on; empty: it is free again."""
        self.other = other
        self._pass_on(secrets.token_hex(4) if other else "", other)

    def link(self, level: LinkLevel) -> None:
        """Report this link."""
        self._publish(c.LINK, LinkState(level=level, drive_hz=LEVELS[level].drive_hz, rtt_ms=600, queue_ms=0, t=_ms()))

    def gone(self) -> None:
        """What its will would tell, and no heartbeats after it."""
        self.alive = False
        self._publish(c.ONLINE, Heartbeat(t=_ms(), online=False))

    def _publish(self, channel: c.Channel, value: object, **names: str) -> None:
        topic = channel.topic(self.base, **names)
        retain, qos = channel.default_retain, QoS(channel.default_qos)
        self._transport.publish(topic, codec.encode(channel, value), qos=qos, retain=retain, urgent=True)

    def leave(self) -> None:
        """Take away what is retained of it."""
        topics = [c.CAPABILITIES.topic(self.base), c.LINK.topic(self.base), c.ONLINE.topic(self.base)]
        topics += [one.topic(self.base, owner=_OWNER) for one in (c.ESTOP_STATE, c.CONTROL_STATE)]
        for topic in topics:
            self._transport.publish(topic, b"", qos=QoS.DELIVERED, retain=True, remember=False)
        self.wait(lambda: self._transport.outgoing.waiting == 0, 1.0)


def _ms() -> int:
    return int(1000 * time.time())


def _is_there(transport: Transport, base: str) -> bool:
    """Whether heartbeats come from a robot of this name."""
    found = threading.Event()

    def take(message: Message) -> None:
        if not message.retain:
            found.set()

    subscription = transport.subscribe(c.ONLINE.topic(base), take, direct=True)
    is_there = found.wait(_PRESENT_S)
    subscription.close()
    return is_there


@contextmanager
def played(target: Target) -> Iterator[StandIn]:
    """Be the robot of this target, until the end. Raises PebbleError, also where a robot of this name is there."""
    kind, settings, names, where = resolve(target)
    if not isinstance(settings, MqttSettings):
        raise PebbleError("a robot is played at a broker: use --url mqtt://BROKER")
    transport = create(kind, f"pebble-conform-{os.getpid()}", settings)
    with closing(transport.open(_OPENS_S)):
        if transport.state is not State.CONNECTED:
            raise PebbleError(f"cannot connect to {where}: {transport.problem or 'no answer'}")
        if _is_there(transport, names.base):
            raise PebbleError(f"{names.base} is a robot that runs at this broker: play one of another name")
        robot = StandIn(target, transport, names.base, named=bool(settings.username))
        try:
            yield robot
        finally:
            robot.leave()
