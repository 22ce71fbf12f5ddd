"""Sends the drive commands of the demo's operator, with the key of control to robots that keep control themselves."""

import time
from collections.abc import Callable, Iterable

from msgspec.structs import replace

from pebble.client.control import ControlClient
from pebble.client.robot_view import RobotView
from pebble.contract import DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.transports import Message, QoS

_CONTROL_S = 1.0  # until every robot has given it, on the smallest machine


class Steering:
    """The control of all robots; ``own_ids`` gets the ids under which the operator has it."""

    def __init__(self, name: str, publish: Callable[[Iterable[Message]], None], own_ids: set[str]) -> None:
        self.commands: dict[str, tuple[Drive, float]] = {}  # by base topic: the last one sent, and when
        self._name, self._publish, self._own_ids = name, publish, own_ids
        self._controls: dict[str, ControlClient] = {}  # by base topic, of robots that keep control themselves

    def drive(self, robot: RobotView, drive: Drive) -> None:
        """Send one command, and renew control if the operator has it; a person who asks for it gets it."""
        now = time.monotonic()
        self.commands[robot.base] = drive, now
        control = self._controls.get(robot.base)
        if control is not None:
            if control.asked_by:
                control.release()
            self._publish(control.tick(now))
            if control.key:
                drive = replace(drive, key=control.key)
        if robot.drive_topic is not None:
            self._publish([Message(robot.drive_topic, codec.encode(DRIVE, drive), QoS.DELIVERED)])

    def take(self, robots: Iterable[RobotView], until: Callable[[Callable[[], bool], float], None]) -> None:
        """Ask for control of these, as a person would; ``until(condition, seconds)`` waits."""
        for robot in robots:
            if robot.controlled:
                self._ask(robot)
        until(self._has_control, _CONTROL_S)
        for control in self._controls.values():
            if not control.held:  # a person was faster
                control.release()

    def _ask(self, robot: RobotView) -> None:
        control = self._controls.get(robot.base)
        if control is None:
            control = self._controls[robot.base] = ControlClient(robot.control, by=self._name, device="demo")
            self._own_ids.add(control.id)
        if not control.wanted:
            control.ask(time.monotonic())

    def _has_control(self) -> bool:
        wanted = [control for control in self._controls.values() if control.wanted]
        for control in wanted:
            self._publish(control.tick(time.monotonic()))
        return all(control.held or not control.wanted for control in wanted)

    def release(self) -> None:
        """Leave control to people."""
        for control in self._controls.values():
            control.release()
            self._publish(control.tick(time.monotonic()))
