"""A robot with Wi-Fi in virtual time, an operator that drives it, faults at random times, and one rule that must hold.

The rule: motors only run as requested by a command that is fresh, not retained, and reached the board in the last
second, and never while a stop is latched, also after a power cut. It is checked at every event, also while the firmware
blocks. The motors are read from the pins and the bus, not from the simulated body.
"""

from __future__ import annotations

import heapq
import itertools
import json
import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.ports import OF_ROBOT
from tests.ext.lab.simulation.virtual_network import VirtualBroker, VirtualNetwork
from tests.kit.schedules import ViolatedError

START_S: Final = 1000.0  # of the clock, when a drill begins
BUSY_S: Final = 0.01
TURN_S: Final = 0.15  # until a command acts or has been replaced by a newer one: several turns of the loop
LIMIT_S: Final = 1.0  # motors are off this long after the last command that arrived
RESENT_S: Final = 0.3  # a packet that was lost comes so much later
STALE_S: Final = 2.45  # no command that is longer on its way moves: 2 s of silence, the longest latency, two slow turns
BASE: Final = "pebble/robots/rover"
DRIVE, ONLINE = f"{BASE}/incoming/drive-values", f"{BASE}/outgoing/online"
NAME: Final = "00000000000000aa"  # of a stop
ESTOP, RESET, STATE = f"{BASE}/incoming/estop", f"{BASE}/incoming/estop-reset", f"{BASE}/outgoing/estop/mcu"

CONTROL, HOLDER = f"{BASE}/incoming/control", f"{BASE}/outgoing/control/mcu"

_WRAP_MS = 1 << 30
Outputs = tuple[float, ...]


class Shield:
    """BenJr's motor shield on the bus: the last message holds until the next one, as on the real one."""

    def __init__(self) -> None:
        self.speeds = [0.0, 0.0]

    def write(self, data: bytes) -> None:
        assert len(data) == 4, data
        if data[0] in (0x10, 0x11):
            duty = int.from_bytes(data[2:], "big") / 10_000
            self.speeds[data[0] & 1] = {1: -duty, 2: duty}.get(data[1], 0.0)

    def read(self, count: int) -> bytes:
        return bytes(count)


class WatchedClock(VirtualClock):
    """Calls ``watch`` whenever time passes, also while the firmware blocks."""

    def __init__(self, now: float) -> None:
        super().__init__(now)
        self.watch: Callable[[], None] = lambda: None

    def advance(self, seconds: float) -> None:
        super().advance(seconds)
        self.watch()


@dataclass
class Arrived:
    """A command that asks for ``wish``: when it left the broker, reached the board, and was followed by another."""

    sent: float
    arrived: float
    wish: Outputs
    superseded: float = math.inf


