"""Who drives which robot, and which commands of pages reach it. Pure: times are passed in, commands are returned.

Motion belongs to a numbered gesture: from the moment the inputs leave neutral until they are released. What interrupts
a gesture ends it for good, so a key that is held down never moves anything again before it was released.
"""

import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec

from pebble.client.control import IDLE_S, ControlClient
from pebble.client.pace_of_link import WIDE, Pace
from pebble.contract.payloads import Drive
from pebble.transports import QoS
from pebble.web.messages import DriveOp
from pebble.web.page_clock import PageClock

SILENCE_S = 0.25  # without a command of a gesture it is over
REPEATS_S = (0.1, 0.2)  # after a zero of the server's own
TAKEN_FROM_IDLE_S = 5.0  # a driver who has not moved for so long is not asked
RESERVED_S = 5.0  # for a page that connects again

LET_GO = "Let go first"
ZERO, FINAL_ZERO = Drive(), Drive(valid_ms=0)


class Command(NamedTuple):
    """A drive command to be published."""

    ref: str
    drive: Drive
    qos: QoS = WIDE.qos


@dataclass(slots=True, eq=False)
class Tab:
    """One control connection of a page."""

    token: str
    user: str
    device: str
    clock: PageClock = field(default_factory=PageClock)
    live: int | None = None  # the gesture that lasts
    live_ref: str = ""
    over: int = -1  # this gesture and all before it have ended


@dataclass(slots=True, eq=False)
class Lease:
    """The right to drive one robot."""

    tab: Tab
    idle_from: float
    moving: bool = False  # its last command was no zero
    sent_at: float = float("-inf")  # of the last command that was forwarded
    received_at: float = float("-inf")  # of the last command of the gesture, forwarded or not
    control: ControlClient | None = None  # of a robot that keeps it itself
    decided: str = ""  # the key by which it was granted

    def signed(self, drive: Drive) -> Drive:
        """That command with the key of control."""
        key = "" if self.control is None else self.control.key
        return msgspec.structs.replace(drive, key=key) if key else drive


class Elsewhere(NamedTuple):
    """Who drives a robot, as it says itself, but not by this server."""

    by: str
    device: str


class Outcome(NamedTuple):
    """What follows from a message of a page: commands to publish, and why it was refused, if it was."""

    commands: list[Command]
    refused: str = ""


