"""Sends the drive commands of the demo's operator, with the key of control to robots that keep control themselves."""

import math
import secrets
import time
from collections.abc import Callable, Iterable
from functools import partial

from msgspec.structs import replace

from pebble.client.control import ControlClient
from pebble.client.pace_of_link import WIDE, Pace
from pebble.client.robot_view import RobotView
from pebble.contract import DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.transports import Message, QoS

_CONTROL_S = 1.0  # until every robot has given it, on the smallest machine


class Steering:
    """``own_ids`` gets the ids under which it has control. Times are seconds of time.monotonic()."""

    def __init__(self, name: str, publish: Callable[[Iterable[Message]], None], own_ids: set[str]) -> None:
        self.commands: dict[str, tuple[Drive, float]] = {}  # by base topic: the last one sent, and when
        self._name, self._publish, self._own_ids = name, publish, own_ids
        self._controls: dict[str, ControlClient] = {}  # by base topic, of robots that keep control themselves
        self._key = secrets.token_hex(4)  # where a robot has given none

    def drive(self, robot: RobotView, drive: Drive, now: float) -> None:
        """Send a zero at once; what moves the robot at the pace that it asks for."""
        pace, (last, sent_at) = robot.pace, self.commands.get(robot.base, (Drive(), -math.inf))
        if drive.moves and last.moves and now - sent_at < pace.step_s:
            return
        self.commands[robot.base] = drive, now
        signed, qos = self._signed(robot, drive), QoS.DELIVERED
        if drive.moves:
            signed, qos = pace.dated(signed, now, self._key), pace.qos
        if robot.drive_topic is not None:
            self._publish([Message(robot.drive_topic, codec.encode(DRIVE, signed), qos)])

    def _signed(self, robot: RobotView, drive: Drive) -> Drive:
        """The command with the key of control, which it renews if it has it."""
        control = self._controls.get(robot.base)
        if control is None:
            return drive
        if control.asked_by:
            control.release()
        self._publish(control.tick(time.monotonic()))
        return replace(drive, key=control.key) if control.key else drive

    def take(self, robots: Iterable[RobotView], until: Callable[[Callable[[], bool], float], None]) -> None:
        """Have control of these, as a person would; ``until(condition, seconds)`` waits."""
        wait_s = _CONTROL_S
        for robot in robots:
            if robot.controlled:
                self._ask(robot)
            if robot.pace is not WIDE:
                wait_s = max(wait_s, robot.pace.answer_s)
        until(self._has_control, wait_s)
        for control in self._controls.values():
            if not control.held:  # a person was faster
                control.release()

    def _ask(self, robot: RobotView) -> None:
        control = self._controls.get(robot.base)
        if control is None or control.robot is not robot.control:
            control = self._controls[robot.base] = ControlClient(
                robot.control, by=self._name, device="demo", pace_of=partial(_pace_of, robot)
            )
            self._own_ids.add(control.id)
        if not control.wanted:
            control.ask(time.monotonic())

    def _has_control(self) -> bool:
        wanted = [one for one in self._controls.values() if one.wanted]
        for control in wanted:
            self._publish(control.tick(time.monotonic()))
        return all(one.held or not one.wanted for one in wanted)

    def release(self) -> None:
        """Leave control to people."""
        for control in self._controls.values():
            control.release()
            self._publish(control.tick(time.monotonic()))


def _pace_of(robot: RobotView) -> Pace:
    return robot.pace
