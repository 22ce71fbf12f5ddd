"""The motor owner of a base with ROS 1: sends the commands that the motor guard admits, and publishes its reports."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from pebble.contract import Channel
from pebble.contract.payloads import Drive
from pebble.errors import DeviceError
from pebble.motors.motor_owner import MotorOwner
from pebble.motors.state_file import StateFile
from pebble.runtime.parent import Reported
from pebble.runtime.service import Service, every
from pebble.services.ros1_bridge.cmd_vel import SILENT_S, CmdVel
from pebble.services.ros1_bridge.config import NONE, Ros1
from pebble.services.ros1_bridge.node import Node
from pebble.services.ros1_bridge.telemetry import Telemetry

_CHECK_S = 0.5


class Ros1Reader(Service):
    """A service that publishes the base's reports, and sends nothing to it."""

    name = "ros1_reader"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.node = self._make_node()
        self.telemetry = Telemetry(self.node, self.section, self._publish_soon, self.counters, self.hear)

    @cached_property
    def section(self) -> Ros1:
        """The section of the config; to find it takes longer than to send a command."""
        return self.config.section(Ros1)

    def _make_node(self) -> Node:
        host = self.section.host()
        try:
            return Node(self.section.ros.node_name, self.section.master(), host, self.on_evicted)
        except OSError as error:
            raise DeviceError(f"services.ros1_bridge.ros.host, or ROS_IP: {host}: {error.strerror or error}") from error

    def start(self) -> None:
        super().start()
        self.node.start()
        self.on_stop(self.node.close)

    @every(_CHECK_S)
    def check_threads(self) -> None:
        """Raise DeviceError, which restarts this process, if one of its threads has ended."""
        if not self.node.alive:
            raise DeviceError("a thread of the ROS node has ended")

    def hear(self) -> None:
        """Note that the base has sent odometry; called on the node's thread of sockets."""

    def on_evicted(self, _why: str) -> None:
        """React to another node of the same name; called on any thread."""

    def dropped(self) -> dict[str, int]:
        return {**super().dropped(), **self.node.dropped()}

    def _publish_soon(self, channel: Channel, payload: dict[str, Any]) -> None:
        def publish() -> None:
            self.publish(channel, payload)

        self.post(publish, newest_of=channel.metric)


class Ros1Bridge(Ros1Reader, MotorOwner):
    """A service that also drives the base. A stop locks the base's multiplexer, so that no ROS program moves it."""

    name = "ros1_bridge"
    owner = "ros1"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        ros = self.section.ros
        self._lock_file = StateFile(self.config.state_file(f"lock-{self.owner}"))  # whether it has locked the base
        self._reported = Reported(self.notifier.mcu)
        self._shown: object = None  # the report of the base that was logged last
        self.cmd_vel = CmdVel(
            self.node,
            ros.cmd_vel_topic,
            ros.cmd_vel_publish_interval_seconds,
            None if ros.estop_topic == NONE else ros.estop_topic,
            None if ros.cancel_topic == NONE else ros.cancel_topic,
            owed=self._lock_file.load() not in (None, False),  # see CmdVel; an unreadable file counts as a lock
            save=self._lock_file.save,
        )

    @property
    def drive_timeout_s(self) -> float:
        return self.section.safety.drive_timeout_seconds

    def start(self) -> None:
        """Start in the saved state: a stopped base is locked before it can receive a command."""
        self.on_stop(self._lock_file.close)
        MotorOwner.start(self)  # not that of Ros1Reader, which would start the node at once
        self.cmd_vel.latch(self.latched)
        self.node.start()
        self.on_stop(self.node.close)
        self.cmd_vel.open()
        self.on_stop(self.cmd_vel.close)

    def move(self, drive: Drive, valid_s: float) -> None:
        if self.section.drive.cancels_navigation and not drive.signed and self.telemetry.navigates:
            self.cmd_vel.cancel_navigation()
        motion = self.section.motion
        linear, angular = drive.z * motion.max_linear_speed_mps, -drive.x * motion.max_angular_speed_radps
        self.cmd_vel.drive(linear + 0.0, angular + 0.0, valid_s)  # not -0.0

    def halt(self) -> None:
        self.cmd_vel.halt()

    def judge(self) -> None:
        super().judge()
        self.cmd_vel.latch(self.latched)

    def hear(self) -> None:
        self.cmd_vel.hear()

    def on_evicted(self, _why: str) -> None:
        self.cmd_vel.halt()

    @every(_CHECK_S)
    def report_base(self) -> None:
        """Tell the launcher whether the ROS base can be driven. Raises DeviceError if nothing drives it any more."""
        if not self.cmd_vel.alive:
            raise DeviceError("the thread that sends commands has ended")
        self.cmd_vel.settle()
        report = self.assess()
        self._reported.report(*report)
        if report != self._shown:
            self._shown = report
            state, _, why = report
            verdict = "ready" if state == "ready" else "cannot be driven"
            self.log.info("the base: %s", f"{verdict}, {why}" if why else verdict)

    def assess(self) -> tuple[str, int | None, str]:
        """Return the fields of :class:`notes.Mcu`: state, age of the last report (None: there was none), and reason.

        The age is not measured: 0 stands for a base that sends odometry and does not hang.
        """
        node, topic = self.node, self.section.ros.cmd_vel_topic
        if not self.cmd_vel.bases:
            return "absent", None, node.problem or f"nobody subscribes to {topic}"
        if self.cmd_vel.hangs:
            return "absent", None, f"its base has sent no odometry for {SILENT_S:g} s"
        if others := node.others.get("/" + topic.strip("/")):
            text = f"others publish {topic} as well: {', '.join(others)}"
            self.log_limited.warning("others", "%s", text)
            return "ready", 0 if self.cmd_vel.heard else None, text
        if not self.cmd_vel.heard:
            return "ready", None, "its base has sent no odometry yet"
        return "ready", 0, ""
