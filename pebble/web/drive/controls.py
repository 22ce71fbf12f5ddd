"""What the tabs of this server want of robots that keep control themselves, and what these answer. Pure."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from pebble.client.control import ControlClient
from pebble.client.pace_of_link import WIDE
from pebble.client.robot_view import RobotView
from pebble.contract.payloads import ControlState
from pebble.transports import Message
from pebble.web.drive.driving import Command, Driving, Elsewhere, Tab

MOST_WISHES = 16  # of one tab: robots of which it has control, or asks for it


@dataclass(slots=True, eq=False)
class Wish:
    """One tab's wish for control of one robot. ``granted`` and ``failed`` are called when the robot has answered."""

    tab: Tab
    ref: str
    client: ControlClient
    granted: Callable[[], None]
    failed: Callable[[str], None]
    ended_at: float = float("inf")


class Step(NamedTuple):
    """What is to be published, in this order."""

    commands: list[Command]
    messages: list[Message]


class Controls:
    """Call :meth:`update` when a robot's state has changed, and :meth:`tick` every 50 ms."""

    def __init__(self, driving: Driving, robot_of: Callable[[str], RobotView | None]) -> None:
        self._driving, self._robot_of = driving, robot_of
        self._wishes: list[Wish] = []

    # -- of tabs

    def ask(
        self,
        tab: Tab,
        robot: RobotView,
        now: float,
        granted: Callable[[], None],
        failed: Callable[[str], None],
        *,
        over: bool = False,
    ) -> str:
        """Want control for this tab; returns why not."""
        wish = self._of(tab, robot.base)
        if wish is None:
            if sum(one.tab is tab for one in self._wishes) >= MOST_WISHES:
                return f"This page has control of {MOST_WISHES} robots: release one"
            client = ControlClient(robot.control, by=tab.user, device=tab.device, pace_of=lambda: robot.pace)
            wish = Wish(tab, robot.base, client, granted, failed)
            self._wishes.append(wish)
        wish.granted, wish.failed = granted, failed
        wish.client.ask(now, over=over)
        self._driving.changed.add(robot.base)
        return ""

    def withdraw(self, tab: Tab, ref: str) -> None:
        """It does not ask any more; what it has is given back by the end of its lease."""
        wish = self._of(tab, ref)
        if wish is not None and not wish.client.held:
            wish.client.release()
            self._driving.changed.add(ref)

    def closed(self, tab: Tab) -> None:
        """Its connection has ended."""
        for wish in self._wishes:
            if wish.tab is tab:
                wish.client.release()

    # -- of robots

    def update(self, ref: str, now: float) -> list[Command]:
        """A robot has answered, or is another one than before."""
        commands: list[Command] = []
        for wish in [one for one in self._wishes if one.ref == ref]:
            commands += self._update(wish, now)
        robot, lease = self._robot_of(ref), self._driving.leases.get(ref)
        if lease is not None and lease.control is None and robot is not None and robot.controlled:
            commands += self._driving.revoke(ref, now)
        self._driving.changed.add(ref)
        return commands

    def tick(self, now: float) -> Step:
        """What to publish now."""
        commands: list[Command] = []
        messages: list[Message] = []
        for wish in list(self._wishes):
            messages += wish.client.tick(now)
            commands += self._update(wish, now)
        self._wishes = [one for one in self._wishes if not self._is_over(one, now)]
        return Step(commands, messages)

    # -- what is known

    def elsewhere(self, ref: str) -> Elsewhere | None:
        """Who has control of that robot from elsewhere than this server; None also if the robot does not keep it."""
        state = self.state(ref)
        if state is None or not state.id or any(one.client.id == state.id for one in self._wishes):
            return None
        return Elsewhere(state.by or "somebody", state.device)

    def state(self, ref: str) -> ControlState | None:
        """It is what that robot has published; None if it does not keep control itself."""
        robot = self._robot_of(ref)
        return robot.control.state if robot is not None and robot.controlled else None

    def asks(self, tab: Tab, ref: str) -> bool:
        """Whether this tab waits for control."""
        wish = self._of(tab, ref)
        return wish is not None and wish.client.wanted and not wish.client.held

    # -- inside

    def _of(self, tab: Tab, ref: str) -> Wish | None:
        return next((one for one in self._wishes if one.tab is tab and one.ref == ref), None)

    def _update(self, wish: Wish, now: float) -> list[Command]:
        client, lease = wish.client, self._driving.leases.get(wish.ref)
        robot = self._robot_of(wish.ref)
        if robot is None or not robot.controlled or robot.control is not client.robot:
            client.release()  # it is gone, or was forgotten meanwhile
        client.update(now)
        has = had = lease is not None and lease.control is client
        commands: list[Command] = []
        if has and lease is not None and client.decided != lease.decided:
            commands = self._driving.revoke(wish.ref, now)
            has = False
        if client.held and not has:
            commands += self._driving.grant(wish.tab, wish.ref, client, now)
            wish.granted()
        if client.failed:
            if not had:  # who has had it sees who has it now
                wish.failed(client.failed)
            client.failed = ""
            self._driving.changed.add(wish.ref)
        return commands

    def _is_over(self, wish: Wish, now: float) -> bool:
        """Not before the robot has taken note: until then it is this server that has control, and no other."""
        if not wish.client.done:
            wish.ended_at = float("inf")
            return False
        wish.ended_at = min(wish.ended_at, now)
        state, robot = self.state(wish.ref), self._robot_of(wish.ref)
        answer_s = (WIDE if robot is None else robot.pace).answer_s
        return state is None or state.id != wish.client.id or now - wish.ended_at > answer_s
