"""Ties the parts of the server together: what arrives from the broker, what pages ask for, and what is due."""

import asyncio
import logging
import secrets
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any

import msgspec

from pebble.client.broker import Broker
from pebble.client.estop import send
from pebble.client.pace_of_link import WIDE
from pebble.client.pace_of_link import Pace as LinkPace
from pebble.client.page.settings import WebSettings
from pebble.client.robot_topics import FLEET, SYNONYMS
from pebble.client.robot_view import RobotView
from pebble.config.security import SecurityLevel
from pebble.contract import AUDIT, CAPABILITIES, CONTROL_STATE, DRIVE, DRIVING, LINK, ONLINE, channel_of, codec
from pebble.contract.identity import GATEWAYS, Identity, parse_topic
from pebble.errors import ConfigError
from pebble.fleet.audit import Audit
from pebble.fleet.database import DatabaseError
from pebble.fleet.people import People
from pebble.fleet.roles import Session
from pebble.runtime.by_name import ByName
from pebble.transports import Message
from pebble.transports.clock import since_boot as clock
from pebble.web import messages as m
from pebble.web.drive.controls import Controls
from pebble.web.drive.driven_here import DrivenHere
from pebble.web.drive.driving import Command, Driving, Tab
from pebble.web.drive.refusals import Refusals
from pebble.web.gateways import Gateways
from pebble.web.known_robots import SavedRobots
from pebble.web.media.chosen_sources import ChosenSources
from pebble.web.media.connection import MediaConnection
from pebble.web.media.pictures import MediaHub
from pebble.web.media.robot_streams import OwnHosts
from pebble.web.media.sound import SoundHub
from pebble.web.open_components import OpenComponents
from pebble.web.pace import STOP_WAITS_S, Pace
from pebble.web.robot_audits import RobotAudits
from pebble.web.robots import Robots
from pebble.web.stops import Stops

log = logging.getLogger(__name__)

TICK_S = 0.05
PEOPLE_S = 0.5  # between two looks at whether people or sessions were changed
_REFRESH_S = 0.25
_MANY_WAIT = 16 * 1024  # bytes that the broker has not confirmed
_ESTOP_METRIC = "web/estop"
_DAY_S = 24 * 3600


