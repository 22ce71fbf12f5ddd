"""What pages and robots want of driving, and what is published for it."""

from collections.abc import Callable

from msgspec.structs import replace

from pebble.client.broker import Broker
from pebble.client.estop import send
from pebble.client.pace_of_link import WIDE, Pace
from pebble.client.robot_view import RobotView
from pebble.contract import DRIVE, codec
from pebble.transports.clock import since_boot as clock
from pebble.web import messages as m
from pebble.web.drive.controls import Controls
from pebble.web.drive.driving import Command, Driving, Tab
from pebble.web.drive.refusals import Refusals
from pebble.web.robots import Robots


class Drivers:
    """It belongs to one server. What a method decides is published at once."""

    def __init__(self, broker: Broker, robots: Robots) -> None:
        self.driving = Driving()
        self.controls = Controls(self.driving, robots.view)
        self.refusals = Refusals(broker, self.driving, robots.view)
        self.driving.elsewhere, self.driving.pace_of = self.controls.elsewhere, self.pace_of
        self._broker, self._robots = broker, robots

    def pace_of(self, ref: str) -> Pace:
        robot = self._robots.view(ref)
        return WIDE if robot is None else robot.pace

    def keeps_control(self, ref: str) -> bool:
        """Whether that robot decides itself who drives it; of others, each server decides for its own pages."""
        robot = self._robots.view(ref)
        return robot is not None and robot.controlled

    # -- of pages

    def take(
        self, tab: Tab, robot: RobotView, granted: Callable[[], None], failed: Callable[[str], None], *, over: bool
    ) -> None:
        """A page wants control; ``granted``, or ``failed`` with the reason, is called as soon as that is known."""
        now = clock()
        if why := self.refusals.nameless(robot):
            failed(why)
            return
        if robot.controlled:
            why = self.controls.ask(tab, robot, now, granted, failed, over=over)
            self._send_control(now)
        else:
            commands, why = self.driving.take(tab, robot.base, now, over=over)
            self._publish(commands)
            if not why:
                granted()
        if why:
            failed(why)

    def release(self, tab: Tab, ref: str) -> bool:
        """A page gives control back, or does not ask for it any more; whether it had it."""
        lease, now = self.driving.leases.get(ref), clock()
        self._publish(self.driving.release(tab, ref, now))
        self.controls.withdraw(tab, ref)
        self._send_control(now)
        return lease is not None and lease.tab is tab

    def restore(self, token: str, tab: Tab, granted: Callable[[], None], failed: Callable[[str], None]) -> None:
        """A page has connected again."""
        commands, ref = self.driving.restore(token, tab, clock())
        self._publish(commands)
        if ref and (robot := self._robots.view(ref)) is not None:
            self.take(tab, robot, granted, failed, over=False)

    def closed(self, tab: Tab, *, for_good: bool = False) -> None:
        """The connection of a page has ended; ``for_good``: its user may no longer drive."""
        end, now = self.driving.withdraw if for_good else self.driving.closed, clock()
        try:
            self._publish(end(tab, now))
        finally:
            self.controls.closed(tab)
            self._send_control(now)

    def closed_all(self) -> None:
        for lease in list(self.driving.leases.values()):
            self.closed(lease.tab)

    def drive(self, tab: Tab, op: m.DriveOp, blocked: str) -> tuple[bool, str]:
        """Judge a command of a gesture, and publish what follows: whether wheels move now, and why it was refused."""
        now = clock()
        outcome = self.driving.drive(tab, op, now, blocked or self.refusals.of_driving(op.ref))
        accepted = self._publish(outcome.commands, tab.user)
        if outcome.refused:
            return False, outcome.refused
        if not accepted:
            self._publish(self.driving.stop(op.ref, now))
            return False, "The server cannot reach the broker"
        return bool(outcome.commands) and outcome.commands[0].drive.moves, ""

    def stop(self, ref: str, by: str) -> None:
        """A zero from anybody, who need not drive."""
        robot = self._robots.view(ref)
        if robot is not None and (robot.drives or not robot.capabilities):
            self._publish(self.driving.stop(ref, clock()), by)

    def view(self, tab: Tab, ref: str) -> m.DriverView:
        """What this page is shown of who drives a robot."""
        state = self.controls.state(ref)
        view = m.DriverView(keeps=self.keeps_control(ref), asking=self.controls.asks(tab, ref))
        if state is not None:
            asks = (state.asks or "somebody") if state.asks_id else ""
            view = replace(view, asks=asks, checked=state.named, others=state.others)
        if (other := self.controls.elsewhere(ref)) is not None:
            return replace(view, by=other.by, device=other.device)
        lease = self.driving.leases.get(ref)
        if lease is None:
            return view
        driver = lease.tab
        idle = None if driver.live is not None and driver.live_ref == ref else clock() - lease.idle_from
        return replace(view, by=driver.user, device=driver.device, you=driver is tab, idle_s=idle)

    # -- of robots

    def updated(self, ref: str) -> None:
        """A robot has published what it can do, or who has control."""
        self._publish(self.controls.update(ref, clock()))

    def moved(self, ref: str) -> None:
        """A robot is at another broker: what moves it has an end there, and begins anew."""
        self._publish(self.driving.interrupt(ref, clock()))

    # -- what is due

    def tick(self, now: float) -> None:
        self._publish(self.driving.tick(now))
        self._send_control(now)

    # -- inside

    def _send_control(self, now: float) -> None:
        """Publish what is due of control; after the zeros of who has had it."""
        step = self.controls.tick(now)
        self._publish(step.commands)
        send(self._broker.publish, step.messages)

    def _publish(self, commands: list[Command], by: str = "") -> bool:
        """Publish drive commands of a person, each to the robot's own topic; False if one was not accepted."""
        accepted = True
        for ref, drive, qos in commands:
            topic = self._robots.topic(ref, "drive", "topic", DRIVE)
            accepted = self._broker.publish(topic, codec.encode(DRIVE, drive), qos=qos, by=by) and accepted
        changed, self.driving.changed = self.driving.changed, set()
        self._robots.mark_drivers(changed)
        return accepted
