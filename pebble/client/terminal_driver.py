"""Drives one robot with the keys of a terminal: what may be sent, why not, and what is shown. Pure.

The rules are those of the operator page: a reason against driving ends the gesture, and the keys must be released.
"""

from __future__ import annotations

from collections.abc import Sequence

from pebble.client.discovery import DiscoveredRobot, Discovery
from pebble.client.driver_lease import FILTER, LISTEN_S, DriverLease
from pebble.client.estop import Progress, StopSender, new_name
from pebble.client.key_decoder import ESCAPE, SPACE
from pebble.client.key_gesture import KeyGesture
from pebble.client.names import id_of
from pebble.contract import AUTONOMY_STATUS, CAPABILITIES, CHARGING_LEVEL, DRIVE, ESTOP_STATE, ONLINE, codec
from pebble.contract.payloads import Drive
from pebble.transports import Message, QoS

LATE_S = 0.6  # commands that take longer are not sent
SLOW_S, SLOW_SPEED = 0.3, 0.4  # from this round trip on, the speed is limited
SILENT_S = 1.5
TWICE_S = 0.6  # between two presses of Escape
RESET_S = 0.6  # a robot that was reset refuses its drivers until they have paused for 0.5 s

_TOPICS = 64  # of one robot that are remembered
_RECEIVED = (ESTOP_STATE, CAPABILITIES, ONLINE, CHARGING_LEVEL, AUTONOMY_STATUS)


