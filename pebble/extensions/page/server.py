"""The state of one server: messages from the broker, requests of pages, and tasks that are due."""

import asyncio
import logging
import time
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any

import msgspec
from msgspec.structs import replace

from pebble.config.security import SecurityLevel
from pebble.contract import CAPABILITIES, CONTROL_STATE, ONLINE, channel_of
from pebble.contract.identity import Identity, parse_topic
from pebble.errors import ConfigError
from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.database import DatabaseError
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Session
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.connection import in_small_segments
from pebble.extensions.operator.client.drive_reasons import person
from pebble.extensions.operator.client.estop import send
from pebble.extensions.operator.client.heartbeats import Heartbeats
from pebble.extensions.operator.client.robot_topics import FLEET, SYNONYMS
from pebble.extensions.page import messages as m
from pebble.extensions.page.drive.drivers import Drivers
from pebble.extensions.page.media.pictures import MediaHub
from pebble.extensions.page.media.sound import SoundHub
from pebble.extensions.page.open_components import OpenComponents
from pebble.extensions.page.robots import Robots
from pebble.extensions.page.setting import WebSettings
from pebble.extensions.page.silent_boards import SilentBoards
from pebble.extensions.page.stops import Stops
from pebble.extensions.thin.expander import ANNOUNCE_S, Expander
from pebble.transports import Message, MqttSettings, QoS, Subscription
from pebble.transports.clock import since_boot as clock

log = logging.getLogger(__name__)

TICK_S = 0.05
PEOPLE_S = 0.5  # between two looks at whether people or sessions were changed
_REFRESH_S = 0.25
_MANY_WAIT = 16 * 1024  # bytes that the broker has not confirmed
_ESTOP_METRIC = "web/estop"
_PICTURE = "picture-from "  # begins the key of a setting in the people's database; the component follows


