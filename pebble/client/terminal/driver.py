"""Drives one robot with the keys of a terminal: what is sent, and what is shown. Pure.

A terminal repeats a key that is held and does not report its release: a key counts as held for HELD_S after its last
repetition. A reason against driving ends the drive, and all keys must be released before the next one.
"""

import secrets
from collections.abc import Sequence

import msgspec

from pebble import contract as c
from pebble.client.control import IDLE_S, ControlClient
from pebble.client.drive_reasons import Code, first_reason
from pebble.client.estop import StopSender, new_name
from pebble.client.names import id_of
from pebble.client.pace_of_link import WIDE, Pace
from pebble.client.robot_view import RobotView
from pebble.client.terminal.key_decoder import DOWN, ESCAPE, LEFT, RIGHT, SPACE, UP
from pebble.contract import channel_of, codec
from pebble.contract.payloads import Drive
from pebble.transports import Message, QoS

HELD_S, PERIOD_S = 0.4, 0.05  # a key after its last repetition; between two commands
_STALL_S = 0.25  # a process that stood still for longer does not go on as if nothing had happened
_BURST = 8  # as many keys at once were held back on the way, and are old
_TWICE_S = 0.6  # between two presses of Escape
_ZEROS = 3  # sent where a drive ends
_WANTS_S = 1.0  # control, after a key that drives
_ZERO, _FINAL_ZERO = Drive(), Drive(valid_ms=0)  # after the second one an interrupted script does not go on
_AXES = {
    "w": ("z", 1), UP: ("z", 1), "s": ("z", -1), DOWN: ("z", -1),
    "d": ("x", 1), RIGHT: ("x", 1), "a": ("x", -1), LEFT: ("x", -1),
    "q": ("y", 1), "e": ("y", -1),
}  # fmt: skip
_WORDS = {
    Code.SILENT: "{name} is silent or offline",
    Code.UNSEEN: "no heartbeat of {name}: is it on?",
    Code.STOPPED: "stopped by {by}: pebble estop reset {name}",
    Code.STOPPING: "emergency stop",
    Code.RESET: "it was reset a moment ago",
    Code.UNKNOWN: "{name} has not published what it can do",
    Code.NO_DRIVE: "{name} does not drive",
    Code.LEASE: "{who} drives: t asks for control, o takes it over",
    Code.LISTENING: "nobody drives: t takes control",
    Code.SCRIPT: "a script is driving: stop it first",
    Code.LATE: "commands are late",
}


