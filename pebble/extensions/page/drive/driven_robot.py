"""A robot that the pages of this server drive: who has control, and which commands reach it. Pure.

Motion belongs to a numbered gesture, which lasts from the moment the inputs leave neutral until they are released. An
interrupted gesture has ended for good: a key that is held down moves nothing before it was released.
"""

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from msgspec.structs import replace

from pebble.contract.payloads import ControlState, Drive
from pebble.extensions.operator.client import assumed
from pebble.extensions.operator.client.control import IDLE_S, ControlClient
from pebble.extensions.operator.client.drive_reasons import WORDS, Code, words
from pebble.extensions.operator.client.pace_of_link import WIDE, Pace
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page.messages import DriveOp, DriverView
from pebble.extensions.page.page_clock import PageClock
from pebble.transports import Message, QoS

SILENCE_S = 0.25  # without a command of a gesture it is over
REPEATS_S = (0.1, 0.2)  # after a zero of the server's own
TAKEN_FROM_IDLE_S = 5.0  # a driver who has not moved for so long is not asked
AWAITED_S = 5.0  # a page that connects again

LET_GO = WORDS["release"]
ZERO, FINAL_ZERO = Drive(), Drive(valid_ms=0)  # after a final one, an interrupted script does not resume


class State(Enum):
    """The state of a robot at this server."""

    FREE = "no page of this server has control"
    HELD = "a page has control, and its inputs rest"
    MOVING = "a gesture of the page that has control lasts"


class Event(Enum):
    """An event of one robot."""

    GIVEN = "a page gets control: from the robot, or from this server if the robot keeps none"
    ENDED = "its page gives control back, has gone, or has rested for a minute"
    LOST = "the robot has taken control away"
    MOVES = "a command of its page may move it"
    LETS_GO = "the zero that ends a gesture has come: its driver released the inputs"
    INTERRUPTED = "a stop, silence, a command that is refused, or another robot ends the gesture"


class Step(NamedTuple):
    """The effect of an event: the next state, and the actions."""

    state: State
    halts: bool = False  # by a final zero, which is repeated
    gives_back: bool = False  # who has had control tells the robot


#: What is not listed changes nothing. Zeros pass in every state.
TABLE = {
    (State.FREE, Event.GIVEN): Step(State.HELD),
    (State.HELD, Event.GIVEN): Step(State.HELD, gives_back=True),
    (State.MOVING, Event.GIVEN): Step(State.HELD, halts=True, gives_back=True),
    (State.HELD, Event.ENDED): Step(State.FREE, gives_back=True),
    (State.MOVING, Event.ENDED): Step(State.FREE, halts=True, gives_back=True),
    (State.HELD, Event.LOST): Step(State.FREE),
    (State.MOVING, Event.LOST): Step(State.FREE, halts=True),
    (State.HELD, Event.MOVES): Step(State.MOVING),
    (State.MOVING, Event.LETS_GO): Step(State.HELD),
    (State.MOVING, Event.INTERRUPTED): Step(State.HELD, halts=True),
}


class Command(NamedTuple):
    """A drive command to publish."""

    ref: str
    drive: Drive
    qos: QoS = WIDE.qos


@dataclass(slots=True, eq=False)
class Tab:
    """The control connection of one page. It moves one robot at a time."""

    token: str
    user: str
    device: str
    clock: PageClock = field(default_factory=PageClock)
    moves: "DrivenRobot | None" = None  # the robot that it moves now
    gesture: int = -1  # by which it moves that robot
    last_ended: int = -1  # this gesture and all before it have ended

    def end_until(self, gesture: int) -> None:
        """Note that this gesture, and all earlier ones, have ended for good."""
        self.last_ended = max(self.last_ended, gesture)

    def interrupt(self, gesture: int, now: float) -> list[Command]:
        """End this gesture, and all earlier ones, for good; halt the robot if the page moves it by one of them."""
        self.end_until(gesture)
        return [] if self.moves is None or self.gesture > gesture else self.moves.interrupt(now)


@dataclass(slots=True, eq=False)
class Wish:
    """A page's request to a robot that decides itself who drives it. The answer calls ``granted`` or ``failed``."""

    client: ControlClient
    granted: Callable[[], None]
    failed: Callable[[str], None]
    ended_at: float = float("inf")  # since when the client has wanted nothing more