class Server:
    """The whole state of one server. Used on one event loop."""

    def __init__(self, settings: WebSettings, people: People, audit: Audit) -> None:
        self.settings, self.people, self.audit = settings, people, audit
        # The second one only publishes stops: no message that is received delays them.
        self.broker, self.stop_broker = (
            Broker(in_small_segments(settings.broker), name) for name in ("pebble-web", "pebble-web-stops")
        )
        self.robots, self.stops = Robots(), Stops(self._may_repeat_stops)
        self.drivers = Drivers(self.broker, self.robots)
        self.media = Broker(settings.broker, "pebble-web-media")  # what it carries holds up no command
        self.pictures = MediaHub(self.media, self.robots)
        self.sound = SoundHub(self.media, self.robots, self._note_talk)
        for broker in (self.broker, self.stop_broker, self.media):
            broker.is_named = self._is_named
        self._heartbeats: Heartbeats | None = None  # while a stop of all goes to further robots
        self.open_components = OpenComponents(self.broker, self.robots, self.spawn)
        self.boards = SilentBoards(self.broker, self.robots, self.drivers, people, settings)
        self.drivers.refusals.is_stopping = self.stops.holds
        # The table of robots is bounded, and does not know what is open, driven or stopped.
        self.robots.is_wanted = self._is_wanted
        self.robots.is_kept = lambda ref: self._is_wanted(ref) or self.stops.sends_to(ref)
        self.robots.on_forget = self._ask_anew
        self._fleet_subscriptions: list[Subscription] = []  # for the messages of all components
        self.people_version = (0, 0)  # changes with people and sessions
        self._tasks: set[asyncio.Task[None]] = set()

    async def open(self) -> None:
        """Connect to the broker and subscribe. Raises TransportError for settings that can never work."""
        await asyncio.gather(self.broker.open(), self.stop_broker.open(), self.media.open())
        self.broker.on_state(self._show_broker)
        self.broker.on_state(self.drivers.renew_keys)
        self._show_broker()
        if self.settings.say is not None:
            self.broker.report(self.settings.say)
        for channel in (*FLEET, *SYNONYMS):
            filter_, is_heartbeat = channel.filter("+/+/+"), channel is ONLINE or channel in SYNONYMS
            # Heartbeats are so many that they do not wake the event loop: they wait for _tick.
            subscription = await self.broker.subscribe(filter_, self.receive, deferred=is_heartbeat)
            self._fleet_subscriptions.append(subscription)
        self.spawn(self._tick())
        if self.settings.expand:
            self.spawn(expand(self.settings.broker))
        if self.settings.login:
            self.spawn(self._watch_people())
        if self.settings.cameras_in_turn:
            self.spawn(self.pictures.look_in_turn())

    async def close(self) -> None:
        """Stop the motion that pages cause, then disconnect."""
        try:
            self.drivers.closed_all()  # as if all pages had closed
            for task in list(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
        finally:
            await asyncio.gather(self.pictures.close(), self.sound.close())
            if self._heartbeats is not None:
                await asyncio.to_thread(self._heartbeats.close)
            await asyncio.gather(self.media.close(), self.stop_broker.close(), self.broker.close())

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine until it ends or the server does."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # -- from the broker

    def receive(self, message: Message, now: float) -> None:
        """Handle a message of any component."""
        address = parse_topic(message.topic)
        if address is None:
            return
        ref = address.identity.base
        self.robots.receive(message, now)
        self._send(self.stops.receive(message, clock()))
        if ref not in self.robots.components:
            return
        # a heartbeat changes no stop: after one, pages need the stop's state only if they have none of it yet
        if address.metric != ONLINE.metric or self.robots.value(ref, _ESTOP_METRIC) is None:
            self.stops.changed.add(ref)
        if channel_of(f"outgoing/{address.metric}") in (CAPABILITIES, CONTROL_STATE):
            self.drivers.updated(ref)
        if address.metric == CAPABILITIES.metric:
            self.open_components.update(ref)
            for shown, source in list(self.robots.sources.items()):
                if source == ref:  # where ``shown`` is open, pages show the picture of ``ref``, with its overlays
                    self.open_components.update(shown)

    def _ask_anew(self, _ref: str) -> None:
        """Subscribe again to get this robot's retained messages once more."""
        for subscription in self._fleet_subscriptions:
            subscription.renew()

    def _show_broker(self) -> None:
        view = m.BrokerView(
            connected=self.broker.connected,
            problem=self.broker.problem,
            not_received=self.broker.not_received,
            robots_omitted=self.robots.omitted,
            stops_omitted=self.stops.omitted(clock()),
        )
        self.robots.set_server_metric("", "web/broker", view)

    # -- to the broker

    def _send(self, messages: list[Message]) -> None:
        """Publish messages of stops, on a connection that receives nothing, and therefore is not delayed."""
        send(self._publish_stop, messages)

    def _publish_stop(self, topic: str, payload: bytes, *, qos: QoS) -> bool:
        """Publish on the stops' own connection or, if that does not accept the message, on the general one."""
        return self.stop_broker.publish(topic, payload, qos=qos) or self.broker.publish(topic, payload, qos=qos)

    def _stop_by_heartbeats(self, now: float) -> None:
        """During a stop of all, also stop robots that Heartbeats finds, a connection that receives nothing else."""
        if self._heartbeats is None:
            if self.stops.collecting:
                self._heartbeats = Heartbeats(in_small_segments(self.settings.broker))
            return
        for message in self._heartbeats.take():
            self._send(self.stops.receive(message, now))
        if not self.stops.collecting:
            heartbeats, self._heartbeats = self._heartbeats, None
            self.spawn(asyncio.to_thread(heartbeats.close))

    def _may_repeat_stops(self) -> bool:
        """True if few messages of stops wait to be sent.

        While many wait, repeating those of a thousand robots would only delay them.
        """
        return self.stop_broker.transport.outgoing.waiting < _MANY_WAIT

    def stop(self, ref: str, name: str, session: Session, device: str, why: str, address: str = "") -> None:
        """Stop one component, or all (""): at once, and repeatedly until it is confirmed. ``name``: the stop's."""
        by = f"{session.user} on {device}" if device else session.user
        if ref and not _is_base(ref):
            return
        robots = [component.robot for component in self.robots.components.values()]
        self._send(self.stops.press(ref, name, by=by, why=why, now=clock(), known=robots, user=session.user))
        self.show_stops()
        self.audit.write("stop", ref=ref or "all", user=session.user, device=device, address=address, detail=why)

    def _is_wanted(self, ref: str) -> bool:
        """True if a page has the component open, drives it, or has stopped it."""
        return ref in self.open_components or self.drivers.drives(ref) or self.stops.has_stop_of(ref)

    # -- names

    def level(self, ref: str) -> SecurityLevel:
        """Return the security level of that robot: as it publishes, or else by the server's config."""
        robot = self.robots.view(ref)
        if robot is None or not robot.estop.has_capabilities:
            return self.settings.level
        return "named" if robot.named else "open"

    def _is_named(self, ref: str) -> bool:
        robot = self.robots.view(ref)
        return robot is not None and robot.named

    def _note_talk(self, ref: str, session: Session, device: str, address: str) -> None:
        self.audit.write("talk", ref=ref, user=session.user, device=device, address=address)

    # -- what is open

    def watch(self, ref: str) -> None:
        """Note that a page has opened this component."""
        if _is_base(ref):
            self.open_components.open(ref)
            self._show_source(ref)

    def unwatch(self, ref: str) -> None:
        if _is_base(ref):
            self.open_components.close(ref)

    def choose_picture(self, ref: str, source: str) -> None:
        """Show the picture of ``source`` on the page of ``ref``, for everybody, and store that; "" is its own."""
        if ref in self.robots.components and (not source or source in self.robots.components):
            self.people.set(_PICTURE + ref, "" if source == ref else source)
            self._show_source(ref)

    def _show_source(self, ref: str) -> None:
        """Send pages the chosen source of this component's picture, and the drawings over it."""
        try:
            source = self.people.get(_PICTURE + ref)
        except DatabaseError as error:
            log.warning("where the picture of %s comes from is not known: %s", ref, error)
            return
        self.robots.sources.pop(ref, None)
        if source:
            self.robots.sources[ref] = source
        self.open_components.update(ref)
        self.robots.set_server_metric(ref, "web/picture-from", m.PictureFrom(source=source))

    # -- what is due

    async def _tick(self) -> None:
        """Do what is due, twenty times a second."""
        refresh_at = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            try:
                self.broker.deliver()
                now = clock()
                self.drivers.tick(now)
                self._stop_by_heartbeats(now)
                self._send(self.stops.tick(now))
                self.show_stops()
                if now >= refresh_at:
                    refresh_at = now + _REFRESH_S
                    self.robots.refresh(time.monotonic())  # the clock of the messages' arrival
                    self.boards.refresh(time.monotonic(), self.spawn)
                    self._show_broker()
            except Exception:  # later rounds must follow: the end of silent gestures depends on them
                log.exception("a round of the server failed")

    async def _watch_people(self) -> None:
        """Notice removed people soon; a page itself checks its session only rarely."""
        while True:
            with suppress(DatabaseError):  # which the looks at sessions report
                self.people_version = await asyncio.to_thread(self.people.version)
            await asyncio.sleep(PEOPLE_S)

    def show_stops(self) -> None:
        """Show pages the changed states of emergency stops."""
        changed, self.stops.changed = self.stops.changed, set()
        for ref in changed:
            if (robot := self.robots.view(ref)) is not None:
                view = self.stops.view(robot.estop)
                by = person(view.by, login=self.settings.login)
                self.robots.set_server_metric(ref, _ESTOP_METRIC, replace(view, by=by))


async def expand(settings: MqttSettings) -> None:
    """Publish the streams of each group one by one, as `pebble topic expand` does, until this is cancelled."""
    broker = Broker(settings, "pebble-web-expander")
    expander = Expander(broker.transport)
    broker.is_named = expander.is_named
    await broker.open()
    try:
        await asyncio.to_thread(expander.start)
        while True:
            expander.announce()
            await asyncio.sleep(ANNOUNCE_S)
    finally:
        await broker.close()


def _is_base(ref: str) -> bool:
    """True if this is a valid base topic of a component."""
    levels = ref.split("/")
    if len(levels) != 3:
        return False
    with suppress(ConfigError):
        return Identity(*levels).base == ref
    return False


def encode(message: m.ToPage) -> str:
    """Return the JSON text of a message to a page."""
    return msgspec.json.encode(message).decode()