class Server:
    """All state of one server. Everything runs on one event loop."""

    def __init__(self, settings: WebSettings, people: People, audit: Audit) -> None:
        self.settings, self.people, self.audit = settings, people, audit
        server = f"{settings.name}-{secrets.token_hex(2)}"
        self.broker = Broker(settings.broker)
        self.media_connection = MediaConnection(Broker(settings.broker, "pebble-web-media"))
        self.robots, self.stops, self.driving = Robots(), Stops(self._has_sent), Driving(server)
        self.controls = Controls(self.driving, self._robot)
        self.driving.held_elsewhere = self.controls.elsewhere
        self.driving.pace_of = self._pace_of
        self.saved = SavedRobots(people)
        known = self.robots.before = self.saved.robots
        self.refusals = Refusals(self.broker, self.driving, self._robot)
        self.broker.is_named = self.media_connection.broker.is_named = self._is_named
        self.broker.is_known = lambda topic: "/".join(topic.split("/", 3)[:3]) in known
        self.media = MediaHub(self.media_connection, self.robots)
        self.sound = SoundHub(self.media_connection, self.robots, self._note_talk)
        self.open_components = OpenComponents(self.broker, self.robots, self.spawn)
        # What is drawn over the picture comes from there.
        self.sources = ChosenSources(people, self.robots, OwnHosts(settings), self.open_components.update)
        self.by_name = ByName(FLEET, lambda ref: ref in known or ref in self.open_components)
        self.robots.on_forget = self.by_name.forget
        self.driven_here = DrivenHere(server)
        self.gateways = Gateways()
        self.robot_audits = RobotAudits(
            self.broker,
            audit,
            known.__contains__,
            self.robots.components.__contains__,
            lambda ref: self._pace_of(ref).answer_s,
        )
        self.people_version = (0, 0, 0)
        self._stop_paces: dict[str, Pace] = {}  # by person
        self._tasks: set[asyncio.Task[None]] = set()

    async def open(self) -> None:
        """Connect to the broker and subscribe. Raises TransportError for settings that can never work."""
        self.broker.on_move(self._moved)
        await self.broker.open()
        self.broker.on_state(self._show_broker)
        self.broker.on_state(self.driving.renew_key)
        self._show_broker()
        for channel in (*FLEET, *SYNONYMS):
            deferred = channel is ONLINE or channel in SYNONYMS
            await self.broker.subscribe(channel.filter("+/+/+"), self.receive, deferred=deferred)
        await self.broker.subscribe(AUDIT.filter("+/+/+"), self.robot_audits.receive, deferred=True)
        await self.broker.subscribe(DRIVING.filter("+/+/+"), self._announced)
        await self.broker.subscribe(ONLINE.filter(f"+/{GATEWAYS}/+"), self._gateway, deferred=True)
        self.spawn(self._tick())
        if self.settings.login:
            self.spawn(self._watch_people())
        self.spawn(self.broker.ask(self.by_name))

    async def close(self) -> None:
        """Stop what pages move, then disconnect."""
        try:
            for lease in list(self.driving.leases.values()):
                self.closed(lease.tab)
            for task in list(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
        finally:
            await asyncio.gather(self.media.close(), self.sound.close())
            await asyncio.gather(self.media_connection.close(), self.broker.close())

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Run it until it ends or the server does."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # -- from the broker

    def receive(self, message: Message, now: float) -> None:
        address = parse_topic(message.topic)
        if address is None:
            return
        ref = address.identity.base
        self.robots.receive(message, now)
        self._send(self.stops.receive(message, clock()))
        if address.metric in (ONLINE.metric, LINK.metric) or ref in self.robots.components:
            self.by_name.receive(message, now)  # what found no place is asked for
        if ref not in self.robots.components:
            return
        if address.metric != ONLINE.metric or self.robots.value(ref, _ESTOP_METRIC) is None:
            self.stops.changed.add(ref)
        if channel_of(f"outgoing/{address.metric}") in (CAPABILITIES, CONTROL_STATE):
            self.publish(self.controls.update(ref, clock(), _epoch_ms()))
        if address.metric == CAPABILITIES.metric:
            for one in (ref, *(page for page, source in self.robots.sources.items() if source == ref)):
                self.open_components.update(one)

    def _moved(self, ref: str, host: str, first: bool) -> None:
        """The robot is at another broker: what moves it has an end there, and begins anew."""
        self.publish(self.driving.interrupt(ref, clock()))
        if host:
            self.robots.set_server_metric(ref, "web/host", m.HostView(host=host, first=first))

    def _gateway(self, message: Message, _now: float) -> None:
        """A gateway tells which components it receives at its hub; nothing once it has gone."""
        address = parse_topic(message.topic)
        if address is None:
            return
        changed = self.gateways.receive(address.identity.id, message.payload, self.robots.components)
        for ref, names in changed.items():
            self.robots.set_server_metric(ref, "web/gateways", m.GatewaysView(names=names))

    def _announced(self, message: Message, _now: float) -> None:
        """Another server drives robots."""
        announced = self.driven_here.receive(message)
        if announced is not None:
            server, robots = announced
            robots = {ref: one for ref, one in robots.items() if not self.keeps_control(ref)}
            self.publish(self.driving.announced(server, robots, clock()))

    def _show_broker(self) -> None:
        view = m.BrokerView(
            connected=self.broker.connected, problem=self.broker.problem, robots_omitted=self.robots.omitted
        )
        self.robots.set_server_metric("", "web/broker", view)

    # -- to the broker

    def publish(self, commands: list[Command], by: str = "") -> bool:
        """Publish drive commands of a person, each to the robot's own topic; False if one was not accepted."""
        accepted = True
        for ref, drive, qos in commands:
            topic = self.robots.topic(ref, "drive", "topic", DRIVE)
            accepted = self.broker.publish(topic, codec.encode(DRIVE, drive), qos=qos, by=by) and accepted
        self._show_drivers()
        return accepted

    def _send(self, messages: list[Message]) -> None:
        send(self.broker.publish, messages)

    def _has_sent(self) -> bool:
        """Whether little waits to be sent. To repeat the stop of a thousand robots before would only delay its end."""
        return self.broker.transport.outgoing.waiting < _MANY_WAIT

    def stop(self, ref: str, name: str, session: Session, device: str, why: str, address: str = "") -> None:
        """An emergency stop of one component, or of all (""): sent at once, and repeated until it is confirmed."""
        by = f"{session.user} on {device}" if device else session.user
        if ref and not _is_base(ref):
            return
        known, before = [one.robot for one in self.robots.components.values()], tuple(self.saved.robots)
        self._send(
            self.stops.press(ref, name, by=by, why=why, now=clock(), known=known, before=before, user=session.user)
        )
        self.show_stops()
        self.audit.write("stop", ref=ref or "all", user=session.user, device=device, address=address, detail=why)

    def stop_waits_s(self, user: str) -> float:
        """How long a stop of this person waits that comes without a control socket, as it would on one."""
        pace = self._stop_paces.setdefault(user, Pace(time.monotonic()))
        return min(pace.take(1, time.monotonic()), STOP_WAITS_S)

    # -- control

    def keeps_control(self, ref: str) -> bool:
        """Whether that robot decides itself who drives it; of others, the servers announce it to each other."""
        robot = self._robot(ref)
        return robot is not None and robot.controlled

    def take(
        self, tab: Tab, robot: RobotView, granted: Callable[[], None], failed: Callable[[str], None], *, over: bool
    ) -> None:
        """A page wants control; ``granted``, or ``failed`` with the reason, is called as soon as that is known."""
        ref, now = robot.base, clock()
        if why := self.refusals.nameless(robot):
            failed(why)
            return
        if robot.controlled:
            why = self.controls.ask(tab, robot, now, granted, failed, over=over)
            self.send_control()
        else:
            commands, why = self.driving.take(tab, ref, now, _epoch_ms(), over=over)
            self.publish(commands)
            if not why:
                granted()
        if why:
            failed(why)

    def release(self, tab: Tab, ref: str) -> bool:
        """A page gives control back, or does not ask for it any more; whether it had it."""
        lease = self.driving.leases.get(ref)
        self.publish(self.driving.release(tab, ref, clock()))
        self.controls.withdraw(tab, ref)
        self.send_control()
        return lease is not None and lease.tab is tab

    def restore(self, token: str, tab: Tab, granted: Callable[[], None], failed: Callable[[str], None]) -> None:
        """A page has connected again."""
        commands, ref = self.driving.restore(token, tab, clock())
        self.publish(commands)
        if ref and (robot := self._robot(ref)) is not None:
            self.take(tab, robot, granted, failed, over=False)

    def closed(self, tab: Tab, *, for_good: bool = False) -> None:
        """The connection of a page has ended; ``for_good``: its user may no longer drive."""
        end = self.driving.withdraw if for_good else self.driving.closed
        try:
            self.publish(end(tab, clock()))
        finally:
            self.controls.closed(tab)
            self.send_control()

    def send_control(self) -> None:
        """Publish what is due of control; after the zeros of who has had it."""
        step = self.controls.tick(clock(), _epoch_ms())
        self.publish(step.commands)
        self._send(step.messages)

    def _robot(self, ref: str) -> RobotView | None:
        component = self.robots.components.get(ref)
        return None if component is None else component.robot

    def _pace_of(self, ref: str) -> LinkPace:
        robot = self._robot(ref)
        return WIDE if robot is None else robot.pace

    def level(self, ref: str) -> SecurityLevel:
        """How strictly that robot checks names, as far as it tells; of others it is as in the server's config."""
        robot = self._robot(ref)
        if robot is None or not robot.estop.has_capabilities:
            return self.settings.level
        return "named" if robot.named else "open"

    def _is_named(self, ref: str) -> bool:
        robot = self._robot(ref)
        return robot is not None and robot.named

    def _note_talk(self, ref: str, session: Session, device: str, address: str) -> None:
        self.audit.write("talk", ref=ref, user=session.user, device=device, address=address)

    # -- what is open

    def watch(self, ref: str) -> None:
        """A page has opened this component."""
        if _is_base(ref):
            self.open_components.open(ref)
            self.sources.show(ref)

    def unwatch(self, ref: str) -> None:
        if _is_base(ref):
            self.open_components.close(ref)

    # -- what is due

    async def _tick(self) -> None:
        refresh_at = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            with _logged():
                self.broker.deliver()
                now = clock()
                self.publish(self.driving.tick(now))
                self.send_control()
                self._send(self.stops.tick(now))
                self.show_stops()
                if now >= refresh_at:
                    refresh_at = now + _REFRESH_S
                    self.robots.refresh(time.monotonic())
                    self._show_broker()
                    self._remember_robots()
                    self.robot_audits.tick(now)
                self._announce(now)

    async def _watch_people(self) -> None:
        """A person who is removed is out soon, though each page looks after its session rarely."""
        while True:
            with suppress(DatabaseError):  # which the looks at sessions report
                self.people_version = await asyncio.to_thread(self.people.version)
            await asyncio.sleep(PEOPLE_S)

    def operated(self, ref: str) -> None:
        """A person drives this robot from here."""
        self.saved.robots.operated(ref, int(time.time() // _DAY_S))

    def _remember_robots(self) -> None:
        for component in self.robots.components.values():
            self.saved.robots.seen(component.robot, component.rank, int(time.time() // _DAY_S))
        if (saving := self.saved.save()) is not None:
            self.spawn(saving)

    def _announce(self, now: float) -> None:
        leases = {ref: one for ref, one in self.driving.leases.items() if one.control is None}
        for message in self.driven_here.tick(leases, now, _epoch_ms()):
            self.broker.publish(message.topic, message.payload)

    def show_stops(self) -> None:
        """Let pages see what has changed of emergency stops."""
        changed, self.stops.changed = self.stops.changed, set()
        for ref in changed:
            component = self.robots.components.get(ref)
            if component is not None:
                self.robots.set_server_metric(ref, _ESTOP_METRIC, self.stops.view(component.robot.estop))

    def _show_drivers(self) -> None:
        changed, self.driving.changed = self.driving.changed, set()
        self.driven_here.changed |= changed
        for interest in self.robots.interests if changed else ():
            interest.dirty |= {(ref, "web/driver") for ref in changed}
            interest.notify()


def _epoch_ms() -> int:
    return int(1000 * time.time())


def _is_base(ref: str) -> bool:
    levels = ref.split("/")
    if len(levels) != 3:
        return False
    with suppress(ConfigError):
        return Identity(*levels).base == ref
    return False


class _logged:  # noqa: N801 - used like a function
    """One faulty round must not end all later ones, on which the end of silent gestures depends."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _tb: object) -> bool:
        if isinstance(error, Exception):
            log.error("a round of the server failed", exc_info=error)
            return True
        return False


def encode(message: m.ToPage) -> str:
    """The text that a page receives."""
    return msgspec.json.encode(message).decode()
