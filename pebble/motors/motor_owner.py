"""The base of every program that owns motors: it moves them only as its guard permits, and for a limited time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import Any, ClassVar

from pebble import contract as c
from pebble.contract import groups
from pebble.contract import payloads as p
from pebble.errors import PayloadError, TransportError
from pebble.motors.control import Control, earliest
from pebble.motors.motion_inbox import MotionInbox, ReceivedDrive, ReceivedRequest
from pebble.motors.motor_guard import MotorGuard
from pebble.motors.state_file import StateFile
from pebble.runtime.parent import Notifier, Reported
from pebble.runtime.service import WAIT_LIMIT_S, Service, every, on
from pebble.runtime.timers import Timer
from pebble.transports import Message, QoS

_SAVE_AGAIN_S = 1.0
_REPEAT_S = 5.0  # as often as boards repeat their reports
_CHECK_S = 1.0  # an answer to a subscription may come later than the connection
_FINAL_ZERO = p.Drive(x=0.0, z=0.0, valid_ms=0)


class MotorOwner(Service, ABC):
    """A service that receives stops, control and drive commands, and moves motors as its guard permits.

    A subclass moves them: :meth:`move`, :meth:`halt`. Both are called on the service's thread or on one of the
    transport's, never on two at once, and must not wait. ``move`` is valid for some time only, and :meth:`halt` is
    called at its end; a subclass whose hardware continues by itself also gives the hardware that limit. The subclass
    halts in its ``start()``, before anything can arrive, and at its end, by :meth:`on_stop`.
    """

    #: Commands, such as lights, that it carries out with the drive command of the same group (pebble.contract.groups).
    company: ClassVar[tuple[c.Channel, ...]] = ()

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._takes_groups = self.config.services.mqtt_bridge.link.groups
        self.notifier = Notifier()
        self._control = Control(
            self.config.security,
            lambda state: self.publish(c.CONTROL_STATE, state, owner=self.owner),
            self.clock(),
            self.owner,
            self.config.motor_owners,
            self._show_turn,
            bridged=self.config.services.mqtt_bridge.enabled,
        )
        self._waiting = MotionInbox(self._control)  # messages that are not judged yet
        self.state_file = StateFile(self.config.state_file(f"estop-{self.owner}"), self._on_saved)
        self._barred_file = StateFile(self.config.run_dir() / f"barred-{self.owner}.json")
        self._guard = MotorGuard(
            self.state_file,
            self._barred_file,
            self._publish_state,
            self.counters,
            self._control,
            watchdog_s=self.drive_timeout_s,
            now=self.clock(),
        )
        self.on_stop(self.state_file.close)  # first, so called after all that start() adds: a file may be slow
        self.on_stop(self._barred_file.close)
        self._deadline: Timer | None = None  # stops the motors unless a command arrives; None: they are stopped
        self._guard_timer: Timer | None = None  # for the next tick of guard and control
        self.announced_latching = True  # operators were told that a stop latches here
        self._estop_note = Reported(self.notifier.feature, "estop", True)  # to the launcher: a stop latches here
        self._control_note = Reported(self.notifier.feature, "control", True)  # and requests for control are received

    @property
    @abstractmethod
    def owner(self) -> str:
        """Name of this motor owner in ``outgoing/estop/OWNER``, as in ``Extension.motors``."""

    @property
    def drive_timeout_s(self) -> float:
        """Seconds for which a drive command is valid."""
        return 0.75

    @property
    def latched(self) -> bool:
        """True while an emergency stop lasts, for hardware that locks itself. Changes only in :meth:`judge`."""
        return self._guard.latched

    @abstractmethod
    def move(self, drive: p.Drive, valid_s: float) -> None:
        """Move the motors: ``drive.x`` steers and ``drive.z`` is the throttle, both -1..1; for ``valid_s`` seconds."""

    @abstractmethod
    def halt(self) -> None:
        """Stop the motors now. This is called again and again while the motors stand still."""

    def move_with(self, drive: p.Drive, valid_s: float, company: tuple[groups.Member, ...]) -> None:  # noqa: ARG002
        """Carry out a drive command, or a zero, together with ``company``: other commands of the same group.

        A subclass that names channels in :attr:`company` overrides this method.
        """
        self.move(drive, valid_s)

    def accompany(self, company: tuple[groups.Member, ...]) -> None:
        """Carry out ``company``, the members of a group that has no drive command; on the service's thread."""

    def report(self, able: bool, why: str = "") -> None:
        """Tell the launcher whether the motors can be moved, or why not; the robot's status has it as ``driveable``."""
        self.notifier.mcu("ready" if able else "absent", 0 if able else None, why)

    def start(self) -> None:
        self._guard.begin(self.clock())
        self._control.note(self.clock())
        super().start()

    # -- on the transport's threads; the stop is subscribed to before the drive commands

    @on(c.ESTOP, direct=True)
    def receive_stop(self, stop: p.EstopCommand, _arrived: float) -> None:
        if stop.owner not in self._control.peers:  # else the bridge repeats it only for another owner
            self._judge_soon(self._waiting.put_stop(stop))

    @on(c.ESTOP_RESET, direct=True)
    def receive_reset(self, reset: p.EstopReset, arrived: float) -> None:
        self._judge_soon(self._waiting.put_reset(reset, arrived))

    @on(c.CONTROL, direct=True)
    def receive_request(self, request: p.ControlRequest, arrived: float) -> None:
        self._judge_soon(self._waiting.put_request(request, False, arrived))

    @on(c.CONTROL_TAKE, direct=True)
    def receive_take(self, request: p.ControlRequest, arrived: float) -> None:
        self._judge_soon(self._waiting.put_request(request, True, arrived))

    def set_up(self) -> None:
        """Start and subscribe, also to the grants of control that other motor owners publish."""
        self.transport.on_state(self._waiting.note_state)
        super().set_up()
        receive = self.refusals.reader(c.CONTROL_TURN, self._receive_turn)
        for owner in self._control.peers:
            topic = c.CONTROL_TURN.topic(self.config.base, owner=owner)
            self.transport.subscribe(topic, receive, qos=QoS(c.CONTROL_TURN.default_qos), direct=True)
        if self._takes_groups:
            receive = self.refusals.reader(c.GROUP, self._receive_group)
            self.transport.subscribe(self.addresses[c.GROUP].topic, receive, qos=QoS.DELIVERED, direct=True)

    def _receive_turn(self, message: Message, turn: p.ControlTurn, names: dict[str, str]) -> None:
        if not message.retain:
            self._judge_soon(self._waiting.put_turn(names["owner"], turn))

    @on(c.DRIVE, direct=True)
    def receive_drive(self, drive: p.Drive, arrived: float) -> None:
        if not (drive.moves and self.is_copy(drive)):
            self._judge_soon(self._waiting.put_drive(drive, arrived))

    def is_copy(self, command: p.Drive | p.LightsSolid) -> bool:
        """True if ``command`` is a copy of a member of a group (`c.GROUP`), and this motor owner takes whole groups."""
        return self._takes_groups and command.group is True

    def _receive_group(self, message: Message, _value: Any, _names: dict[str, str]) -> None:
        """Handle the members of a group that this owner takes; other programs receive copies of their members."""
        try:
            members = groups.decode(message.payload)
        except PayloadError as error:
            self.refusals.malformed(c.GROUP, error)
            return
        drive = next((member.value for member in members if member.channel is c.DRIVE), None)
        company = tuple(member for member in members if member.channel in self.company)
        if drive is not None:
            self._judge_soon(self._waiting.put_drive(drive, self.clock() - message.waited_s, company))
        elif company:
            self.post_message(c.GROUP, partial(self.accompany, company), newest_of=c.GROUP.metric)

    @on(c.CONTROL_VOUCHED, direct=True)
    def receive_vouched(self, vouched: p.ControlVouched, _arrived: float) -> None:
        self._judge_soon(self._waiting.put_vouched(vouched))

    def _judge_soon(self, was_empty: bool) -> None:
        if was_empty and not self.run_if_idle(self.judge):
            self.post_first(self.judge)

    # -- commands

    def judge(self) -> None:
        """Judge all waiting messages, stops first, because a stop voids the drive commands that wait with it."""
        batch = self._waiting.take()
        only_halts = bool(batch.stops) and not self._latches
        for stop in batch.stops:
            self._halt()
            if only_halts:
                self.log_limited.warning("unlatched", "a stop only halts: it could not be reset")
                self._guard.judge(_FINAL_ZERO, self.clock())  # it ends scripts, as a stop that latches does
            else:
                self._guard.stop(stop, self.clock())
        for waiting in batch.resets:
            self._guard.reset(waiting.reset, self.clock() - waiting.at, self.clock())
        for request in batch.requests:
            self._answer(request)
        for owner, turn in batch.turns:
            self._control.receive_turn(owner, turn, self.clock())
            self._guard.bar(turn.barred, self.clock())
            self._note_control()
        if batch.lost:
            self._control.doubt(self.clock())  # renewals may be among them: no silence of the holder until now counts
        for received in batch.drives:
            if not (only_halts and received.drive.moves):  # after a stop that latches, the guard refuses them
                self._drive(received)
        if batch.vouched is not None:  # last: the vouched time covers the drive commands above
            self._control.vouch(batch.vouched, self.clock())
        self._arm_guard()
        if self._waiting.dropped:
            self._count_dropped()

    def _count_dropped(self) -> None:
        dropped = self._waiting.dropped - self.counters["motion_dropped"]
        if dropped:
            self.counters.add("motion_dropped", dropped)
            text = "dropped commands of many senders or stops that waited"
            self.log_limited.warning("motion_dropped", text, times=dropped)

    def _drive(self, received: ReceivedDrive) -> None:
        now, drive = self.clock(), received.drive
        if drive.moves and now - received.at > WAIT_LIMIT_S:
            self.count_late(c.DRIVE)
            self._control.doubt(now)  # what held it up may have cost other messages
            return
        valid_s = self._guard.judge(drive, now)
        self._note_control()
        if valid_s is None:
            return
        if self._deadline is not None and now >= self._deadline.due:
            self._halt()  # the dead-man's switch is late: the last drive command ends before this one begins
        valid_s -= now - received.at
        if valid_s <= 0:
            self._halt()
            if received.company and not drive.moves:  # a zero is never too old, nor is its group
                self.move_with(drive, 0.0, received.company)
            return
        self._set_deadline(now + valid_s)  # first: it holds even if a subclass fails
        if received.company:
            self.move_with(drive, valid_s, received.company)
        else:
            self.move(drive, valid_s)

    def _answer(self, received: ReceivedRequest) -> None:
        now = self.clock()
        if now - received.at > c.CONTROL.waits_s and not received.request.ends():
            self.count_late(c.CONTROL)
            self._control.doubt(now)  # others may be as late: no silence of the holder until now counts
            return
        self._control.request(received.request, received.over, now)  # ``over``: without asking the holder
        self._note_control()

    def _note_control(self) -> None:
        if self._control.note(self.clock()):
            self._halt()
        self._control.show_turn(self.clock())

    def _halt(self) -> None:
        self._set_deadline(None)
        self.halt()

    def _set_deadline(self, due: float | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if due is None else self.call_at(due, self._halt)

    # -- what the other end refuses to deliver

    @property
    def _latches(self) -> bool:
        """True if an emergency stop latches: the broker lets us subscribe to stops and to the resets that end them."""
        return not (self.refused(c.ESTOP) or self.refused(c.ESTOP_RESET))

    def on_connected(self) -> None:
        self.check_subscriptions()

    @every(_CHECK_S)
    def check_subscriptions(self) -> None:
        """Tell operators whether a stop latches here: only if the broker grants the topics of stops and of resets.

        Raises TransportError while the drive topic is refused: nothing could drive this robot.
        """
        if self.refused(c.DRIVE):
            raise TransportError(
                f"the broker refuses the subscription to {self.addresses[c.DRIVE].topic}: nothing can drive this robot."
                " Permit the user in local_mqtt to subscribe to it"
            )
        if self._latches is not self.announced_latching:
            self.announced_latching = self._latches
            self._announce_latching()
        self._control_note.report("control", not self.refused(c.CONTROL))
        self._estop_note.report("estop", self.announced_latching)

    def _announce_latching(self) -> None:
        if self.announced_latching:  # the caller has just set it: True is to be announced
            self.log.warning("the subscriptions to the emergency stop are granted again: a stop latches")
            self.repeat_state()
            return
        topics = [self.addresses[channel].topic for channel in (c.ESTOP, c.ESTOP_RESET) if self.refused(channel)]
        self.log.error(
            "the broker refuses the subscription to %s: this robot has no emergency stop, a stop only halts it%s."
            " Permit the user in local_mqtt to subscribe to both %s and %s",
            " and ".join(topics),
            ", and it stays stopped now" if self._guard.latched else "",
            self.addresses[c.ESTOP].topic,
            self.addresses[c.ESTOP_RESET].topic,
        )
        self.retract(c.ESTOP_STATE, owner=self.owner)  # without a state it has no emergency stop

    # -- the guard

    def _arm_guard(self) -> None:
        due = earliest(self._guard.due, self._control.due)
        if due is None or (self._guard_timer is not None and self._guard_timer.due <= due):
            return
        if self._guard_timer is not None:
            self._guard_timer.cancel()
        self._guard_timer = self.call_at(due, self._tick_guard)

    def _tick_guard(self) -> None:
        self._guard_timer = None
        self._guard.tick(self.clock())
        self._control.tick(self.clock())
        self._note_control()
        self._arm_guard()

    @every(_SAVE_AGAIN_S)
    def save_again(self) -> None:
        stop = self._guard.appeared_stop() if self._latches else None
        if stop is not None:
            self.receive_stop(stop, self.clock())
        else:
            self._guard.save_again()

    @every(_REPEAT_S)
    def repeat_state(self) -> None:
        self._guard.repeat_state(self.clock())
        self._control.repeat_state(self.clock())
        self._arm_guard()

    def _publish_state(self, state: p.EstopState) -> None:
        """Publish ``state`` or, if stops do not latch, clear its topic at each call, because a bridge may miss one."""
        if self._latches:
            self.publish(c.ESTOP_STATE, state, owner=self.owner)
        else:
            self.clear(c.ESTOP_STATE, owner=self.owner)

    def _show_turn(self) -> None:
        turn = self._control.turn(self._guard.barred, self.clock())
        if turn is not None:
            self.publish(c.CONTROL_TURN, turn, owner=self.owner)

    def _on_saved(self, number: int, succeeded: bool) -> None:
        """Pass the result of a write from the file's thread to the service's."""

        def note() -> None:
            self._guard.on_saved(number, succeeded, self.clock())
            self._arm_guard()

        self.post(note, newest_of="saved")
