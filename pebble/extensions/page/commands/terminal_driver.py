"""A driver of one robot by the keys of a terminal: commands to send, and the status line. Pure.

It follows the rules of a page, `DrivenRobot`: a held key is a gesture. A terminal repeats a held key and does not
report its release: it counts as held for HELD_S after the last repetition.
"""

from collections.abc import Sequence

from pebble import contract as c
from pebble.contract import channel_of
from pebble.extensions.operator.client.assumed import AXES, HEARD_S, PARKED
from pebble.extensions.operator.client.drive_reasons import first_reason, words
from pebble.extensions.operator.client.driveable import doubt_of, is_cut_off
from pebble.extensions.operator.client.estop import StopSender, new_name
from pebble.extensions.operator.client.names import id_of
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.operator.client.terminal.key_decoder import DOWN, ESCAPE, LEFT, RIGHT, SPACE, UP
from pebble.extensions.page.drive.driven_robot import SILENCE_S, Command, DrivenRobot, State, Tab
from pebble.extensions.page.messages import DriveOp
from pebble.transports import Message

HELD_S = 0.4  # so long a key counts as held after its last repetition
PERIOD_S = 0.05  # between two commands
_BURST = 8  # so many keys at once were held back on the way, and are old
_TWICE_S = 0.6  # at most, between two presses of Escape that are a stop
_AXES = {
    "w": ("z", 1), UP: ("z", 1), "s": ("z", -1), DOWN: ("z", -1),
    "d": ("x", 1), RIGHT: ("x", 1), "a": ("x", -1), LEFT: ("x", -1),
    "q": ("y", 1), "e": ("y", -1),
}  # fmt: skip


