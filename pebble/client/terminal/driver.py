"""Drives one robot with the keys of a terminal: what may be sent, why not, and what is shown. Pure.

The rules are those of the operator page: a reason against driving ends the gesture, and the keys must be released.
"""

import secrets
from collections.abc import Sequence

import msgspec

from pebble.client.control import IDLE_S, UNANSWERED, ControlClient
from pebble.client.drive_reasons import SLOW_S, SLOW_SPEED, Code, Situation, first_reason
from pebble.client.driver_lease import FILTER, LISTEN_S, DriverLease
from pebble.client.names import id_of
from pebble.client.pace_of_link import WIDE, Pace
from pebble.client.robot_view import RobotView
from pebble.client.terminal.key_decoder import SPACE
from pebble.client.terminal.key_gesture import AXES, KeyGesture
from pebble.client.terminal.stop_keys import StopKeys
from pebble.contract import (
    AUTONOMY_STATUS,
    CAPABILITIES,
    CHARGING_LEVEL,
    CONTROL_STATE,
    DRIVE,
    ESTOP_STATE,
    LINK,
    ONLINE,
    channel_of,
    codec,
)
from pebble.contract.payloads import Drive
from pebble.transports import Message

_WANTS_S = 1.0  # after a key that drives

TAKE, TAKE_OVER, LET, KEEP = "t", "o", "l", "k"  # keys