class TerminalDriver:
    """One person at one terminal. Pass every message of ``filters`` to :meth:`receive`, keys to :meth:`press`.

    Publish what :meth:`tick` and :meth:`leave` return, at once. ``heartbeat``: whether the robot sends one on this
    connection. Times are seconds of one monotonic clock that goes on while the machine is suspended.
    """

    def __init__(
        self,
        base: str,
        gesture: KeyGesture,
        lease: DriverLease,
        *,
        by: str,
        now: float,
        take_over: bool = False,
        heartbeat: bool = True,
    ) -> None:
        self.base, self.name = base, id_of(base)
        self.gesture, self.lease = gesture, lease
        self.stopping: StopSender | None = None  # the newest emergency stop from here
        self._by, self._take_over, self._heartbeat = by, take_over, heartbeat
        self._discovery = Discovery()
        self._robot = self._discovery.robots[base] = DiscoveredRobot(base, self.name)
        self._began = now
        self._escape_at = self._latched_at = float("-inf")
        self._reason = "connecting"
        self._connected = False
        self._known: dict[str, Message] = {}  # the robot's newest messages, for an emergency stop that begins later
        self._out: list[Message] = []

    @property
    def filters(self) -> list[str]:
        """What to subscribe to."""
        return [*(channel.filter(self.base) for channel in _RECEIVED), FILTER]

    # -- what arrives

    def receive(self, message: Message, now: float, wall: float) -> None:
        """Update from a message."""
        held = self.lease.held
        self.lease.receive(message, now)
        if held and not self.lease.held:
            self._take_over = False  # a newer driver is asked for, not fought
            self._drive(self.gesture.interrupt(now, repeat=False))
        self._discovery.receive(message, now, wall)
        room = len(self._known) < _TOPICS or message.topic in (*self._known, CAPABILITIES.topic(self.base))
        if room and message.topic.startswith(f"{self.base}/"):
            self._known[message.topic] = message
        if self.stopping is not None:
            self.stopping.receive(message, now)

    def press(self, keys: Sequence[str], now: float) -> None:
        """The keys that were read."""
        for key in keys:
            twice = key == ESCAPE and now - self._escape_at <= TWICE_S
            if key == ESCAPE:
                self._escape_at = now
            if key == "!" or twice:
                self._estop(now)
            elif key == SPACE:
                self._drive(self.gesture.stop(now))
        self.gesture.press(keys, now)

    # -- what follows

    def tick(self, now: float, wall: float, *, problem: str = "", late_s: float = 0.0) -> list[Message]:
        """What to publish now; to be called every 50 ms.

        ``problem``: why there is no connection; ``late_s``: how long the oldest command has not been acknowledged.
        """
        if not problem and not self._connected:
            self.lease.reconnected()
        self._connected = not problem
        self._reason = self._why_not(now, problem, late_s)
        round_trip = self.lease.round_trip_s or 0.0
        self._drive(self.gesture.update(not self._reason, now, limit=SLOW_SPEED if round_trip >= SLOW_S else 1.0))
        if self.gesture.active:
            if not self.lease.held:
                self._take_over = False
                self.lease.take(now, int(1000 * wall))
            self.lease.use(now)
        self._out += self.lease.tick(now, int(1000 * wall))
        if self.stopping is not None:
            self._out += self.stopping.tick(now)
        out, self._out = self._out, []
        return out

    def refused(self, now: float) -> None:
        """What :meth:`tick` returned was not accepted by the transport."""
        self.gesture.interrupt(now, repeat=False)

    def leave(self, now: float, wall: float) -> list[Message]:
        """The terminal is gone, or the driver leaves: stop, and give the lease back. Then :meth:`tick` twice more."""
        self._drive(self.gesture.interrupt(now))
        self.lease.release()
        self._out += self.lease.tick(now, int(1000 * wall))
        out, self._out = self._out, []
        return out

    def suspend(self, now: float) -> list[Message]:
        """This process is about to stand still. Then :meth:`tick` twice more."""
        self._drive(self.gesture.interrupt(now))
        out, self._out = self._out, []
        return out

    @property
    def unconfirmed(self) -> bool:
        """Whether an emergency stop from here is not confirmed."""
        return self.stopping is not None and not self.stopping.confirmed

    # -- what is shown

    def status(self) -> str:
        """One line: what is sent, or why nothing is, and what is known of the robot. Parts of it come from others."""
        parts = [self.name, self._doing(), self._stop_text(), self._battery(), self._latency()]
        return " · ".join(part for part in parts if part)

    def _doing(self) -> str:
        if self.gesture.active:
            last = self.gesture.last
            y = f" y {last.y:+.2f}" if last.y else ""
            return f"driving x {last.x:+.2f} z {last.z:+.2f}{y}"
        if self._reason:
            return self._reason
        return "let go first" if self.gesture.must_release else "ready"

    def _stop_text(self) -> str:
        """How far the stop from here is, else nothing: the reason names another one."""
        if self.stopping is None or not self.stopping.robots:
            return ""
        stop = self.stopping.robots[self.base]
        if stop.progress is Progress.CONFIRMED:
            return "" if stop.estop.latched else "it was reset since"
        return f"EMERGENCY STOP {'sent, ' if stop.sending else ''}NOT CONFIRMED: {stop.why}"

    def _battery(self) -> str:
        return "" if self._robot.volts is None else f"{self._robot.volts:.1f} V"

    def _latency(self) -> str:
        if self.lease.round_trip_s is not None:
            return f"{1000 * self.lease.round_trip_s:.0f} ms"
        latency = self._robot.liveness.latency_s
        return "" if latency is None else f"heartbeat {1000 * latency:.0f} ms old"

    # -- inside

    def _why_not(self, now: float, problem: str, late_s: float) -> str:
        """The first reason against driving, in the order of the operator page."""
        if problem:
            return f"no connection: {problem}"
        return self._robot_reason(now) or self._driver_reason(now) or self._moment_reason(now, late_s)

    def _robot_reason(self, now: float) -> str:
        robot = self._robot
        silent = self._silence(now)
        if silent:
            return silent
        if robot.latched:
            state = robot.stopped_by
            by = "unknown" if state is None else state.by or "unknown"
            why = f" ({state.why})" if state is not None and state.why else ""
            self._latched_at = now
            return f"stopped by {by}{why}: pebble estop reset {self.name}"
        if self.stopping is not None and not self.stopping.finished:
            return "emergency stop"
        if now - self._latched_at < RESET_S:
            return "it was reset a moment ago"
        if not robot.estop.has_capabilities:
            return f"{self.name} has not published what it can do"
        drive = robot.capabilities.get("drive", {})
        if drive.get("available") is not True or drive.get("controls") is False:
            return f"{self.name} does not drive"
        return ""

    def _silence(self, now: float) -> str:
        liveness = self._robot.liveness
        age = liveness.age_s(now)
        if not self._heartbeat:
            return ""
        if age is None:
            return f"no heartbeat of {self.name}: is it on?"
        online = liveness.online(now)
        if online is None:
            return f"waiting for {self.name}"
        if online or (age < SILENT_S and not liveness.reported_offline):
            return ""
        return f"{self.name} is offline" if liveness.reported_offline else f"{self.name} is silent for {age:.0f} s"

    def _driver_reason(self, now: float) -> str:
        if self.lease.held:
            return ""
        other = self.lease.other(now)
        if other is not None:
            return "" if self._take_over else f"{other} is driving (--take-over drives instead)"
        if now - self._began < LISTEN_S:
            return "listening for other drivers"
        return ""

    def _moment_reason(self, now: float, late_s: float) -> str:
        script = self._robot.autonomy
        if script is not None and script.running and self._robot.capabilities["drive"].get("arbitrates") is not True:
            return f"{script.file or 'a script'} is driving: stop it first"
        late = max(late_s, self.lease.late_s(now), self.lease.round_trip_s or 0.0)
        return f"commands are late ({1000 * late:.0f} ms)" if late >= LATE_S else ""

    def _estop(self, now: float) -> None:
        if self.stopping is None or self.stopping.finished:
            self.stopping = StopSender(new_name(), by=self._by, why="", now=now, robots=[self.base])
            for message in self._known.values():
                self.stopping.receive(message, now)
            self._out += self.stopping.tick(now)
        self._drive(self.gesture.stop(now))

    def _drive(self, commands: Sequence[Drive]) -> None:
        self._out += map(self._message, commands)

    def _message(self, command: Drive) -> Message:
        return Message(self._robot.estop.drive_topic, codec.encode(DRIVE, command), QoS(DRIVE.default_qos))
