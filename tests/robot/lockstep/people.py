"""Persons: they drive, let go, lose the connection, stop, reset, and start and end scripts. And other programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from pebble.contract import AUTONOMY_COMMAND, AUTONOMY_STATUS, CAPABILITIES, DRIVE, codec
from pebble.contract.payloads import AutonomyStatus
from pebble.extensions.operator.client.estop import StopSender
from pebble.transports import Message, QoS
from tests.robot.lockstep.commands import PERSON, Command, Commands
from tests.robot.lockstep.drivers import BASE, PERIOD_S, Driver
from tests.robot.lockstep.network import Network

_ENDS = ("release", "lost", "halt")


class Person(Driver):
    """A person without control, who also stops, starts scripts, and does not always keep to the contract."""

    def __init__(self, name: str, network: Network, commands: Commands) -> None:
        super().__init__(name, network, commands)
        self.status: AutonomyStatus | None = None
        self._sender: StopSender | None = None

    # -- driving

    def command(self, valid_ms: int | None = None) -> None:
        """One command without a key."""
        self.drive("", **({} if valid_ms is None else {"valid_ms": valid_ms}))

    def let_go_of_the_stick(self, *, final: bool) -> None:
        self._gesture += 1
        self.zero(final=final)

    def steer_to(self, seconds: float, end: int, valid_ms: int | None) -> None:
        """Drive for so long, then let go, lose the connection, or halt."""
        self._gesture += 1
        gesture, until = self._gesture, self.scheduler.now + seconds

        def go_on() -> None:
            if gesture != self._gesture:
                return
            if self.scheduler.now < until:
                self.command(valid_ms)
                self.scheduler.after(PERIOD_S, go_on)
            elif _ENDS[end % 3] != "lost":
                self.let_go_of_the_stick(final=_ENDS[end % 3] == "halt")

        self.command(valid_ms)
        self.scheduler.after(PERIOD_S, go_on)

    # -- stopping

    def press(self, name: str) -> None:
        """An emergency stop, sent until it is confirmed."""
        self._sender = StopSender(name, by=self.name, why="", now=self.scheduler.now, robots=[BASE])
        for message in self._connection._hub.retained.values():
            self._sender.receive(msgspec.structs.replace(message, retain=True), self.scheduler.now)
        self._send_stop(self._sender)

    def _send_stop(self, sender: StopSender) -> None:
        for message in sender.tick(self.scheduler.now):
            self.publish_raw(message.topic, message.payload)
        if sender is self._sender and sender.due is not None:
            self.scheduler.at(max(sender.due, self.scheduler.now + 0.01), lambda: self._send_stop(sender))

    # -- scripts

    def start(self, file: str) -> None:
        self._publish(AUTONOMY_COMMAND.topic(BASE), {"action": "start", "file": file})

    def end_script(self) -> None:
        self._publish(AUTONOMY_COMMAND.topic(BASE), {"action": "stop"})

    # -- what is malformed, retained or pretended

    def pretend(self, run: int | None) -> None:
        """A command that looks like a script's; it may move something only with a number."""
        command = Command(run or -1, self.name, self.scheduler.now, 5.0, may_move=run is not None)
        x, z = self._commands.add(command)
        fields = {"x": x, "z": z, "source": "autonomy"} | ({} if run is None else {"run": run})
        self._publish(DRIVE.topic(BASE), fields)

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
        self.publish_raw(DRIVE.topic(BASE), _json(bodies[kind % len(bodies)]))
        self.publish_raw(AUTONOMY_COMMAND.topic(BASE), _json((7, {"action": "dance"}, {"action": "start"})[kind % 3]))

    def retain_command(self, kind: int) -> None:
        """A broker has retained a command from earlier: only its copies arrive."""
        hub = self._connection._hub
        x, z = self._commands.add(Command(PERSON, self.name, self.scheduler.now, 0.0, may_move=False))
        topic, payload = (
            (DRIVE.topic(BASE), _json({"x": x, "z": z})),
            (AUTONOMY_COMMAND.topic(BASE), _json({"action": "start", "file": "steady"})),
            (DRIVE.topic(BASE), _json({"x": x, "z": z, "source": "autonomy", "run": 1 << 20})),
        )[kind % 3]
        hub.retained[topic] = Message(topic, payload, QoS.DELIVERED, retain=True)
        hub.publishers[topic] = self._connection

    # -- parts

    def _receive(self, message: Message) -> None:
        super()._receive(message)
        if message.topic == AUTONOMY_STATUS.topic(BASE):
            self.status = codec.decode(AUTONOMY_STATUS, message.payload)
        if self._sender is not None:
            self._sender.receive(message, self.scheduler.now)


def announce(person: Person) -> None:
    """What a launcher's announcer publishes: the robot has one motor owner, which can be stopped."""
    estop = {"available": True, "owners": ["serial"]}
    person.publish_raw(CAPABILITIES.topic(BASE), _json({"t": 1, "value": {"estop": estop}}), retain=True)


_json: Callable[[Any], bytes] = msgspec.json.encode
