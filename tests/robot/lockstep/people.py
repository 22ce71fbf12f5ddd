"""Persons: they ask for control, drive, let go, stop, reset, and start and end scripts. And programs that pretend."""

from __future__ import annotations

from typing import Any

import msgspec

from pebble.contract import (
    AUTONOMY_COMMAND,
    AUTONOMY_STATUS,
    CAPABILITIES,
    CONTROL,
    CONTROL_STATE,
    CONTROL_TAKE,
    DRIVE,
    ESTOP,
    codec,
)
from pebble.contract.payloads import AutonomyStatus
from pebble.extensions.operator.client.estop import StopSender
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
    """A page or a program of a person, on the network of the robot: in virtual time, and not always by the contract."""

    def __init__(self, name: str, network: Network, commands: Commands) -> None:
        super().__init__(name, network.scheduler)
        self.alive = True
        self.id = (name.encode().hex() * 8)[:8]
        self.robot = RobotEstop(BASE)
        self.seen: dict[str, Any] = {}  # the newest state of control, by owner
        self.old_keys: list[str] = []  # under which it had control once
        self.status: AutonomyStatus | None = None
        self.let_go_at = self.took_at = -1e9
        self._commands = commands
        self._wants = self._gesture = 0
        self._sender: StopSender | None = None
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
        """As a page has it: the keys of all owners that show its id."""
        return " ".join(state.key for _, state in sorted(self.seen.items()) if state.id == self.id)

    def drive(self, key: str | None = None, **fields: Any) -> None:
        """One command; with ``key``, under that one."""
        key = self.key if key is None else key
        sender = SCRIPT if "run" in fields else self.name if key else STRANGER
        valid_s = fields.get("valid_ms", 5000) / 1000
        command = Command(fields.get("run", PERSON), sender, self.scheduler.now, valid_s, may_move=True)
        x, z = self._commands.add(command)
        self._publish(DRIVE, {"x": x, "z": z} | ({"key": key} if key else {}) | fields)

    def steer(self, seconds: float, key: str | None = None, *, end: str = "lost", **fields: Any) -> None:
        """Drive for so long, then release, halt, or lose the connection."""
        self._gesture += 1
        self._steer(self._gesture, self.scheduler.now + seconds, key, end, fields)

    def _steer(self, gesture: int, until: float, key: str | None, end: str, fields: dict[str, Any]) -> None:
        if gesture != self._gesture:
            return
        if self.scheduler.now < until:
            if key is not None or self.key:  # a page without control sends nothing
                self.drive(key, **fields)
            self.scheduler.after(PERIOD_S, lambda: self._steer(gesture, until, key, end, fields))
        elif end != "lost":
            self.zero(final=end == "halt")

    def steer_by_old_key(self, seconds: float) -> None:
        self.steer(seconds, self.old_keys[-1])

    def zero(self, *, final: bool = False) -> None:
        self._gesture += 1
        self._publish(DRIVE, {"x": 0, "z": 0} | ({"valid_ms": 0} if final else {}))

    # -- stopping

    def stop(self) -> None:
        """An emergency stop, sent once; it is named after its time."""
        self._publish(ESTOP, {"stop": f"{self.scheduler.now:016.3f}".replace(".", "a"), "by": self.name})

    def press(self, name: str) -> None:
        """An emergency stop, sent until it is confirmed."""
        self._sender = StopSender(name, by=self.name, why="", now=self.scheduler.now, robots=[BASE])
        for message in self._connection._hub.retained.values():
            self._sender.receive(msgspec.structs.replace(message, retain=True), self.scheduler.now)
        self._send_stop(self._sender)

    def stop_namelessly(self) -> None:
        self._publish(ESTOP, {})

    def reset(self) -> None:
        """End what this person has seen."""
        for message in Reset(self.robot, self.name).messages():
            self._connection.publish(message.topic, message.payload, qos=QoS.DELIVERED)

    def _send_stop(self, sender: StopSender) -> None:
        for message in sender.tick(self.scheduler.now):
            self._connection.publish(message.topic, message.payload, qos=QoS.DELIVERED)
        if sender is self._sender and sender.due is not None:
            self.scheduler.at(max(sender.due, self.scheduler.now + 0.01), lambda: self._send_stop(sender))

    # -- scripts

    def start(self, file: str) -> None:
        self._publish(AUTONOMY_COMMAND, {"action": "start", "file": file})

    def end_script(self) -> None:
        self._publish(AUTONOMY_COMMAND, {"action": "stop"})

    # -- what is malformed, retained or pretended

    def pretend(self, run: int | None) -> None:
        """A command that looks like a script's; it may move something only with a number."""
        command = Command(run or -1, self.name, self.scheduler.now, 5.0, may_move=run is not None)
        x, z = self._commands.add(command)
        self._publish(DRIVE, {"x": x, "z": z, "source": "autonomy"} | ({} if run is None else {"run": run}))

    def junk(self, kind: int) -> None:
        """Something malformed."""
        x, z = self._not_to_move()
        bodies: tuple[Any, ...] = (
            {"x": x, "z": z, "valid_ms": 0},
            {"x": x, "z": z, "valid_ms": -5},
            {"x": x, "z": z, "source": 7},
            {"x": x, "z": z, "source": "autonomy", "run": "17"},
            {"x": "nan", "z": z},
            [x, z],
        )
        self._publish(DRIVE, bodies[kind % len(bodies)])
        self._publish(AUTONOMY_COMMAND, (7, {"action": "dance"}, {"action": "start"})[kind % 3])

    def retain_command(self, kind: int) -> None:
        """A broker has retained a command from earlier: only its copies arrive."""
        hub = self._connection._hub
        x, z = self._not_to_move()
        bodies: tuple[tuple[Any, Any], ...] = (
            (DRIVE, {"x": x, "z": z}),
            (AUTONOMY_COMMAND, {"action": "start", "file": "steady"}),
            (DRIVE, {"x": x, "z": z, "source": "autonomy", "run": 1 << 20}),
        )
        channel, body = bodies[kind % 3]
        topic = channel.topic(BASE)
        hub.retained[topic] = Message(topic, msgspec.json.encode(body), QoS.DELIVERED, retain=True)
        hub.publishers[topic] = self._connection

    def _not_to_move(self) -> tuple[float, float]:
        return self._commands.add(Command(PERSON, self.name, self.scheduler.now, 0.0, may_move=False))

    # -- parts

    def announce(self) -> None:
        """Publish what a launcher's announcer does: the robot has one motor owner, which can be stopped."""
        estop = {"available": True, "owners": ["serial"]}
        self._publish(CAPABILITIES, {"t": 1, "value": {"estop": estop}}, retain=True)

    def _publish(self, channel: Any, body: Any, *, retain: bool = False) -> None:
        payload = msgspec.json.encode(body)
        self._connection.publish(channel.topic(BASE), payload, qos=QoS.DELIVERED, retain=retain)

    def _receive(self, message: Message) -> None:
        self.robot.receive(message)
        owner = message.topic.rpartition("/")[2]
        if message.topic == AUTONOMY_STATUS.topic(BASE):
            self.status = codec.decode(AUTONOMY_STATUS, message.payload)
        elif message.payload and message.topic == CONTROL_STATE.topic(BASE, owner=owner):
            state = self.seen[owner] = codec.decode(CONTROL_STATE, message.payload)
            if state.id == self.id and state.key not in self.old_keys:
                self.old_keys.append(state.key)
        if self._sender is not None:
            self._sender.receive(message, self.scheduler.now)