class Drill:
    """One robot and its environment; ``seed`` is that of all randomness."""

    def __init__(self, kind: str, seed: int) -> None:
        self.kind, self.random = kind, random.Random(f"{kind} {seed}")
        self.clock = WatchedClock(START_S)
        self.broker = VirtualBroker(self.clock.now)
        port = OF_ROBOT[kind]
        self.network = VirtualNetwork(self.clock, self.broker, platform=port.platform)
        self._latency = self.random.uniform(0.002, 0.03)
        self.network.conditions.latency_s = self._latency_s
        self.network.conditions.cut = self._cut
        self.network.radio.rejoins = self.random.random() < 0.7
        self.network.radio.join_s = self.random.choice((0.3, 1.0, 3.0))
        wraps = self.random.random() < 0.5
        self.board = Board(
            self.clock,
            self.network,
            bytes([1, 2, 3, 4, 5, 6]),
            port=port,
            seed=seed,
            ticks_at_boot_ms=_WRAP_MS - self.random.randrange(1000, 9000) if wraps else 0,
        )
        self.moves = 0  # how often the motors began to do something else, but rest
        self.quiet = False  # whether the operator sends nothing
        self.lossy = False
        self._rests_until = 0.0
        self._before: Outputs = ()
        self._commands: list[Arrived] = []
        self._arrived: dict[int, float] = {}  # of each command on its way through the board's buffers, by its id
        self._meant: dict[bytes, Outputs] = {}
        self._events: list[tuple[float, int, Callable[[], object]]] = []
        self._count = itertools.count()
        self.robot = self._boot()
        self.clock.watch = self.check

    def _latency_s(self) -> float:
        """One way; on a lossy path a packet in two hundred is sent again."""
        lost = self.lossy and self.random.random() < 0.005
        return self._latency * self.random.uniform(1.0, 2.0) + (RESENT_S if lost else 0.0)

    def _cut(self, size: int) -> int:
        """And one in ten comes in two parts."""
        parted = self.lossy and size > 1 and self.random.random() < 0.1
        return self.random.randrange(1, size) if parted else size

    def _boot(self) -> Any:
        pins = self.board.firmware.module(f"{self.kind}.pins")
        if self.kind == "benjr":
            self._shield_address, self.shield = pins.MOTOR_SHIELD, Shield()
            self.board.bus.attach(self._shield_address, self.shield)
        self._pairs = [getattr(pins, name, None) for name in ("LEFT", "RIGHT", "GROUSERS")]
        host = self.random.choice(("10.0.0.2", "broker.test", "broker.local"))
        settings = {"robot": {"id": "rover"}, "wifi": {"ssid": "home", "password": "secret"}, "mqtt": {"host": host}}
        return self.board.load(self.kind, {**settings, "security": {"level": "open", "strangers": "drive"}})

    def cut_power(self) -> None:
        """Off, and on again at once: only the board's files survive."""
        newest, latch = self.state(), self.robot.stops.latch
        current = {"latched": latch.latched, "boot": latch.boot, "count": latch.count, "persisted": True}
        promised = latch.latched and current.items() <= newest.items()
        self._commands.clear()
        self._arrived.clear()
        self.network.power_off()
        self.robot = self._boot()
        if promised and not self.robot.stops.latch.latched:
            raise ViolatedError(f"{self.seconds:.3f} s: a power cut has freed a robot that was said to be stopped")

    # -- time

    def at(self, seconds: float, event: Callable[[], object]) -> None:
        """Call ``event`` at that time of the drill."""
        heapq.heappush(self._events, (START_S + seconds, next(self._count), event))

    @property
    def seconds(self) -> float:
        """Duration of the drill so far."""
        return self.clock.now() - START_S

    def run(self, until: float) -> None:
        """Turns of the loop until the drill is ``until`` seconds old; some are slow."""
        while self.seconds < until:
            self.turn(self.random.uniform(0.005, 0.04))

    def wait(self, seconds: float = 0.2) -> None:
        self.run(self.seconds + seconds)

    def turn(self, seconds: float) -> None:
        """Time passes, the world does what is due, then the firmware's loop turns once.

        A loop with something to read turns again soon: 10 ms for a kilobyte is what the slowest board needs.
        """
        self.clock.advance(min(seconds, BUSY_S) if self.network.has_unread else seconds)
        while self._events and self._events[0][0] <= self.clock.now():
            heapq.heappop(self._events)[2]()
        self.network.step()
        began = self.clock.now()
        try:
            self.robot.step()
        except ViolatedError:
            raise
        except Exception as error:
            raise ViolatedError(f"{self.seconds:.3f} s: a turn of the loop ended with {error!r}") from error
        self.check()
        if self.clock.now() > began:
            raise ViolatedError(f"{self.seconds:.3f} s: a turn of the loop waited for {self.clock.now() - began:.1f} s")

    def received(self, topic: str, since: float = 0.0) -> list[bytes]:
        """What the robot has published on ``topic`` since that time of the drill."""
        start = since + START_S
        return [one.message.payload for one in self.broker.received if one.at >= start and one.message.topic == topic]

    # -- the operator

    def command(self, x: float, z: float, y: float = 0.0, *, qos: int = 1, retain: bool = False, **more: Any) -> None:
        payload = json.dumps({"x": x, "z": z, "y": y, **more}).encode()
        self._meant[payload] = wanted(self.kind, x, z, y)
        self.broker.publish(DRIVE, payload, qos=qos, retain=retain)

    def nonsense(self, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        """Publish a command that must not move a robot."""
        self.broker.publish(DRIVE, payload, qos=qos, retain=retain)

    def stop(self, name: str = NAME, **more: str) -> None:
        self.broker.publish(ESTOP, json.dumps({"stop": name, "by": "drill", **more}).encode(), qos=1)

    def reset(self, *, behind: int = 0, **changes: Any) -> None:
        """Reset by the newest state that arrived, or one that is so many stops older, or with other ``changes``."""
        if state := self.state():
            order = {"boot": state["boot"], "count": state["count"] - behind, "by": "drill", **changes}
            self.broker.publish(RESET, json.dumps(order).encode(), qos=1)

    def state(self) -> dict[str, Any]:
        """The newest state of the emergency stop that arrived; empty: none."""
        payloads = self.received(STATE)
        state: dict[str, Any] = json.loads(payloads[-1]) if payloads else {}
        return state

    def request(self, name: str = "aaaaaaaa", *, take: bool = False, **more: Any) -> None:
        topic = f"{CONTROL}/take" if take else CONTROL
        self.broker.publish(topic, json.dumps({"id": name, "by": f"drill-{name[0]}", **more}).encode(), qos=1)

    def control(self) -> dict[str, Any]:
        """The newest state of control that arrived; empty: none."""
        payloads = self.received(HOLDER)
        state: dict[str, Any] = json.loads(payloads[-1]) if payloads else {}
        return state

    # -- faults

    def clear_sky(self) -> None:
        """All faults are over."""
        self.quiet = False
        self.network.conditions.hole = self.network.conditions.mute = False
        self.network.conditions.dns = self.network.conditions.ntp = "answers"
        self.network.radio.restore()
        self.broker.thaw()
        self.broker.start()
        self._events.clear()
        self.board.files.before = lambda *_: None
        if self.kind == "benjr":
            self.board.bus.restore(self._shield_address)

    def failing_i2c(self, seconds: float) -> None:
        """The motor shield does not answer for a while; the rule rests until the next turn after that."""
        if self.kind == "benjr":
            self.board.bus.fail(self._shield_address)
            self.at(self.seconds + seconds, lambda: self.board.bus.restore(self._shield_address))
            self._rests_until = self.clock.now() + seconds + TURN_S

    # -- the rule

    def outputs(self) -> Outputs:
        if self.kind == "benjr":
            return tuple(map(_fine, self.shield.speeds))
        return tuple(self.board.duty(ahead) - self.board.duty(back) for ahead, back in self._pairs)

    def check(self) -> None:
        outputs, now = self.outputs(), self.clock.now()
        self._take_reads()
        if any(outputs) and now > self._rests_until:
            if self.robot.stops.latch.latched:
                raise ViolatedError(f"{self.seconds:.3f} s: the motors are at {outputs} though a stop is latched")
            self._check_motion(now, outputs)
        self._before = outputs

    def _check_motion(self, now: float, outputs: Outputs) -> None:
        asked = [one for one in self._commands if now - one.arrived <= LIMIT_S and one.wish == outputs]
        asked = [one for one in asked if now - one.superseded <= TURN_S]
        if not asked:
            raise ViolatedError(
                f"{self.seconds:.3f} s: the motors are at {outputs}, without a command for it in the last second"
            )
        if outputs != self._before:
            self.moves += 1
            age_s = min(now - one.sent for one in asked)
            if age_s > STALE_S:
                raise ViolatedError(
                    f"{self.seconds:.3f} s: a command that was {age_s:.2f} s on its way moves the motors"
                )

    def _take_reads(self) -> None:
        """Judge what the firmware has read since the last time; a command counts from its arrival at the board."""
        self._arrived.update((id(command), arrived) for arrived, command in self.network.arrivals)
        self.network.arrivals.clear()
        now = self.clock.now()
        for command in self.network.reads:
            arrived = self._arrived.pop(id(command), now)
            wish = None if command.retained or command.topic != DRIVE else self._meant.get(command.payload)
            if wish is not None:
                for one in self._commands[-1:]:
                    one.superseded = min(one.superseded, arrived)
                self._commands.append(Arrived(command.left_at, arrived, wish))
        self.network.reads.clear()


def wanted(kind: str, x: float, z: float, y: float) -> Outputs:
    """What a command makes of the outputs: signs of three motors, or the speeds of the shield's motors A and B."""
    x, z, y = map(_clamp, (x, z, y))
    if kind == "benjr":  # mounted the other way round: throttle negated, sides swapped
        return _fine(_clamp(-z - x)), _fine(_clamp(-z + x))
    return tuple(0.0 if abs(v) < 0.25 else math.copysign(1.0, v) for v in (_clamp(z + x), _clamp(z - x), y))


def _clamp(value: float) -> float:
    return max(-1.0, min(1.0, value))


def _fine(speed: float) -> float:
    """Finer the tests do not look: the shield has steps of 1/10,000."""
    return round(speed, 3) + 0.0