class Driving:
    """All leases of one server. ``changed`` collects the robots whose driver is another one than before."""

    def __init__(self) -> None:
        self.leases: dict[str, Lease] = {}
        self.changed: set[str] = set()
        self.elsewhere: Callable[[str], Elsewhere | None] = lambda _ref: None
        self.pace_of: Callable[[str], Pace] = lambda _ref: WIDE
        self.renew_key()
        self._reserved: dict[str, tuple[str, Lease, float]] = {}  # by token: the robot, and until when
        self._repeats: dict[str, list[float]] = {}  # by robot: when to send a zero again

    def renew_key(self) -> None:
        """Robots without control compare ages per key: what was on its way takes another one from now on."""
        self._key = secrets.token_hex(4)

    # -- leases

    def take(self, tab: Tab, ref: str, now: float, *, over: bool = False) -> Outcome:
        """Give ``tab`` the lease; ``over``: also from a driver who is active."""
        lease = self.leases.get(ref)
        if lease is not None and lease.tab is tab:
            return Outcome([])
        if not over and (who := self._active(ref, now)):
            return Outcome([], f"{who} is driving")
        commands = [] if lease is None else self._end_lease(ref, now)
        if tab.live is not None:  # it moves another robot: inputs that are held now move neither
            commands += self._end_gesture(tab, tab.live, now)
        self.leases[ref] = Lease(tab, now)
        self.changed.add(ref)
        return Outcome(commands)

    def grant(self, tab: Tab, ref: str, control: ControlClient, now: float) -> list[Command]:
        """The robot has given ``tab`` the control that it keeps itself."""
        commands = self._end_lease(ref, now) if ref in self.leases else []
        if tab.live is not None:
            commands += self._end_gesture(tab, tab.live, now)
        self.leases[ref] = Lease(tab, now, control=control, decided=control.decided)
        self.changed.add(ref)
        return commands

    def revoke(self, ref: str, now: float) -> list[Command]:
        """The robot has taken it away."""
        self.leases[ref].control = None  # there is nothing to give back
        return self._end_lease(ref, now)

    def release(self, tab: Tab, ref: str, now: float) -> list[Command]:
        """Give the lease back."""
        lease = self.leases.get(ref)
        return [] if lease is None or lease.tab is not tab else self._end_lease(ref, now)

    def closed(self, tab: Tab, now: float) -> list[Command]:
        """The connection has ended: stop what it moved; its leases wait a moment for it to come back."""
        commands = []
        for ref, lease in [(ref, lease) for ref, lease in self.leases.items() if lease.tab is tab]:
            commands += self._end_lease(ref, now)
            self._reserved[tab.token] = (ref, lease, now + RESERVED_S)
        return commands

    def withdraw(self, tab: Tab, now: float) -> list[Command]:
        """The user may no longer drive: as ``closed``, and nothing waits."""
        commands = self.closed(tab, now)
        self._reserved.pop(tab.token, None)
        return commands

    def restore(self, token: str, tab: Tab, now: float) -> tuple[list[Command], str]:
        """Give a page that has connected again its lease back, unless another page has taken it, but no gesture.

        Its old connection may still be open, if nothing comes from it any more. With the commands, a robot that has to
        be asked, because it keeps control itself; "" none.
        """
        old = (one.tab for one in self.leases.values() if one.tab.token == token)
        stalled = next((one for one in old if one.clock.problem(now)), None)
        commands = [] if stalled is None else self.closed(stalled, now)
        ref, lease, until = self._reserved.pop(token, ("", None, 0.0))
        if lease is None or now > until or ref in self.leases or self._active(ref, now):
            return commands, ""
        if lease.control is not None:
            return commands, ref
        self.leases[ref] = Lease(tab, now)
        self.changed.add(ref)
        return commands, ""

    def moved_by(self, ref: str) -> str:
        """Return who moves that robot now: while a gesture lasts, or as the robot says. Empty: no page does."""
        if (other := self.elsewhere(ref)) is not None:
            return other.by
        lease = self.leases.get(ref)
        return "" if lease is None or lease.tab.live is None or lease.tab.live_ref != ref else lease.tab.user

    # -- commands

    def drive(self, tab: Tab, op: DriveOp, now: float, blocked: str = "") -> Outcome:
        """Judge a command of a gesture. ``blocked``: why this robot may not be moved. Raises ClockJumpError."""
        if not (op.x or op.z or op.y):
            return Outcome(self._zero(tab, op, now))
        if op.g <= tab.over:
            return Outcome([], LET_GO)
        why = self._why_not(tab, op, now) or blocked
        if why:
            return Outcome(self._end_gesture(tab, op.g, now), why)
        lease = self.leases[op.ref]
        if tab.live != op.g:
            self._begin(tab, lease, op)
        lease.received_at = now
        pace = self.pace_of(op.ref)
        if now - lease.sent_at < pace.step_s:
            return Outcome([])
        lease.sent_at, lease.moving = now, True
        drive = lease.signed(Drive(x=op.x, z=op.z, y=op.y, valid_ms=WIDE.valid_ms))
        return Outcome([Command(op.ref, pace.dated(drive, now, self._key), pace.qos)])

    def stop(self, ref: str, now: float) -> list[Command]:
        """A zero from anybody; the gesture that moves the robot is over."""
        self.interrupt(ref, now)
        return self._final_zero(ref, now)

    def interrupt(self, ref: str, now: float) -> list[Command]:
        """The gesture that moves the robot is over."""
        lease = self.leases.get(ref)
        if lease is None or lease.tab.live is None or lease.tab.live_ref != ref:
            return []
        return self._end_gesture(lease.tab, lease.tab.live, now)

    def tick(self, now: float) -> list[Command]:
        """End silent gestures and idle leases; to be called every 50 ms."""
        commands: list[Command] = []
        for ref, lease in list(self.leases.items()):
            if lease.tab.live is not None and lease.tab.live_ref == ref:
                if now - lease.received_at > SILENCE_S:
                    commands += self._end_gesture(lease.tab, lease.tab.live, now)
            elif now - lease.idle_from > IDLE_S:
                commands += self._end_lease(ref, now)
        commands += list(self._repeated(now))
        for token in [token for token, (_, _, until) in self._reserved.items() if now > until]:
            del self._reserved[token]
        return commands

    # -- inside

    def _active(self, ref: str, now: float) -> str:
        """Who drives it now and has to be asked; empty: it can be taken."""
        if (other := self.elsewhere(ref)) is not None:
            return other.by
        lease = self.leases.get(ref)
        if lease is None or (lease.tab.live is None and now - lease.idle_from >= TAKEN_FROM_IDLE_S):
            return ""
        return lease.tab.user

    def _why_not(self, tab: Tab, op: DriveOp, now: float) -> str:
        lease = self.leases.get(op.ref)
        if lease is None or lease.tab is not tab:
            other = self._active(op.ref, now)
            return f"{other} is driving" if other else "Take control to drive"
        if tab.live is not None and (tab.live != op.g or tab.live_ref != op.ref):
            return LET_GO  # the end of the one before was lost
        if tab.live is not None and now - lease.received_at > SILENCE_S:
            return LET_GO  # the page stood still, or this process
        if problem := tab.clock.problem(now):
            return problem[0].upper() + problem[1:]
        return "Commands are late" if tab.clock.late(op.t, now) else ""

    def _begin(self, tab: Tab, lease: Lease, op: DriveOp) -> None:
        tab.live, tab.live_ref = op.g, op.ref
        lease.sent_at = float("-inf")
        self._repeats.pop(op.ref, None)  # they would interrupt it
        self.changed.add(op.ref)

    def _zero(self, tab: Tab, op: DriveOp, now: float) -> list[Command]:
        """Always forwarded. At the end of a gesture it is the release."""
        tab.over = max(tab.over, op.g)
        lease = self.leases.get(op.ref)
        mine = lease is not None and lease.tab is tab
        if lease is not None and mine:
            lease.moving = False
        if tab.live is not None and op.g >= tab.live:
            self._over(tab, now)
        if lease is None or not mine or op.final:
            return [Command(op.ref, FINAL_ZERO)]
        return [Command(op.ref, lease.signed(ZERO))]  # with the key it is the letting go of who has control

    def _end_gesture(self, tab: Tab, gesture: int, now: float) -> list[Command]:
        """Interrupt it: it stays over, and what it moved stops."""
        tab.over = max(tab.over, gesture)
        ref = tab.live_ref
        if tab.live is None or tab.live > gesture:
            return []
        self._over(tab, now)
        lease = self.leases.get(ref)
        if lease is None or lease.tab is not tab or not lease.moving:
            return []
        lease.moving = False
        return self._final_zero(ref, now)

    def _over(self, tab: Tab, now: float) -> None:
        lease = self.leases.get(tab.live_ref)
        if lease is not None and lease.tab is tab:
            lease.idle_from = now
        self.changed.add(tab.live_ref)
        tab.live, tab.live_ref = None, ""

    def _end_lease(self, ref: str, now: float) -> list[Command]:
        lease = self.leases[ref]
        tab = lease.tab
        commands = []
        if tab.live is not None and tab.live_ref == ref:
            commands = self._end_gesture(tab, tab.live, now)
        if lease.control is not None:
            lease.control.release()
        del self.leases[ref]
        self.changed.add(ref)
        return commands

    def _final_zero(self, ref: str, now: float) -> list[Command]:
        self._repeats[ref] = [now + after for after in REPEATS_S]
        return [Command(ref, FINAL_ZERO)]

    def _repeated(self, now: float) -> Iterator[Command]:
        for ref, times in list(self._repeats.items()):
            if times[0] <= now:
                late = now - times[0] > SILENCE_S  # this process stood still: a newer gesture may have begun elsewhere
                self._repeats[ref] = [at for at in times if at > now]
                if not self._repeats[ref]:
                    del self._repeats[ref]
                if not late:
                    yield Command(ref, FINAL_ZERO)
