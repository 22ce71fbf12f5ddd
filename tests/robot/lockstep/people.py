"""Persons: they drive, let go, lose the connection, stop, reset, and start and end scripts. And other programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from pebble.contract import AUTONOMY_COMMAND, AUTONOMY_STATUS, CAPABILITIES, DRIVE, ESTOP, codec
from pebble.contract.payloads import AutonomyStatus
from pebble.extensions.operator.client.estop import StopSender
from pebble.extensions.operator.client.estop_states import Reset, RobotEstop
from pebble.transports import Message, QoS
from tests.robot.lockstep.commands import PERSON, Command, Commands
from tests.robot.lockstep.network import Connection, Network
from tests.robot.lockstep.processes import Process

BASE = "pebble/robots/goob"
PERIOD_S = 0.1  # of a person's commands
_ENDS = ("release", "lost", "halt")


class Person(Process):
    """A page or a program of a person, on the network of the robot: in virtual time, and not always by the contract."""

    def __init__(self, name: str, network: Network, commands: Commands) -> None:
        super().__init__(name, network.scheduler)
        self.alive = True
        self.robot = RobotEstop(BASE)
        self.status: AutonomyStatus | None = None
        self.starts = 0  # live ones that were published
        self._commands = commands
        self._gesture = 0
        self._sender: StopSender | None = None
        self._connection = Connection(self, network).open(0.0)
        self._connection.subscribe(f"{BASE}/outgoing/#", self._receive, direct=True)

    # -- driving

    def drive(self, valid_ms: int | None = None, *, retain: bool = False) -> None:
        """One command."""
        valid_s = 5.0 if valid_ms is None else valid_ms / 1000
        command = Command(PERSON, self.name, self.scheduler.now, valid_s, may_move=True)
        x, z = self._commands.add(command)
        self._publish(DRIVE.topic(BASE), _drive(x, z, valid_ms=valid_ms), retain=retain)

    def zero(self, *, final: bool) -> None:
        self._gesture += 1
        self._publish(DRIVE.topic(BASE), _drive(0, 0, valid_ms=0 if final else None))

    def steer(self, seconds: float, end: int, valid_ms: int | None) -> None:
        """Drive for so long, then let go, lose the connection, or halt."""
        self._gesture += 1
        gesture, until = self._gesture, self.scheduler.now + seconds

        def go_on() -> None:
            if gesture != self._gesture:
                return
            if self.scheduler.now < until:
                self.drive(valid_ms)
                self.scheduler.after(PERIOD_S, go_on)
            elif _ENDS[end % 3] != "lost":
                self.zero(final=_ENDS[end % 3] == "halt")

        self.drive(valid_ms)
        self.scheduler.after(PERIOD_S, go_on)

    # -- stopping

    def stop(self, name: str) -> None:
        """An emergency stop, sent until it is confirmed."""
        self._sender = StopSender(name, by=self.name, why="", now=self.scheduler.now, robots=[BASE])
        for message in self._connection._hub.retained.values():
            self._sender.receive(msgspec.structs.replace(message, retain=True), self.scheduler.now)
        self._send_stop(self._sender)

    def stop_namelessly(self) -> None:
        self._publish(ESTOP.topic(BASE), b"{}")

    def reset(self) -> None:
        """End what this person has seen."""
        for message in Reset(self.robot, self.name).messages():
            self._publish(message.topic, message.payload)

    def _send_stop(self, sender: StopSender) -> None:
        for message in sender.tick(self.scheduler.now):
            self._publish(message.topic, message.payload)
        if sender is self._sender and sender.due is not None:
            self.scheduler.at(max(sender.due, self.scheduler.now + 0.01), lambda: self._send_stop(sender))

    # -- scripts

    def start(self, file: str, *, retain: bool = False) -> None:
        self.starts += 1
        self._publish(AUTONOMY_COMMAND.topic(BASE), _json({"action": "start", "file": file}), retain=retain)

    def end_script(self) -> None:
        self._publish(AUTONOMY_COMMAND.topic(BASE), _json({"action": "stop"}))

    # -- what is malformed, retained or pretended

    def pretend(self, run: int | None) -> None:
        """A command that looks like a script's; it may move something only with a number."""
        command = Command(run or -1, self.name, self.scheduler.now, 5.0, may_move=run is not None)
        x, z = self._commands.add(command)
        fields = {"x": x, "z": z, "source": "autonomy"} | ({} if run is None else {"run": run})
        self._publish(DRIVE.topic(BASE), _json(fields))

    def junk(self, kind: int) -> None:
        """Something malformed."""
        x, z = self._commands.add(Command(PERSON, self.name, self.scheduler.now, 0.0, may_move=False))
        bodies: tuple[Any, ...] = (
            {"x": x, "z": z, "valid_ms": 0},
            {"x": x, "z": z, "valid_ms": -5},
            {"x": x, "z": z, "source": 7},
            {"x": x, "z": z, "source": "autonomy", "run": "17"},
            {"x": "nan", "z": z},
            [x, z],
        )
        self._publish(DRIVE.topic(BASE), _json(bodies[kind % len(bodies)]))
        self._publish(AUTONOMY_COMMAND.topic(BASE), _json((7, {"action": "dance"}, {"action": "start"})[kind % 3]))

    def retain_command(self, kind: int) -> None:
        """A broker has retained a command from earlier: only its copies arrive."""
        hub = self._connection._hub
        x, z = self._commands.add(Command(PERSON, self.name, self.scheduler.now, 0.0, may_move=False))
        topic, payload = (
            (DRIVE.topic(BASE), _drive(x, z)),
            (AUTONOMY_COMMAND.topic(BASE), _json({"action": "start", "file": "steady"})),
            (DRIVE.topic(BASE), _json({"x": x, "z": z, "source": "autonomy", "run": 1 << 20})),
        )[kind % 3]
        hub.retained[topic] = Message(topic, payload, QoS.DELIVERED, retain=True)
        hub.publishers[topic] = self._connection

    # -- parts

    def _publish(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        self._connection.publish(topic, payload, qos=QoS.DELIVERED, retain=retain)

    def _receive(self, message: Message) -> None:
        self.robot.receive(message)
        if message.topic == AUTONOMY_STATUS.topic(BASE):
            self.status = codec.decode(AUTONOMY_STATUS, message.payload)
        if self._sender is not None:
            self._sender.receive(message, self.scheduler.now)


def announce(person: Person) -> None:
    """What a launcher's announcer publishes: the robot has one motor owner, which can be stopped."""
    estop = {"available": True, "owners": ["serial"]}
    person._publish(CAPABILITIES.topic(BASE), _json({"t": 1, "value": {"estop": estop}}), retain=True)


def _drive(x: float, z: float, *, valid_ms: int | None = None) -> bytes:
    return _json({"x": x, "z": z} | ({} if valid_ms is None else {"valid_ms": valid_ms}))


_json: Callable[[Any], bytes] = msgspec.json.encode
