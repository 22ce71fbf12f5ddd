"""Persons in virtual time: they ask for control, drive with its keys or without one, stop, reset, and pretend."""

from __future__ import annotations

from typing import Any

import msgspec

from pebble.contract import CONTROL, CONTROL_STATE, CONTROL_TAKE, DRIVE, ESTOP, codec
from pebble.extensions.operator.client.estop_states import Reset, RobotEstop
from pebble.transports import Message, QoS
from tests.robot.lockstep.commands import PERSON, Command, Commands
from tests.robot.lockstep.network import Connection, Network
from tests.robot.lockstep.processes import Process

BASE = "pebble/robots/goob"
SCRIPT = "script"
STRANGER = "stranger"  # all commands without a key are of one driver: nobody can tell them apart
PERIOD_S = 0.1  # of a person's commands


class Person(Process):
    """A page of a person, or a program that knows nothing of control; not always by the contract."""

    def __init__(self, name: str, network: Network, commands: Commands) -> None:
        super().__init__(name, network.scheduler)
        self.alive = True
        self.id = (name.encode().hex() * 8)[:8]
        self.robot = RobotEstop(BASE)
        self.seen: dict[str, Any] = {}  # the newest state of control, by owner
        self.old_keys: list[str] = []  # under which it had control once
        self.let_go_at = self.took_at = -1e9
        self._commands = commands
        self._wants = self._gesture = 0
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
        self._publish(CONTROL_TAKE if take else CONTROL, fields)
        self.scheduler.after(period_s, lambda: self._ask(number, for_ms, False, period_s, until))

    def let_go(self, *, release: bool = True) -> None:
        """Release control, or lose the connection."""
        self.let_go_at = self.scheduler.now
        self._wants += 1
        self._gesture += 1
        if release:
            self._publish(CONTROL, {"id": self.id, "want": "release"})

    # -- driving

    @property
    def key(self) -> str:
        """Return it as a page has it: the keys of all owners that show its id."""
        return " ".join(state.key for _, state in sorted(self.seen.items()) if state.id == self.id)

    def drive(self, key: str | None = None, **fields: Any) -> None:
        """Publish one command; with ``key``, under that one."""
        key = self.key if key is None else key
        sender = SCRIPT if "run" in fields else self.name if key else STRANGER
        x, z = self._commands.add(Command(fields.get("run", PERSON), sender, may_move=True))
        self._publish(DRIVE, {"x": x, "z": z} | ({"key": key} if key else {}) | fields)

    def steer(self, seconds: float, key: str | None = None, **fields: Any) -> None:
        """Drive for so long."""
        self._gesture += 1
        self._steer(self._gesture, self.scheduler.now + seconds, key, fields)

    def _steer(self, gesture: int, until: float, key: str | None, fields: dict[str, Any]) -> None:
        if gesture == self._gesture and self.scheduler.now < until:
            if key is not None or self.key:  # a page without control sends nothing
                self.drive(key, **fields)
            self.scheduler.after(PERIOD_S, lambda: self._steer(gesture, until, key, fields))

    def steer_by_old_key(self, seconds: float) -> None:
        self.steer(seconds, self.old_keys[-1])

    def zero(self, *, final: bool = False) -> None:
        self._gesture += 1
        self._publish(DRIVE, {"x": 0, "z": 0} | ({"valid_ms": 0} if final else {}))

    # -- stopping

    def stop(self) -> None:
        """Publish an emergency stop, once; it is named after its time."""
        self._publish(ESTOP, {"stop": f"{self.scheduler.now:016.3f}".replace(".", "a"), "by": self.name})

    def reset(self) -> None:
        """End what this person has seen."""
        for message in Reset(self.robot, self.name).messages():
            self._connection.publish(message.topic, message.payload, qos=QoS.DELIVERED)

    # -- what is malformed or pretended

    def junk(self, kind: int) -> None:
        """Publish something malformed, or what looks like a script's and has no number."""
        x, z = self._commands.add(Command(PERSON, self.name, may_move=False))
        bodies: tuple[Any, ...] = (
            {"x": x, "z": z, "valid_ms": 0},
            {"x": x, "z": z, "valid_ms": -5},
            {"x": x, "z": z, "source": 7},
            {"x": x, "z": z, "source": "autonomy"},
            {"x": x, "z": z, "source": "autonomy", "run": "17"},
            {"x": "nan", "z": z},
            [x, z],
        )
        self._publish(DRIVE, bodies[kind % len(bodies)])

    # -- parts

    def _publish(self, channel: Any, body: Any) -> None:
        self._connection.publish(channel.topic(BASE), msgspec.json.encode(body), qos=QoS.DELIVERED)

    def _receive(self, message: Message) -> None:
        self.robot.receive(message)
        owner = message.topic.rpartition("/")[2]
        if message.payload and message.topic == CONTROL_STATE.topic(BASE, owner=owner):
            state = self.seen[owner] = codec.decode(CONTROL_STATE, message.payload)
            if state.id == self.id and state.key not in self.old_keys:
                self.old_keys.append(state.key)
