"""Ties the parts of the server together: what arrives from the broker, what pages ask for, and what is due."""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
import time
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any

import msgspec

from pebble.client.broker import Broker
from pebble.client.estop import send
from pebble.client.page_settings import WebSettings
from pebble.client.robot_topics import FLEET, SYNONYMS, section_of
from pebble.contract import CAPABILITIES, DRIVE, DRIVING, ONLINE, codec
from pebble.contract.identity import Identity, parse_topic
from pebble.contract.payloads import Driver
from pebble.contract.payloads import Driving as DrivingPayload
from pebble.errors import ConfigError, PayloadError
from pebble.fleet.audit import Audit
from pebble.fleet.database import DatabaseError
from pebble.fleet.people import People
from pebble.fleet.roles import Session
from pebble.runtime.by_name import ByName
from pebble.transports import Message
from pebble.transports.clock import since_boot as clock
from pebble.web import messages as m
from pebble.web import robot_commands
from pebble.web.driving import Command, Driving
from pebble.web.known_robots import KnownRobots
from pebble.web.media.pictures import MediaHub
from pebble.web.media.robot_streams import OwnHosts, origin
from pebble.web.media.sound import SoundHub
from pebble.web.open_components import OpenComponents
from pebble.web.robots import Component, Robots
from pebble.web.stops import Stops

log = logging.getLogger(__name__)

TICK_S = 0.05
_REFRESH_S = 0.25
_ANNOUNCE_S = 1.0
_RESET_S = 0.6  # robots refuse whoever has not paused for 0.5 s after a reset
_ANNOUNCED = 64  # robots in one announcement
_ESTOP_METRIC = "web/estop"
_STREAM_ADDRESS = "stream-address "  # what a setting of the server begins with; then the component
_KNOWN = "known "  # the same
_DAY_S = 24 * 3600