class TerminalDriver:
    """A person at a terminal. Pass messages to :meth:`receive`, keys to :meth:`press`; publish what is returned.

    ``heartbeat``: whether the robot sends one on this connection. ``assume``: a robot without capabilities counts as
    one that drives. Times are seconds of a monotonic clock that also counts while the machine is suspended.
    """

    def __init__(
        self, base: str, *, by: str, device: str, speed: float, turn: float, heartbeat: bool, assume: bool = False
    ) -> None:
        self.robot, self.name = RobotView(base), id_of(base)
        self.stop: StopSender | None = None
        self._driven = DrivenRobot(base, lambda: self.robot, set())  # the set is for pages: none shows this driver
        self._tab = Tab("", by.partition("@")[0], device)
        self._by, self._speed, self._turn, self._heartbeat = by, speed, turn, heartbeat
        self._assumes, self._heard_at = assume, float("inf")  # since when the board is online; inf: it is not
        self._willing = True  # to have control as soon as it is free
        self._held: dict[str, tuple[int, float]] = {}  # by axis: the direction, and when its key last arrived
        self._gesture = 0  # the number of the newest one
        self._pressed = False  # a key is held: of this gesture, or of an ended one, which moves nothing any more
        self._reason = ""  # why the robot cannot be driven now
        self._note = ""  # about the keyboard, for the person
        self._key_at = self._ticked_at = self._escape_at = float("-inf")
        self._out: list[Command] = []  # to be sent with the next tick
        self._asked = ""  # the holder of control who was asked for it last
        self._failures: list[str] = []  # why the newest request for control has failed

    @property
    def filters(self) -> list[str]:
        """Return filters of the topics that :meth:`receive` needs."""
        channels = [c.ESTOP_STATE, c.CONTROL_STATE, c.CAPABILITIES, c.ONLINE, c.STATUS]
        channels += [c.CHARGING_LEVEL, c.AUTONOMY_STATUS]
        if self._heartbeat:  # as heartbeats, the state of the link exists only outside of the robot
            channels.append(c.LINK)
        if self._assumes:
            channels.append(c.DRIVE)
        return [channel.filter(self.robot.base) for channel in channels]

    def receive(self, message: Message, now: float, wall: float) -> None:
        self.robot.receive(channel_of(message.topic.removeprefix(f"{self.robot.base}/")), message, now, wall)
        if self.stop is not None:
            self.stop.receive(message, now)

    def press(self, keys: Sequence[str], now: float) -> None:
        """Handle the keys that were read. Of keys for one axis the newest counts.

        ``!`` or Escape twice is an emergency stop. Space stops the robot, and ``l`` also releases control. ``t`` takes
        control, or asks its holder for it; ``o`` takes it over without asking.
        """
        for key in keys:
            if key == "!" or (key == ESCAPE and now - self._escape_at <= _TWICE_S):
                self._begin_stop(now)
            elif key in (SPACE, "l"):
                self.end(now, leave=key == "l")
                self._out += self._driven.stop(now)  # a zero, also if another person drives
            elif key in ("t", "o"):
                self._take(now, over=key == "o")
            elif key in _AXES:
                axis, direction = _AXES[key]
                self._held[axis], self._key_at, self._willing = (direction, now), now, True
            elif not key.isascii():
                self._note = f"this keyboard types {key}: W A S D need a Latin layout; the arrows drive, too"
            if key == ESCAPE:
                self._escape_at = now
        if len(keys) >= _BURST:  # the person may have let go of them long ago
            self.end(now)

    def tick(self, now: float, problem: str = "") -> list[Message]:
        """Return the messages to publish now. Call this every PERIOD_S. ``problem``: why there is no connection."""
        if now - self._ticked_at > SILENCE_S:  # this process stood still
            self.end(now)
        self._ticked_at = now
        self._assume(now)
        clock = self._tab.clock
        # Answered at once, as no network is between keys and driver: unanswered pings would count as a slow page.
        clock.echo(clock.ping(now), 1000 * now, now)
        view = self._driven.shown(self._tab, now)
        self._asked = (view.by if view.asking else "") or self._asked
        may_request = self.robot.situation(now).published  # its capabilities are known
        if view.keeps:  # the robot itself decides who drives: nothing is requested before it has published who does
            may_request = self._driven.published is not None
        if self._willing and may_request and not view.by and not view.asking:  # by: who has control
            self._take(now, over=False)
        self._out += self._driven.update(now)
        self._reason = f"no connection: {problem}" if problem else self._why_not(now)
        self._drive(now)
        zeros, requests = self._driven.tick(now)
        topic, commands, self._out = self.robot.estop.drive_topic, [*self._out, *zeros], []
        messages = [] if self.stop is None else self.stop.tick(now)
        messages += [Message(topic, self.robot.encode(command.drive), command.qos) for command in commands]
        return messages if problem else messages + requests  # without a connection no robot answers requests

    def end(self, now: float, *, leave: bool = False) -> None:
        """End the gesture for good; with ``leave`` also release control. A pause follows before the next gesture."""
        self._out += self._tab.interrupt(self._gesture, now)
        self._pressed, self._key_at = True, now  # as if a key were held, which must be released first
        if leave:
            self._willing = False
            self._out += self._driven.release(self._tab, now)

    @property
    def unconfirmed(self) -> str:
        """Return why this terminal's emergency stop is not confirmed; empty if none is pending."""
        return "" if self.stop is None or self.stop.confirmed else self.stop.robots[self.robot.base].why

    def status(self) -> str:
        """Return the status line: the command sent, or why none is. It has names from others: make it printable."""
        view, robot = self._driven.shown(self._tab, self._ticked_at), self.robot
        x, z, _ = self._wanted(self._ticked_at)
        motion = self._reason or ("let go first" if self._pressed else "ready")
        if self._driven.state is State.MOVING:
            motion = f"driving x {x:+.2f} z {z:+.2f}"
        if is_cut_off(robot.driveable):  # whatever is sent, nothing moves it
            motion = self._reason
        parts = (
            self.name,
            f"asked {view.by} for control" if view.asking and view.by else "",
            f"you have control, no longer {self._asked}" if view.you and self._asked else "",
            *([] if view.you else self._failures),  # ``you``: this terminal has control
            robot.itself,  # that it drives itself, by a script
            motion,
            doubt_of(robot.driveable, stopped=robot.latched),
            self.unconfirmed and f"EMERGENCY STOP NOT CONFIRMED: {self.unconfirmed}",
            f"{view.asks} asks for control: l lets {view.asks} drive" if view.you and view.asks else "",
            "" if robot.volts is None else f"{robot.volts:.1f} V",
            "" if not robot.slow_s else f"slow connection: commands take {robot.slow_s:.1f} s",
            self._note,
        )
        return " · ".join(filter(None, parts))

    def _assume(self, now: float) -> None:
        """Assume that a board without capabilities drives, once it was online for HEARD_S, if the person says so."""
        if self._assumes:
            self._heard_at = min(self._heard_at, now) if self.robot.online(now) else float("inf")
            if now - self._heard_at >= HEARD_S:
                self.robot.assume((*AXES, "y"))

    def _take(self, now: float, *, over: bool) -> None:
        self._willing, self._asked, self._failures = False, "", []
        self._out += self._driven.take(self._tab, now, lambda: None, self._failures.append, over=over)

    def _drive(self, now: float) -> None:
        """Send a command of the gesture, or a zero at its end."""
        x, z, y = self._wanted(now)
        moves = bool(x or z or y)
        if moves and not self._pressed:
            self._gesture, self._asked = self._gesture + 1, ""
        self._pressed = moves or (self._pressed and now - self._key_at < HELD_S)
        if moves or self._driven.state is State.MOVING:
            op = DriveOp(ref=self.robot.base, g=self._gesture, t=1000 * now, x=x, z=z, y=y)
            self._out += self._driven.drive(self._tab, op, now, self._reason)[0]  # without why, if it is refused

    def _why_not(self, now: float) -> str:
        """Return why the robot cannot be driven; empty if it can."""
        view, situation = self._driven.shown(self._tab, now), self.robot.situation(now)
        situation = situation._replace(
            driven=view.by != "" and not view.you,
            listening=not view.you,  # "Take control to drive": here control is needed even if no person has it
            stopping=self.stop is not None and not self.stop.finished,
        )
        if not self._heartbeat:  # none comes on this connection: a robot counts as online
            situation = situation._replace(online=True)
        device = f"{view.device}, " if view.device else ""
        driver = f"{view.by} ({device}name {'' if view.checked else 'not '}checked)"
        code, stopped = first_reason(situation), self.robot.stopped_by
        why = words(code, self.name, stopped=stopped, driven=driver, script=self.robot.script)
        if not why and self.robot.parked:  # `Situation` does not know of it
            return PARKED
        return why

    def _wanted(self, now: float) -> tuple[float, float, float]:
        """Return x, z and y from the held keys."""
        held = {axis: direction for axis, (direction, at) in self._held.items() if now - at < HELD_S}
        turn, speed, up = self._turn * held.get("x", 0), self._speed * held.get("z", 0), self._speed * held.get("y", 0)
        most = max(1.0, abs(speed + turn), abs(speed - turn))  # no wheel is faster than 1
        x, z, y = round(turn / most, 3), round(speed / most, 3), round(up, 3)
        return x + 0.0, z + 0.0, y + 0.0  # -0.0 becomes 0.0

    def _begin_stop(self, now: float) -> None:
        self.end(now)
        if self.stop is None or self.stop.finished:
            self.stop = StopSender(new_name(), by=self._by, why="", now=now, robots=[self.robot.base])
            for message in self.robot.remembered.values():
                self.stop.receive(message, now)