_RECEIVED = (ESTOP_STATE, CONTROL_STATE, CAPABILITIES, ONLINE, LINK, CHARGING_LEVEL, AUTONOMY_STATUS)
_WORDS = {
    Code.UNSEEN: "waiting for {name}",
    Code.STOPPING: "emergency stop",
    Code.RESET: "it was reset a moment ago",
    Code.UNKNOWN: "{name} has not published what it can do",
    Code.NO_DRIVE: "{name} does not drive",
    Code.LISTENING: "listening for other drivers",
}


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
        self.robot = RobotView(base)
        self.gesture, self.lease = gesture, lease
        self.control = ControlClient(
            self.robot.control, by=by.partition("@")[0], device=lease.device, pace_of=lambda: self._pace
        )
        self.stop = StopKeys(self.robot, by)
        self._take_over, self._heartbeat = take_over, heartbeat
        self._began = self._used_at = now
        self._wants_until = float("inf")  # until then control is taken as soon as it is free
        self._decided = ""  # the key of control, as far as the gesture knows of it
        self._reason = "connecting"
        self._connected = False
        self._key = ""  # where the robot has given none; another one with each connection
        self._out: list[Message] = []

    @property
    def filters(self) -> list[str]:
        return [*(channel.filter(self.robot.base) for channel in _RECEIVED), FILTER]

    @property
    def name(self) -> str:
        """How people name the robot here."""
        return id_of(self.robot.base)

    # -- what arrives

    def receive(self, message: Message, now: float, wall: float) -> None:
        held = self.lease.held
        self.lease.receive(message, now)
        if held and not self.lease.held:  # of a robot that does not keep control itself
            self._take_over = False  # a newer driver is asked for, not fought
            self._drive(self.gesture.interrupt(now, repeat=False), now)
        if message.topic.startswith(f"{self.robot.base}/"):
            channel = channel_of(message.topic[len(self.robot.base) + 1 :])
            self.robot.receive(channel, message, now, wall)
            if channel not in (CONTROL_STATE, LINK):
                self.robot.remember(message)
            self._check_control(now)
        self.stop.receive(message, now)

    def press(self, keys: Sequence[str], now: float) -> None:
        for key in keys:
            if self.stop.pressed(key, now):
                self._out += self.stop.stop(now)
                self._drive(self.gesture.stop(now), now)
            elif key == SPACE:
                self._drive(self.gesture.stop(now), now)
            elif self.robot.controlled:
                self._press_control(key, now)
        if not AXES.keys().isdisjoint(keys):
            self._wants_until = max(self._wants_until, now + _WANTS_S)
        self.gesture.press(keys, now)

    # -- what follows

    def tick(self, now: float, wall: float, *, problem: str = "", late_s: float = 0.0) -> list[Message]:
        """What to publish now; to be called every 50 ms.

        ``problem``: why there is no connection; ``late_s``: how long the oldest command has not been acknowledged.
        """
        if not problem and not self._connected:
            self.lease.reconnected()
            self._key = secrets.token_hex(4)
        self._connected = not problem
        situation = self._situation(now, problem, late_s)
        against = first_reason(situation)
        self._reason = self._words(against, situation, now)
        limit = SLOW_SPEED if (self.lease.round_trip_s or 0.0) >= SLOW_S else 1.0
        self._drive(self.gesture.update(against is None, now, limit=limit, step_s=self._pace.step_s), now)
        if self.robot.controlled:
            self._tick_control(now, int(1000 * wall), problem)
        elif self.gesture.active:
            if not self.lease.held:
                self._take_over = False
                self.lease.take(now, int(1000 * wall))
            self.lease.use(now)
        self._out += self.lease.tick(now, int(1000 * wall))
        self._out += self.stop.tick(now)
        out, self._out = self._out, []
        return out

    def refused(self, now: float) -> None:
        """What :meth:`tick` returned was not accepted by the transport."""
        self.gesture.interrupt(now, repeat=False)

    def leave(self, now: float, wall: float) -> list[Message]:
        """The terminal is gone, or the driver leaves: stop, and give the lease back. Then :meth:`tick` twice more."""
        self._drive(self.gesture.interrupt(now), now)
        self._wants_until, self._decided = now, ""  # the zero is repeated all the same
        self.control.release()
        self._out += self.control.tick(now)
        self.lease.release()
        self._out += self.lease.tick(now, int(1000 * wall))
        out, self._out = self._out, []
        return out

    def suspend(self, now: float) -> list[Message]:
        """This process is about to stand still. Then :meth:`tick` twice more."""
        self._drive(self.gesture.interrupt(now), now)
        out, self._out = self._out, []
        return out

    @property
    def unconfirmed(self) -> bool:
        """Whether an emergency stop from here is not confirmed."""
        return self.stop.unconfirmed

    # -- what is shown

    def status(self) -> str:
        """One line: what is sent, or why nothing is, and what is known of the robot. Parts of it come from others."""
        parts = [self.name, self._doing(), self.stop.text(), *self._others(), self._battery(), self._latency()]
        return " · ".join(part for part in parts if part)

    def _doing(self) -> str:
        if self.gesture.active:
            last = self.gesture.last
            y = f" y {last.y:+.2f}" if last.y else ""
            return f"driving x {last.x:+.2f} z {last.z:+.2f}{y}"
        if self._reason:
            return self._reason
        return "let go first" if self.gesture.must_release else "ready"

    def _others(self) -> list[str]:
        """Who else wants to drive, or does."""
        state, asks = self.robot.control.state, self.control.asked_by
        asked = f"{asks} asks for control: l lets {asks} drive, k keeps it" if asks else ""
        return [asked, "somebody else drives, too" if self.control.held and state is not None and state.others else ""]

    def _battery(self) -> str:
        return "" if self.robot.volts is None else f"{self.robot.volts:.1f} V"

    def _latency(self) -> str:
        if self._heartbeat and self.robot.slow_s is not None:
            return f"slow connection: commands take {self.robot.slow_s:.1f} s"
        if self.lease.round_trip_s is not None:
            return f"{1000 * self.lease.round_trip_s:.0f} ms"
        latency = self.robot.liveness.latency_s
        return "" if latency is None else f"heartbeat {1000 * latency:.0f} ms old"

    # -- inside

    @property
    def _pace(self) -> Pace:
        return self.robot.pace if self._heartbeat else WIDE  # within the robot there is no link

    def _situation(self, now: float, problem: str, late_s: float) -> Situation:
        """What speaks for and against driving now."""
        lease = self.lease
        situation = self.robot.situation(now)
        if self.robot.controlled:
            driven = self.robot.control.who != "" and not self.control.held
            listening = not self.control.held
        else:
            other = lease.other(now)
            driven = other is not None and not self._take_over
            listening = not lease.held and other is None and now - self._began < LISTEN_S
        return situation._replace(
            problem=problem,
            online=situation.online if self._heartbeat else True,
            stopping=self.stop.sending,
            driven=driven,
            listening=listening,
            late_s=max(late_s, lease.late_s(now), lease.round_trip_s or 0.0),
        )

    def _words(self, code: Code | None, situation: Situation, now: float) -> str:
        """The reason against driving as it is shown; empty if there is none."""
        robot, name = self.robot, self.name
        match code:
            case None:
                return ""
            case Code.BROKER:
                return f"no connection: {situation.problem}"
            case Code.SILENT if robot.liveness.reported_offline:
                return f"{name} is offline"
            case Code.SILENT:
                return f"{name} is silent for {robot.liveness.age_s(now):.0f} s"
            case Code.UNSEEN if robot.liveness.received_at is None:
                return f"no heartbeat of {name}: is it on?"
            case Code.STOPPED:
                by = robot.stopped_by
                why = f" ({by.why})" if by is not None and by.why else ""
                return f"stopped by {(by and by.by) or 'unknown'}{why}: pebble estop reset {name}"
            case Code.LEASE | Code.LISTENING if robot.controlled:
                return self._whose()
            case Code.LEASE:
                return f"{self.lease.other(now)} is driving (--take-over drives instead)"
            case Code.SCRIPT:
                return f"{(robot.autonomy and robot.autonomy.file) or 'a script'} is driving: stop it first"
            case Code.LATE:
                return f"commands are late ({1000 * situation.late_s:.0f} ms)"
        return _WORDS[code].format(name=name)

    def _whose(self) -> str:
        """Who has control, which is not here, and what can be done about it."""
        control, state = self.robot.control, self.robot.control.state
        if state is None:
            return f"{self.name} has not published who has control"
        if not control.who:
            if self.control.failed.endswith(UNANSWERED):  # brokers do not tell what they refuse
                return f"{self.control.failed}: may this account drive, and is the robot of its broker's level? t asks"
            return "taking control" if self.control.wanted else "nobody drives: t takes control"
        device = f"{state.device}, " if state.device else ""
        who = f"{control.who} ({device}name {'' if state.named else 'not '}checked) drives"
        return f"{who}: asked, o takes over" if self.control.wanted else f"{who}: t asks for control, o takes over"

    def _press_control(self, key: str, now: float) -> None:
        if key in (TAKE, TAKE_OVER):
            self.control.ask(now, over=key == TAKE_OVER)
        elif key == KEEP:
            self.control.keep()
        elif key == LET and self.control.asked_by:
            self._drive(self.gesture.interrupt(now, repeat=False), now)
            self.control.release()

    def _tick_control(self, now: float, epoch_ms: int, problem: str) -> None:
        """Have control while this terminal is used; the lease only measures the way through the broker."""
        if self.gesture.active or not self.control.held:
            self._used_at = now
        if self.control.held and now - self._used_at > IDLE_S:
            self.control.release()
        elif (
            now < self._wants_until
            and not (problem or self.control.wanted)
            and self.robot.control.state is not None
            and (self._take_over or not self.robot.control.who)
        ):
            self.control.ask(now, over=self._take_over)
            self._take_over, self._wants_until = False, now
        self._out += self.control.tick(now)
        self._check_control(now)
        if self.control.held and not self.lease.held:
            self.lease.take(now, epoch_ms, announce=False)
        elif self.lease.held and not self.control.held:
            self.lease.release()
        self.lease.use(now)

    def _check_control(self, now: float) -> None:
        """Whoever gets control, begins from rest; so does this terminal."""
        self.control.update(now)
        if self.control.decided != self._decided:
            self._decided, self._wants_until = self.control.decided, now
            self._drive(self.gesture.interrupt(now, repeat=False), now)

    def _drive(self, commands: Sequence[Drive], now: float) -> None:
        self._out += [self._message(command, now) for command in commands]

    def _message(self, command: Drive, now: float) -> Message:
        key, qos = self.control.key, WIDE.qos
        if key and command.valid_ms != 0:  # a final zero is no letting go
            command = msgspec.structs.replace(command, key=key)
        if command.moves:
            qos = self._pace.qos
            command = self._pace.dated(command, now, self._key)
        return Message(self.robot.estop.drive_topic, codec.encode(DRIVE, command), qos)