class Server:
    """All state of one server. Everything runs on one event loop."""

    def __init__(self, settings: WebSettings, people: People, audit: Audit) -> None:
        self.settings, self.people, self.audit = settings, people, audit
        self.name = settings.server or socket.gethostname().partition(".")[0] or "server"
        self.id = f"{self.name}-{secrets.token_hex(2)}"
        self.broker = Broker(settings.broker)
        self.robots, self.stops, self.driving = Robots(), Stops(), Driving(self.id)
        self.known = KnownRobots(people.all(_KNOWN))
        self.robots.before = self.known
        self.own_hosts = OwnHosts(settings)
        self.broker.is_known = lambda topic: "/".join(topic.split("/", 3)[:3]) in self.known
        self.robots.streams.update(people.all(_STREAM_ADDRESS))
        self.media = MediaHub(self.broker, self.robots)
        self.sound = SoundHub(self.broker, self.robots, self._note_talk)
        self.open_components = OpenComponents(self.broker, self.robots, self.spawn)
        self.by_name = ByName(FLEET, lambda ref: ref in self.known or ref in self.open_components)
        self.drive_changed: set[str] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._saving = False
        self._announced_at = float("-inf")
        self._announcing: set[str] = set()  # systems of the robots in the last announcement

    async def open(self) -> None:
        """Connect to the broker and subscribe. Raises TransportError for settings that can never work."""
        await self.broker.open()
        self.broker.on_state(self._show_broker)
        self._show_broker()
        for channel in (*FLEET, *SYNONYMS):
            deferred = channel is ONLINE or channel in SYNONYMS
            await self.broker.subscribe(channel.filter("+/+/+"), self._receive, deferred=deferred)
        await self.broker.subscribe(DRIVING.filter("+/+/+"), self._announced)
        self.spawn(self._tick())
        self.spawn(self.broker.ask(self.by_name))

    async def close(self) -> None:
        """Stop what pages move, then disconnect."""
        try:
            for lease in list(self.driving.leases.values()):
                self.publish(self.driving.closed(lease.tab, clock()))
            for task in list(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
        finally:
            await asyncio.gather(self.media.close(), self.sound.close())
            await self.broker.close()

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Run it until it ends or the server does."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # -- from the broker

    def _receive(self, message: Message, now: float) -> None:
        address = parse_topic(message.topic)
        if address is None:
            return
        self.robots.receive(message, now)
        self.by_name.receive(message, now)
        ref = address.identity.base
        self._send(self.stops.receive(message, clock()))
        if ref not in self.robots.components:
            return
        if address.metric != ONLINE.metric or self.robots.value(ref, _ESTOP_METRIC) is None:
            self.stops.changed.add(ref)
            self._note_latch(ref)
        if address.metric == CAPABILITIES.metric:
            for one in (ref, *(page for page, source in self.robots.sources.items() if source == ref)):
                self.open_components.update(one)

    def _note_latch(self, ref: str) -> None:
        component = self.robots.components.get(ref)
        if component is not None:
            latched = bool(component.estop.latched)
            if component.was_latched and not latched:
                component.reset_at = clock()
            component.was_latched = latched

    def _announced(self, message: Message, _now: float) -> None:
        """Another server drives robots."""
        address = parse_topic(message.topic)
        if address is None or message.retain or address.identity.id == self.id:
            return
        try:
            payload = codec.decode(DRIVING, message.payload)
        except PayloadError:
            return
        robots = {ref: (one.by, one.device, one.since) for ref, one in payload.robots.items()}
        self.publish(self.driving.announced(address.identity.id, robots, clock()))

    def _show_broker(self) -> None:
        view = m.BrokerView(
            connected=self.broker.connected, problem=self.broker.problem, robots_omitted=self.robots.omitted
        )
        self.robots.set_server_metric("", "web/broker", view)

    # -- to the broker

    def publish(self, commands: list[Command]) -> bool:
        """Publish drive commands, each to the robot's own topic; False if one was not accepted."""
        accepted = True
        for ref, drive in commands:
            topic = self.robots.topic(ref, "drive", "topic", DRIVE)
            accepted = self.broker.publish(topic, codec.encode(DRIVE, drive)) and accepted
        self._show_drivers()
        return accepted

    def _send(self, messages: list[Message]) -> None:
        send(self.broker.publish, messages)

    def stop(self, ref: str, name: str, session: Session, device: str, why: str, address: str = "") -> None:
        """An emergency stop of one component, or of all (""): sent at once, and repeated until it is confirmed."""
        by = f"{session.user} on {device}" if device else session.user
        if ref and not _is_base(ref):
            return
        known, before = self.robots.components.values(), tuple(self.known)
        self._send(
            self.stops.press(ref, name, by=by, why=why, now=clock(), known=known, before=before, user=session.user)
        )
        self._show_stops()
        self.audit.write("stop", ref=ref or "all", user=session.user, device=device, address=address, detail=why)

    def blocked(self, ref: str) -> str:
        """Why this component may not be moved by any page; empty if it may."""
        component = self.robots.components.get(ref)
        if problem := self.broker.problem:
            return f"The server cannot reach the broker: {problem}"
        if component is None or not component.drives():
            return "This component does not drive"
        if component.estop.latched:
            return (
                f"Stopped by {component.estop.stopped_by.by or 'unknown'}" if component.estop.stopped_by else "Stopped"
            )
        if clock() - component.reset_at < _RESET_S:
            return "It was just reset: wait a moment"
        return "" if component.online(time.monotonic()) is not False else f"{component.name} is silent"

    def refuses(self, op: m.RobotOp) -> str:
        """Why this is not asked of a robot now; empty if it is. What ends something is always asked."""
        component = self.robots.components.get(op.ref)
        if component is None:
            return "unknown component"
        if robot_commands.ends(op):
            return "" if self.broker.connected else "The server cannot reach the broker"
        if problem := self.broker.problem:
            return f"The server cannot reach the broker: {problem}"
        if component.online(time.monotonic()) is False and not isinstance(op, m.FlagOp):  # the broker remembers flags
            return f"{component.name} is silent"
        why = robot_commands.refusal(op, component.capabilities)
        return self._script_refused(component) if isinstance(op, m.AutonomyOp) and not why else why

    def _script_refused(self, component: Component) -> str:
        """Why no script may begin now; empty if one may."""
        if component.online(time.monotonic()) is not True:
            return f"{component.name} has not been seen yet"
        if component.estop.latched:
            return "Stopped: reset it first"
        by = self.driving.moved_by(component.ref, clock())
        arbitrates = section_of(component.capabilities, "drive").get("arbitrates") is True
        return f"{by} is driving" if by and not arbitrates else ""

    def _note_talk(self, ref: str, session: Session, device: str, address: str) -> None:
        self.audit.write("talk", ref=ref, user=session.user, device=device, address=address)

    def picture_from(self, ref: str, source: str) -> None:
        """Show the picture of ``source`` on the page of ``ref``, for everybody; "" is its own."""
        if ref in self.robots.components and (not source or source in self.robots.components):
            self.people.set(f"picture-from {ref}", "" if source == ref else source)
            self._show_picture_from(ref)

    def _show_picture_from(self, ref: str) -> None:
        try:
            source = self.people.get(f"picture-from {ref}") or ""
        except DatabaseError as error:
            log.warning("where the picture of %s comes from is not known: %s", ref, error)
            return
        self.robots.sources.pop(ref, None)
        if source:
            self.robots.sources[ref] = source
        self.open_components.update(ref)  # what is drawn over the picture comes from there
        self.robots.set_server_metric(ref, "web/picture-from", m.PictureFrom(source=source))

    def stream_address(self, ref: str, url: str) -> str:
        """Offer the stream at ``url`` on the page of ``ref``, for everybody; "" is the one that it reports.

        Returns why not; empty if it is done.
        """
        if ref not in self.robots.components:
            return "unknown component"
        if url and not origin(url):
            return "No stream: an address begins with http:// or https://, and has no login"
        if url and not origin(url, self.own_hosts):
            return "No stream: the page can be opened by this name or address, and browsers would send its login there"
        self.people.set(_STREAM_ADDRESS + ref, url)
        self.robots.streams[ref] = url
        self._show_stream_address(ref)
        return ""

    def _show_stream_address(self, ref: str) -> None:
        self.robots.set_server_metric(ref, "web/stream-address", m.StreamAddress(url=self.robots.streams.get(ref, "")))

    # -- what is open

    def watch(self, ref: str) -> None:
        """A page has opened this component."""
        if _is_base(ref):
            self.open_components.open(ref)
            self._show_picture_from(ref)
            self._show_stream_address(ref)

    def unwatch(self, ref: str) -> None:
        """A page has closed it."""
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
                self._send(self.stops.tick(now))
                self._show_stops()
                if now >= refresh_at:
                    refresh_at = now + _REFRESH_S
                    self.robots.refresh(time.monotonic())
                    self._show_broker()
                    self._remember_robots()
                self._announce(now)

    def operated(self, ref: str) -> None:
        """A person drives this robot from here."""
        self.known.operated(ref, int(time.time() // _DAY_S))

    def _remember_robots(self) -> None:
        for component in self.robots.components.values():
            self.known.seen(component, int(time.time() // _DAY_S))
        if not self._saving and (changes := self.known.changes()):
            self._saving = True
            self.spawn(self._save(changes))

    async def _save(self, changes: dict[str, str | None]) -> None:
        """On a thread: another process may be writing to the file."""
        try:
            for ref, value in changes.items():
                await asyncio.to_thread(self.people.set, _KNOWN + ref, value)
        except DatabaseError as error:
            log.warning("which robots are known is not saved: %s", error)
        finally:
            self._saving = False

    def _announce(self, now: float) -> None:
        """Tell other servers once a second, and when a lease changes, which robots are driven from here."""
        if now - self._announced_at < _ANNOUNCE_S and not self.drive_changed:
            return
        self.drive_changed.clear()
        self._announced_at = now
        systems: dict[str, dict[str, Driver]] = {system: {} for system in self._announcing}
        for ref, lease in list(self.driving.leases.items())[:_ANNOUNCED]:
            one = Driver(by=lease.tab.user, device=lease.tab.device, since=lease.since_ms)
            systems.setdefault(ref.partition("/")[0], {})[ref] = one
        self._announcing = {system for system, robots in systems.items() if robots}  # the others: once more, empty
        for system, robots in systems.items():
            payload = DrivingPayload(t=int(1000 * time.time()), robots=robots)
            self.broker.publish(
                DRIVING.topic(Identity(system, "servers", self.id).base), codec.encode(DRIVING, payload)
            )

    def _show_stops(self) -> None:
        changed, self.stops.changed = self.stops.changed, set()
        for ref in changed:
            component = self.robots.components.get(ref)
            if component is not None:
                self.robots.set_server_metric(ref, _ESTOP_METRIC, self.stops.view(component.estop))

    def _show_drivers(self) -> None:
        changed, self.driving.changed = self.driving.changed, set()
        self.drive_changed |= changed
        for interest in self.robots.interests if changed else ():
            interest.dirty |= {(ref, "web/driver") for ref in changed}
            interest.notify()


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