class TerminalDriver:
    """One person at one terminal. Pass messages to :meth:`receive`, keys to :meth:`press`; publish what is returned.

    ``heartbeat``: whether the robot sends one on this connection. Times are seconds of one monotonic clock that goes
    on while the machine is suspended.
    """

    def __init__(
        self, base: str, *, by: str, device: str, speed: float, turn: float, take_over: bool, heartbeat: bool
    ) -> None:
        self.robot, self.name = RobotView(base), id_of(base)
        self.stop: StopSender | None = None
        self._control = ControlClient(self.robot.control, by=by.partition("@")[0], device=device, pace_of=self._pace)
        self._by, self._speed, self._turn, self._heartbeat = by, speed, turn, heartbeat
        self._id = secrets.token_hex(4)
        self._wants_until, self._take_over = float("inf"), take_over  # control as soon as it is free, or at once
        self._held: dict[str, tuple[int, float]] = {}  # by axis: the direction, and when its key last arrived
        self._driving, self._must_let_go = False, False
        self._last, self._zeros, self._decided = _ZERO, 0, ""
        self._reason, self._note = "connecting", ""
        self._key_at = self._sent_at = self._ticked_at = self._escape_at = float("-inf")
        self._used_at = 0.0

    @property
    def filters(self) -> list[str]:
        channels = (c.ESTOP_STATE, c.CONTROL_STATE, c.CAPABILITIES, c.ONLINE, c.LINK, c.CHARGING_LEVEL)
        return [channel.filter(self.robot.base) for channel in (*channels, c.AUTONOMY_STATUS)]

    def receive(self, message: Message, now: float, wall: float) -> None:
        channel = channel_of(message.topic.removeprefix(f"{self.robot.base}/"))
        self.robot.receive(channel, message, now, wall)
        if channel not in (c.CONTROL_STATE, c.LINK):
            self.robot.remember(message)
        if self.stop is not None:
            self.stop.receive(message, now)

    def press(self, keys: Sequence[str], now: float) -> None:
        """Take the keys that were read; the newest one of an axis counts."""
        for key in keys:
            if key == "!" or (key == ESCAPE and now - self._escape_at <= _TWICE_S):
                self._begin_stop(now)
            elif key == SPACE:
                self._end(_FINAL_ZERO, now)
            elif key in ("t", "o"):
                self._control.ask(now, over=key == "o")
            elif key == "l" and self._control.asked_by:
                self._end(_FINAL_ZERO, now)
                self._control.release()
            elif key == "k":
                self._control.keep()
            elif key in _AXES:
                axis, direction = _AXES[key]
                self._held[axis], self._key_at = (direction, now), now
                self._wants_until = max(self._wants_until, now + _WANTS_S)
            elif not key.isascii():
                self._note = f"this keyboard types {key}: W A S D need a Latin layout; the arrows drive, too"
            self._escape_at = now if key == ESCAPE else self._escape_at
        if len(keys) >= _BURST:
            self._end(_FINAL_ZERO, now)

    def tick(self, now: float, *, problem: str = "", late_s: float = 0.0) -> list[Message]:
        """Return what to publish now; to be called every PERIOD_S. ``problem``: why there is no connection."""
        out = [] if problem else self._tick_control(now)
        out += [] if self.stop is None else self.stop.tick(now)
        self._reason = f"no connection: {problem}" if problem else self._why_not(now, late_s)
        stalled, self._ticked_at = now - self._ticked_at > _STALL_S, now
        if self._must_let_go and now - self._key_at >= HELD_S:
            self._must_let_go = False
            self._held.clear()
        wanted = self._wanted(now)
        if stalled or (self._driving and self._reason):
            self._end(_FINAL_ZERO, now)
        elif wanted.moves and not self._must_let_go:
            self._must_let_go = self._reason != ""
            step_s = max(self._pace().step_s, 0.8 * PERIOD_S)
            if not self._reason and (not self._driving or now - self._sent_at >= step_s):
                self._driving, self._zeros, self._used_at, self._last = True, 0, now, wanted
                return [*out, self._message(wanted, now)]
        elif self._driving and not wanted.moves:
            self._driving, self._last, self._zeros = False, _ZERO, _ZEROS
        if self._zeros:
            self._zeros -= 1
            out.append(self._message(self._last, now))
        return out

    def halt(self, now: float, *, leave: bool) -> list[Message]:
        """Stop, because the terminal or the person goes, or this process stands still; then :meth:`tick` twice more."""
        self._end(_FINAL_ZERO, now)
        if leave:
            self._wants_until = now
            self._control.release()
        return self.tick(now)

    @property
    def unconfirmed(self) -> bool:
        """True if an emergency stop from here is not confirmed."""
        return self.stop is not None and not self.stop.confirmed

    def status(self) -> str:
        """Return one line: what is sent, or why nothing is, and what is known. Parts of it come from others."""
        asks, robot = self._control.asked_by, self.robot
        doing = f"driving x {self._last.x:+.2f} z {self._last.z:+.2f}" if self._driving else self._reason
        stop = self.stop.robots[robot.base] if self.stop is not None and self.unconfirmed else None
        parts = [
            self.name,
            doing or ("let go first" if self._must_let_go else "ready"),
            "" if stop is None else f"EMERGENCY STOP NOT CONFIRMED: {stop.why}",
            f"{asks} asks for control: l lets {asks} drive, k keeps it" if asks else "",
            self._control.failed if not self._control.held else "",
            "" if robot.volts is None else f"{robot.volts:.1f} V",
            "" if not robot.slow_s else f"slow connection: commands take {robot.slow_s:.1f} s",
            self._note,
        ]
        return " · ".join(filter(None, parts))

    # -- inside

    def _pace(self) -> Pace:
        return self.robot.pace if self._heartbeat else WIDE  # within the robot there is no link

    def _tick_control(self, now: float) -> list[Message]:
        """Ask for control where a key was pressed, and give it back after a minute without one."""
        control = self._control
        if self.robot.controlled:
            if control.held and now - self._used_at > IDLE_S:
                control.release()
            elif (
                now < self._wants_until
                and not control.wanted
                and self.robot.control.state is not None
                and (self._take_over or not self.robot.control.who)
            ):
                control.ask(now, over=self._take_over)
                self._used_at, self._take_over, self._wants_until = now, False, now
        out = control.tick(now)
        if control.decided != self._decided:  # whoever gets control begins from rest; so does this terminal
            self._decided, self._used_at = control.decided, now
            if self._driving:
                self._end(_FINAL_ZERO, now)
                self._zeros = 1  # another one may drive by now
        return out

    def _why_not(self, now: float, late_s: float) -> str:
        """Return the reason against driving; empty if there is none."""
        who, stopped = self.robot.control.who, self.robot.stopped_by
        is_sending = self.stop is not None and not self.stop.finished
        situation = self.robot.situation(now)._replace(stopping=is_sending, late_s=late_s)
        if not self._heartbeat:
            situation = situation._replace(online=True)
        if self.robot.controlled and not self._control.held:
            situation = situation._replace(driven=who != "", listening=True)
        code, state = first_reason(situation), self.robot.control.state
        if state is not None and who:
            who = f"{who} ({state.device}{', ' * bool(state.device)}name {'' if state.named else 'not '}checked)"
        return "" if code is None else _WORDS[code].format(name=self.name, who=who, by=(stopped and stopped.by) or "?")

    def _wanted(self, now: float) -> Drive:
        side, ahead, up = (direction if now - at < HELD_S else 0 for direction, at in map(self._held_at, "xzy"))
        turn, speed = side * self._turn, ahead * self._speed
        most = max(1.0, abs(speed + turn), abs(speed - turn))  # no wheel is faster than 1
        x, z, y = (round(axis, 3) + 0.0 for axis in (turn / most, speed / most, up * self._speed))
        return Drive(x=x, z=z, y=y, valid_ms=WIDE.valid_ms)

    def _held_at(self, axis: str) -> tuple[int, float]:
        return self._held.get(axis, (0, float("-inf")))

    def _end(self, zero: Drive, now: float) -> None:
        """End the drive; the pause before the next one is one in which keys were read."""
        self._driving, self._last, self._zeros = False, zero, _ZEROS
        self._must_let_go, self._key_at = True, now

    def _begin_stop(self, now: float) -> None:
        self._end(_FINAL_ZERO, now)
        if self.stop is None or self.stop.finished:
            self.stop = StopSender(new_name(), by=self._by, why="", now=now, robots=[self.robot.base])
            for message in self.robot.remembered.values():
                self.stop.receive(message, now)

    def _message(self, command: Drive, now: float) -> Message:
        self._sent_at, qos = now, WIDE.qos
        if self._control.key and command.valid_ms != 0:  # a final zero is no letting go
            command = msgspec.structs.replace(command, key=self._control.key)
        if command.moves:
            qos, command = self._pace().qos, self._pace().dated(command, now, self._id)
        return Message(self.robot.estop.drive_topic, codec.encode(c.DRIVE, command), QoS(qos))
