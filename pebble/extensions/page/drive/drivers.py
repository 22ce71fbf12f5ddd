"""The driven robots of one server: pages' requests, robots' answers, and what is published.

A *group* is one message with a drive command and the lights that a page sets during a gesture.
"""

from collections.abc import Callable
from functools import partial
from math import inf
from typing import NamedTuple

from pebble.contract import DRIVE, GROUP, Channel
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.estop import send
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import messages as m
from pebble.extensions.page.drive.driven_robot import Command, DrivenRobot, Tab
from pebble.extensions.page.drive.refusals import Refusals
from pebble.extensions.page.robots import Robots
from pebble.extensions.thin.packed import joined
from pebble.transports import Message
from pebble.transports.clock import since_boot as clock

MOST_WISHES = 16  # of one tab: robots of which it has control, or asks for it
_ALONE_S = 1.0  # after a group its lights are sent again, alone, unless newer ones are there


class _Lights(NamedTuple):
    """Lights that are sent in a group with the next drive command of a gesture. They may be lost or refused with it."""

    metric: str
    message: Message
    by: str
    grouped_at: float = inf  # when they were sent in a group; inf: they wait for a command


class Drivers:
    """The driven robots of one server. Methods publish their results at once."""

    def __init__(self, broker: Broker, robots: Robots) -> None:
        self._broker, self._robots = broker, robots
        self._driven: dict[str, DrivenRobot] = {}
        self._changed: set[str] = set()  # robots whose drivers must be shown to pages again
        self._lights: dict[str, _Lights] = {}  # by robot
        self._grouped: set[str] = set()  # robots that were sent a group since their last zero
        self.refusals = Refusals(broker, lambda ref: self.robot(ref).moved_by, robots.view)

    def robot(self, ref: str) -> DrivenRobot:
        """Return the driving of this robot, a new one if it was at rest."""
        robot = self._driven.get(ref)
        if robot is None:
            robot = self._driven[ref] = DrivenRobot(ref, partial(self._robots.view, ref), self._changed)
        return robot

    # -- of pages

    def take(
        self, tab: Tab, view: RobotView, granted: Callable[[], None], failed: Callable[[str], None], *, over: bool
    ) -> None:
        """Request control for a page; ``granted``, or ``failed`` with the reason, is called with the result."""
        now, robot = clock(), self.robot(view.base)
        wishes = sum(driven.wanted_by(tab) for driven in self._driven.values())
        if why := self.refusals.nameless(view):
            failed(why)
        elif wishes >= MOST_WISHES and not robot.wanted_by(tab):
            failed(f"This page has control of {MOST_WISHES} robots: release one")
        else:
            self._publish(robot.take(tab, now, granted, failed, over=over))
            self._publish_due(robot, now)

    def release(self, tab: Tab, ref: str) -> bool:
        """Release a page's control, or withdraw its request; return True if it had control."""
        now, robot = clock(), self.robot(ref)
        had_control = robot.tab is tab
        self._publish(robot.release(tab, now))
        self._publish_due(robot, now)
        return had_control

    def drives(self, ref: str) -> bool:
        """True if a page has control of that robot."""
        return ref in self._driven and self._driven[ref].tab is not None

    def restore(self, token: str, tab: Tab) -> None:
        """Give a page that has connected again the control that it had; no gesture continues.

        ``token`` is that of its old connection, ``tab`` the new one. The old one may still be open, although no more
        data arrives on it: then it is closed first.
        """
        now = clock()
        old_tabs = {robot.tab for robot in self._driven.values() if robot.tab is not None and robot.tab.token == token}
        for old in old_tabs:
            if old.clock.problem(now):  # its connection stalls, or is too slow
                self.closed(old)
        for robot in list(self._driven.values()):
            if robot.awaits(token, now) and (view := self._robots.view(robot.ref)) is not None:
                self.take(tab, view, lambda: None, lambda _why: None, over=False)  # no request, so it gets no answer

    def closed(self, tab: Tab, *, for_good: bool = False) -> None:
        """Note that a page's connection has ended; ``for_good``: its user may no longer drive."""
        now, zeros = clock(), list[Command]()
        wanted = [robot for robot in self._driven.values() if robot.wanted_by(tab)]
        for robot in wanted:
            zeros += robot.closed(tab, now, for_good=for_good)
        try:
            self._publish(zeros)
        finally:
            for robot in wanted:
                self._publish_due(robot, now)

    def closed_all(self) -> None:
        for tab in [robot.tab for robot in self._driven.values() if robot.tab is not None]:
            self.closed(tab)

    def drive(self, tab: Tab, op: m.DriveOp, blocked: str) -> tuple[bool, str]:
        """Publish the drive commands of a gesture, if it is allowed.

        Return whether wheels move now, and why the gesture was refused (empty: it was not).
        """
        now, robot = clock(), self.robot(op.ref)
        commands, refused = robot.drive(tab, op, now, blocked or self.refusals.of_driving(op.ref))
        accepted = self._publish(commands, tab.user)
        if refused:
            return False, refused
        if not accepted:
            self._publish(robot.stop(now))
            return False, "The server cannot reach the broker"
        return bool(commands) and commands[0].drive.moves, ""

    def accompany(self, tab: Tab, ref: str, channel: Channel, message: Message) -> bool:
        """Keep lights, to send them in a group with the next drive command; return False if they are not kept.

        They are kept while this page's gesture moves a robot whose ``groups`` list both. If not, the caller sends them.
        """
        groups = self._robots.capabilities(ref).get("groups")
        takes_group = isinstance(groups, list) and DRIVE.metric in groups and channel.metric in groups
        joins = takes_group and tab.moves is not None and tab.moves.ref == ref
        if joins:
            self._lights[ref] = _Lights(channel.metric, message, tab.user)
        else:
            self._lights.pop(ref, None)  # the caller sends newer ones
        return joins

    def stop(self, ref: str, by: str) -> None:
        """Publish a zero for any user, also without control."""
        if self._robots.view(ref) is not None:
            self._publish(self.robot(ref).stop(clock()), by)

    # -- of robots

    def updated(self, ref: str) -> None:
        """Note that a robot has published capabilities or a state of control."""
        self._publish(self.robot(ref).update(clock()))

    def renew_keys(self) -> None:
        """Choose new keys for robots whose motor owners give none, because the connection to the broker is new."""
        for robot in self._driven.values():
            robot.renew_key()

    # -- what is due

    def tick(self, now: float) -> None:
        """Publish what is due. Lights that were sent in a group are also sent alone: a group may be lost or refused."""
        for ref, robot in list(self._driven.items()):
            self._publish_due(robot, now)
            if robot.may_be_forgotten(now):
                del self._driven[ref]
        for ref, lights in list(self._lights.items()):
            if now - lights.grouped_at >= _ALONE_S:
                self._publish_lights(ref)

    # -- inside

    def _publish_due(self, robot: DrivenRobot, now: float) -> None:
        """Publish what is due for a robot; requests for control come after the zeros of the former driver."""
        commands, messages = robot.tick(now)
        self._publish(commands)
        send(self._broker.publish, messages)

    def _publish(self, commands: list[Command], by: str = "") -> bool:
        """Publish a person's drive commands; return False if one was not accepted."""
        accepted = True
        for command in commands:
            publish = self._publish_moving if command.drive.moves else self._publish_zero
            robot = self._robots.view(command.ref) or RobotView(command.ref)  # an unknown one gets the usual form
            accepted = publish(command, robot.encode(command.drive), by) and accepted
        if self._changed:
            self._robots.mark_drivers(set(self._changed))
            self._changed.clear()
        return accepted

    def _publish_moving(self, command: Command, payload: bytes, by: str) -> bool:
        """Publish a command that moves a robot, in a group with the robot's lights if some wait for it."""
        ref, lights = command.ref, self._lights.get(command.ref)
        topic = self._robots.topic(ref, DRIVE)
        if lights is not None and lights.grouped_at == inf:  # they wait for a command
            topic, payload = GROUP.topic(ref), joined({DRIVE.metric: payload, lights.metric: lights.message.payload})
            self._lights[ref] = lights._replace(grouped_at=clock())
            self._grouped.add(ref)
        return self._broker.publish(topic, payload, qos=command.qos, by=by)

    def _publish_zero(self, command: Command, payload: bytes, by: str) -> bool:
        """Publish a zero by itself, and then the robot's lights: they must not delay it."""
        ref, qos = command.ref, command.qos
        accepted = self._broker.publish(self._robots.topic(ref, DRIVE), payload, qos=qos, by=by)
        if ref in self._grouped:  # a group without lights replaces one that still waits for a slow connection
            self._grouped.remove(ref)
            self._broker.publish(GROUP.topic(ref), joined({DRIVE.metric: payload}), qos=qos, by=by)
        self._publish_lights(ref)
        return accepted

    def _publish_lights(self, ref: str) -> None:
        if (lights := self._lights.pop(ref, None)) is not None:
            message = lights.message
            self._broker.publish(message.topic, message.payload, qos=message.qos, by=lights.by)