class DrivenRobot:
    """The driving of one robot. ``changed`` collects the robots whose drivers must be shown to pages again."""

    def __init__(self, ref: str, view: Callable[[], RobotView | None], changed: set[str]) -> None:
        self.ref = ref
        self.state = State.FREE
        self.tab: Tab | None = None  # that has control
        self.client: ControlClient | None = None  # by which the robot has given control; None: this server has
        self._view, self._changed = view, changed
        self._given_key = ""  # the key with which the robot has given control
        self._wishes: dict[Tab, Wish] = {}
        self._idle_from = float("-inf")  # when control was given, or the last gesture ended
        self._sent_at = self._received_at = float("-inf")  # the last command of the gesture
        self._repeats: list[float] = []  # when to send the last zero again, in order
        self._awaited = ("", float("-inf"))  # token of a connection that ended with control; until when it counts
        self.renew_key()

    def renew_key(self) -> None:
        """Choose a new key for a new connection to the broker.

        Where no motor owner gives keys, the bridge judges a command's age by earlier commands with the same key, but
        those of the old connection must not count.
        """
        self._key = secrets.token_hex(4)

    # -- what is known

    @property
    def keeps_control(self) -> bool:
        """True if the robot itself decides who drives it. Otherwise this server does, for its own pages."""
        robot = self._view()
        return robot is not None and robot.controlled

    @property
    def published(self) -> ControlState | None:
        """Return the robot's own state of control; None if it publishes none."""
        robot = self._view()
        return robot.control.state if robot is not None and robot.controlled else None

    @property
    def pace(self) -> Pace:
        """Return the rate of commands to the robot."""
        robot = self._view()
        return WIDE if robot is None else robot.pace

    @property
    def moved_by(self) -> str:
        """Return the user who moves the robot now, by a gesture or by the robot's state; empty if none does."""
        if other := self._held_elsewhere():
            return other.by
        return self.tab.user if self.tab is not None and self.state is State.MOVING else ""

    def wanted_by(self, tab: Tab) -> bool:
        """True if that page has control, or asks for it."""
        return self.tab is tab or tab in self._wishes

    def awaits(self, token: str, now: float) -> bool:
        """True, once, if ``token``'s connection ended with control, AWAITED_S ago at most, and no client has it now."""
        awaited, until = self._awaited
        if awaited != token:
            return False
        self._awaited = ("", float("-inf"))
        return now <= until and self.state is State.FREE and self._held_elsewhere() is None

    def may_be_forgotten(self, now: float) -> bool:
        """True if nothing about the robot must be remembered."""
        return self.state is State.FREE and not self._wishes and not self._repeats and now > self._awaited[1]

    def shown(self, tab: Tab, now: float) -> DriverView:
        """Return the view of the driver for this page."""
        wish, state = self._wishes.get(tab), self.published
        asking = wish is not None and wish.client.wanted and not wish.client.held
        view = DriverView(keeps=self.keeps_control, asking=asking)
        if state is not None:
            asks = (state.asks or "somebody") if state.asks_id else ""
            view = replace(view, asks=asks, checked=state.named, others=state.others)  # named: the broker checks names
        if (other := self._held_elsewhere()) is not None:  # the robot has given control to another server
            return replace(view, by=other.by, device=other.device)
        if self.tab is None:
            return view
        idle_s = None if self.state is State.MOVING else now - self._idle_from
        return replace(view, by=self.tab.user, device=self.tab.device, you=self.tab is tab, idle_s=idle_s)

    # -- control

    def take(
        self, tab: Tab, now: float, granted: Callable[[], None], failed: Callable[[str], None], *, over: bool
    ) -> list[Command]:
        """Request control for a page; ``over``: even from its holder. Return what to publish if the server grants it.

        ``granted``, or ``failed`` with the reason, is called with the answer: now, or after the robot's next state.
        """
        robot = self._view()
        if robot is not None and robot.controlled:
            if tab in self._wishes:
                client = self._wishes[tab].client
            else:
                client = ControlClient(robot.control, by=tab.user, device=tab.device, pace_of=lambda: robot.pace)
            self._wishes[tab] = Wish(client, granted, failed)
            client.ask(now, over=over)
            self._changed.add(self.ref)
            return []
        if self.tab is not tab and not over and (driver := self._active_driver(now)):
            failed(words(Code.LEASE, driven=driver))
            return []
        commands = [] if self.tab is tab else self._give(tab, None, now)
        granted()
        return commands

    def release(self, tab: Tab, now: float) -> list[Command]:
        """Release control, or withdraw the request for it."""
        if self.tab is tab:
            return self._on(Event.ENDED, now)
        if (wish := self._wishes.get(tab)) is not None:
            wish.client.release()
            self._changed.add(self.ref)
        return []

    def closed(self, tab: Tab, now: float, *, for_good: bool) -> list[Command]:
        """Note that a page's connection has ended; ``for_good``: the user may no longer drive, so nothing is kept."""
        if self.tab is tab and not for_good:
            self._awaited = (tab.token, now + AWAITED_S)
        return self.release(tab, now)

    def update(self, now: float) -> list[Command]:
        """Note that the robot has published a state, or was replaced by another robot."""
        commands: list[Command] = []
        for tab, wish in list(self._wishes.items()):
            commands += self._follow_wish(tab, wish, now)
        if self.client is None and self.keeps_control:  # the robot itself does now: what this server gave is void
            commands += self._on(Event.LOST, now)
        self._changed.add(self.ref)
        return commands

    # -- commands

    def drive(self, tab: Tab, op: DriveOp, now: float, blocked: str) -> tuple[list[Command], str]:
        """Check a command of a gesture; return what to publish, and why it was refused (empty: it was not).

        ``blocked``: why this robot may not be moved. Raises ClockJumpError.
        """
        if not (op.x or op.z or op.y):
            return self._zero(tab, op, now), ""
        if op.g <= tab.last_ended:
            return [], LET_GO
        if why := self._why_not(tab, op, now) or blocked:
            return tab.interrupt(op.g, now), why
        if tab.moves is None:
            tab.moves, tab.gesture = self, op.g
            self._sent_at, self._repeats = float("-inf"), []  # to be sent at once; an old zero would end it
            self._on(Event.MOVES, now)
        self._received_at = now
        pace = self.pace
        if now - self._sent_at < pace.step_s:  # a thin link carries fewer commands than the page sends
            return [], ""
        self._sent_at = now
        drive = self._signed(Drive(x=op.x, z=op.z, y=op.y, valid_ms=WIDE.valid_ms))  # `dated` changes it on a thin link
        return [Command(self.ref, pace.dated(drive, now, self._key), pace.qos)], ""

    def stop(self, now: float) -> list[Command]:
        """Halt the robot for any user; the present gesture ends."""
        self.interrupt(now)
        return self._final_zero(now)

    def interrupt(self, now: float) -> list[Command]:
        """End the present gesture."""
        return self._on(Event.INTERRUPTED, now)

    def tick(self, now: float) -> tuple[list[Command], list[Message]]:
        """End silent gestures and idle control; return what to publish, in order. Call it every 50 ms."""
        commands: list[Command] = []
        if self.state is State.MOVING and now - self._received_at > SILENCE_S:
            commands += self.interrupt(now)
        elif self.state is State.HELD and now - self._idle_from > IDLE_S:
            commands += self._on(Event.ENDED, now)
        if self._repeats and self._repeats[0] <= now:
            late_s = now - self._repeats[0]
            self._repeats = [due for due in self._repeats if due > now]
            if late_s <= SILENCE_S:  # else this process stood still: a newer gesture may have begun elsewhere
                commands.append(Command(self.ref, FINAL_ZERO))
        messages: list[Message] = []
        for tab, wish in list(self._wishes.items()):
            messages += wish.client.tick(now)
            commands += self._follow_wish(tab, wish, now)
            if self._has_ended(wish, now):
                del self._wishes[tab]
        return commands, messages

    # -- inside

    def _on(self, event: Event, now: float) -> list[Command]:
        """Apply an event by the table of states."""
        step = TABLE.get((self.state, event))
        if step is None:
            return []
        if self.state is State.MOVING and self.tab is not None:  # each step from there ends the gesture
            self.tab.end_until(self.tab.gesture)
            self.tab.moves, self._idle_from = None, now
        commands = self._final_zero(now) if step.halts else []
        if step.gives_back and self.client is not None:
            self.client.release()
        if step.state is State.FREE:
            self.tab = self.client = None
        self.state = step.state
        self._changed.add(self.ref)
        return commands

    def _give(self, tab: Tab, client: ControlClient | None, now: float) -> list[Command]:
        """Give a page control; halt what moves. ``client`` has got control of the robot; None: this server gives it."""
        commands = self._on(Event.GIVEN, now) + tab.interrupt(tab.gesture, now)  # a key held down now moves no robot
        self.tab, self.client, self._given_key = tab, client, "" if client is None else client.decided
        self._idle_from = now
        return commands

    def _follow_wish(self, tab: Tab, wish: Wish, now: float) -> list[Command]:
        """Note the robot's answer to a page's request, if there is one; return the commands that follow from it."""
        client, robot = wish.client, self._view()
        is_same_robot = robot is not None and robot.controlled and robot.control is client.robot
        if not is_same_robot:
            client.release()  # the robot is gone, or was forgotten and has come back meanwhile
        client.update(now)
        had_control = self.client is client
        commands: list[Command] = []
        # ``decided`` is the present key of control: empty if control is lost, another one if it was given once more.
        if had_control and client.decided != self._given_key:
            commands = self._on(Event.LOST, now)
        if client.held and self.client is not client:  # for the first time, or after the loss above
            commands += self._give(tab, client, now)
            wish.granted()
        if client.failed:  # why the request has failed
            if not had_control:  # a page that loses control is shown the new driver instead
                wish.failed(client.failed)
            client.failed = ""
            self._changed.add(self.ref)
        return commands

    def _has_ended(self, wish: Wish, now: float) -> bool:
        """True if the page wants no control any more, and the robot confirms that or has not answered in time."""
        if not wish.client.done:
            wish.ended_at = float("inf")  # not ended: it may have asked again, or its release is not sent yet
            return False
        wish.ended_at = min(wish.ended_at, now)  # the first time that this was seen
        state = self.published
        return state is None or state.id != wish.client.id or now - wish.ended_at > self.pace.answer_s

    def _held_elsewhere(self) -> ControlState | None:
        """Return the robot's state of control if it has given control to another server; else None."""
        state = self.published
        if state is None or not state.id or any(wish.client.id == state.id for wish in self._wishes.values()):
            return None
        return replace(state, by=state.by or "somebody")

    def _active_driver(self, now: float) -> str:
        """Return the user who drives now, and must be asked for control; empty if control can be taken."""
        if other := self._held_elsewhere():
            return other.by
        if self.tab is None or (self.state is State.HELD and now - self._idle_from >= TAKEN_FROM_IDLE_S):
            return ""
        return self.tab.user

    def _why_not(self, tab: Tab, op: DriveOp, now: float) -> str:
        """Return why this page's gesture may not move the robot now; empty if it may."""
        if self.tab is not tab:
            driver = self._active_driver(now)
            return words(Code.LEASE if driver else Code.LISTENING, driven=driver)
        if tab.moves is not None and (tab.gesture != op.g or tab.moves is not self):
            return LET_GO  # the end of the earlier gesture was lost
        if tab.moves is not None and now - self._received_at > SILENCE_S:
            return LET_GO  # the page stood still, or this process
        if problem := tab.clock.problem(now):
            return problem[0].upper() + problem[1:]
        return words(Code.LATE) if tab.clock.late(op.t, now) else ""

    def _zero(self, tab: Tab, op: DriveOp, now: float) -> list[Command]:
        """Return a zero to publish, which is sent in every state. It ends this gesture and the page's earlier ones."""
        tab.end_until(op.g)
        if tab.moves is self and op.g >= tab.gesture:  # the page moves this robot by one of these gestures
            self._on(Event.LETS_GO, now)
        commands = tab.interrupt(op.g, now)  # zeros of another robot, if the page moves one by one of these
        if self._is_assumed:  # a silent board that connects anew is stopped only by a zero after that
            self._repeat_zeros(now)
        # Unless it is ``final`` (see DriveOp), the driver has let go: an interrupted script may resume.
        is_release = self.tab is tab and not op.final
        return [Command(self.ref, self._signed(ZERO) if is_release else FINAL_ZERO), *commands]

    def _signed(self, drive: Drive) -> Drive:
        """Return the command with the key of control."""
        key = "" if self.client is None else self.client.key
        return replace(drive, key=key) if key else drive

    def _final_zero(self, now: float) -> list[Command]:
        self._repeat_zeros(now)
        return [Command(self.ref, FINAL_ZERO)]

    def _repeat_zeros(self, now: float) -> None:
        repeats_s = assumed.REPEATS_S if self._is_assumed else REPEATS_S
        self._repeats = [now + after_s for after_s in repeats_s]

    @property
    def _is_assumed(self) -> bool:
        """True for a silent board: what it can do is assumed, and no stop can latch it."""
        robot = self._view()
        return robot is not None and robot.is_assumed
