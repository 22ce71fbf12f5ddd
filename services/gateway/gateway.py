"""The gateway as a program: it receives robots at a hub, agrees with other gateways at the broker, and carries robots.

What only its owner forwards passes by :class:`Carried`. A live emergency stop is forwarded by every gateway, in every
state, over a connection that is subscribed to nothing else: its name makes it count once. Heartbeats of gateways have
one of their own as well, and a thread: neither floods nor a robot whose begin takes long may cost it the others.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import msgspec

from pebble.contract import ESTOP, ONLINE, Kind
from pebble.contract.identity import GATEWAYS, parse_topic
from pebble.contract.names import with_name
from pebble.contract.payloads import GatewayHeartbeat
from pebble.forwarding.cycles import PROBE_PERIOD_S, Cycles, Finding
from pebble.forwarding.retained_window import INITIAL_SYNC_S
from pebble.forwarding.routing import Side
from pebble.forwarding.subjects import Subject
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.services.gateway.carried import Beginning, Carried
from pebble.services.gateway.heartbeats import OwnHeartbeats, PresentRobots
from pebble.services.gateway.ownership import MAX_ROBOTS, Ownership
from pebble.services.gateway.pace import MOST_STOPS, Pace, Senders
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.counters import Counters

log = logging.getLogger(__name__)

TICK_S = 0.1
BEGINNING_S = 0.1  # in one turn: taking many robots must not hold up the heartbeats
_STOP = Subject(Kind.COMMAND, ESTOP)
_ANY = f"+/{GATEWAYS}/+"

_decode = msgspec.json.Decoder(GatewayHeartbeat).decode


class Gateway:
    """``broker`` carries what is forwarded, as published, and has the :func:`will`; ``presence`` and ``stops`` are
    further connections to the same broker. The transports are not yet open. ``robots`` are filters of their bases.
    """

    def __init__(
        self,
        name: str,
        robots: Sequence[str],
        hub: Transport,
        broker: Transport,
        presence: Transport,
        stops: Transport,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.ownership = Ownership(name)
        self.counters = Counters()
        self._robots, self._clock = tuple(robots), clock
        self._hub, self._broker, self._presence, self._stop_way = hub, broker, presence, stops
        self._heartbeats, self._present = OwnHeartbeats(name, broker), PresentRobots()
        self._carried: dict[str, Carried] = {}
        self._beginning = Beginning()  # of the one that begins now
        self._synchronize: dict[str, float] = {}  # when what is retained of it has arrived
        self._stops, self._stop_pace = Cycles(clock), Pace(clock, MOST_STOPS)
        self._stop_senders = Senders(self._present, clock)
        self._quiet_log = RateLimitedLog(log, period_s=60.0)
        self._probed_at = float("-inf")
        self._states, self._publishing = threading.Lock(), threading.Lock()
        self._at_broker, self._at_hub = False, False
        self._wake = threading.Event()
        self._running = True

    @property
    def carries(self) -> frozenset[str]:
        return frozenset(self._carried)

    # -- the life of the program

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Run until :meth:`quit`."""
        self.open()
        ready()
        heartbeats = threading.Thread(target=self._publish_heartbeats, name="pebble-gateway heartbeats", daemon=True)
        heartbeats.start()
        try:
            while self._running:
                due = self.ownership.next_due(self._clock()) - self._clock()
                self._wake.wait(min(TICK_S, max(0.0, due)))
                self._wake.clear()
                self.tick()
        finally:
            self.close()

    def quit(self) -> None:
        """End :meth:`run` soon. Safe from any thread and from signal handlers."""
        self._running = False
        self._wake.set()

    def open(self) -> None:
        for transport in self._transports:
            transport.judge_topics(is_stop=_is_stop, may_leave=self._may_leave)
            transport.on_state(self._on_state)
        self._hub.judge_topics(is_invented=self._is_invented)
        self._broker.judge_topics(skips_retained=self._skips_retained, delivers_late=True)
        for transport in self._transports:
            transport.open(timeout=0.0)
        for base in self._robots:
            stop = ESTOP.topic(base)
            self._hub.subscribe(ONLINE.topic(base), self._on_robot, echo=False, direct=True)
            for topic in (stop, with_name(stop, "+")):
                self._stop_way.subscribe(topic, self._on_stop, direct=True)
        self._presence.subscribe(ONLINE.filter(_ANY), self._on_gateway, direct=True)

    def close(self) -> None:
        """Stop forwarding, and only then tell the others."""
        self.ownership.lost()
        for robot in list(self._carried):
            self._end(robot)
        for transport in reversed(self._transports):
            transport.close()

    @property
    def _transports(self) -> tuple[Transport, ...]:
        return self._hub, self._stop_way, self._presence, self._broker

    def publish_heartbeat(self) -> None:
        """Publish a heartbeat, if one is due."""
        with self._publishing:
            now = self._clock()
            if self._broker.state is State.CONNECTED and self._heartbeats.due(now, TICK_S):
                self._heartbeats.publish(self._present.robots(now) if self._hub.state is State.CONNECTED else (), now)

    def _publish_heartbeats(self) -> None:
        while self._running:
            self.publish_heartbeat()
            time.sleep(TICK_S)

    def tick(self) -> None:
        """A turn: heartbeat, who carries what, what is due."""
        self.publish_heartbeat()
        for stop in self._stop_pace.due():
            self._pass_stop(stop)
        for one in list(self._carried.values()):
            one.pass_waiting()
        now = self._clock()
        self.ownership.judge(now)
        held = self.ownership.held(now)
        for robot, one in list(self._carried.items()):
            if held.get(robot) != one.since:
                self._end(robot)
        self._begin({robot: since for robot, since in held.items() if robot not in self._carried})
        for robot, due in list(self._synchronize.items()):
            if self._clock() >= due:
                del self._synchronize[robot]
                if robot in self._carried:
                    self._carried[robot].synchronize()
        if now - self._probed_at >= PROBE_PERIOD_S:
            self._probed_at = now
            for one in self._carried.values():
                one.probe()

    def _begin(self, robots: Mapping[str, float]) -> None:
        end = self._clock() + BEGINNING_S
        for robot, since in robots.items():
            holds = partial(self._holds, robot, since)
            one = Carried(
                robot, since, self._hub, self._broker, holds, self._clock, self._report_flood, self._beginning
            )
            for transport in (self._hub, self._broker):
                transport.judge_topics(is_stop=_is_stop)  # of all robots, not of this one
            self._carried[robot] = one
            with self._beginning:
                begun = one.begin()
            if begun:
                self._synchronize[robot] = self._clock() + INITIAL_SYNC_S
                log.info("carries %s", robot)
            else:
                self._end(robot)
            if self._clock() >= end:
                self._wake.set()
                return

    def _end(self, robot: str) -> None:
        self._synchronize.pop(robot, None)
        self._carried.pop(robot).end()
        log.info("carries %s no more", robot)

    def _holds(self, robot: str, since: float) -> bool:
        return self.ownership.since(robot, self._clock()) == since

    # -- the transports' threads

    def _on_state(self, _state: State) -> None:
        """Two connections to the broker are needed: one carries, one shows whether the others hear this one."""
        with self._states:
            at_broker = all(one.state is State.CONNECTED for one in (self._broker, self._presence))
            if at_broker is not self._at_broker:
                self._at_broker = at_broker
                if at_broker:
                    self.ownership.connected(self._clock())
                else:
                    self.ownership.lost()
            at_hub = self._hub.state is State.CONNECTED
            if at_hub is not self._at_hub:
                self._at_hub = at_hub
                for robot, one in list(self._carried.items()):
                    one.hub_changed(self._hub.state)
                    self._synchronize[robot] = self._clock() + INITIAL_SYNC_S
        self._wake.set()

    def _on_robot(self, message: Message) -> None:
        address = parse_topic(message.topic)
        if not message.retain and message.payload and address is not None and not address.identity.is_server:
            self._present.note(address.identity.base, self._clock())

    def _on_gateway(self, message: Message) -> None:
        address, now = parse_topic(message.topic), self._clock()
        if address is None:
            return
        name = address.identity.id
        try:
            heartbeat = _decode(message.payload) if message.payload else None
        except msgspec.MsgspecError:
            self._quiet_log.warning(name[:40], "%s is no heartbeat of a gateway", message.topic[:200])
            return
        if name != self.ownership.me:
            if heartbeat is None:
                self.ownership.left(name, now)
            else:
                self.ownership.received(name, heartbeat.robots[:MAX_ROBOTS], now)
        elif heartbeat is None:  # the will of an earlier connection
            self._heartbeats.repeat()
        elif (sent := self._heartbeats.came_back(heartbeat)) is not None:
            self.ownership.came_back(*sent, now)
        elif not message.retain and self._heartbeats.yields_to(heartbeat, now):
            self._quiet_log.warning("rival", "another gateway is called %s: this one rests", self.ownership.me)
        self._wake.set()

    def _on_stop(self, message: Message) -> None:
        if message.retain:
            return
        if self._stop_pace.takes(message, self._stop_senders.key(message)):
            self._pass_stop(message)
        else:
            self._report_flood(message.topic)

    def _pass_stop(self, message: Message) -> None:
        if self._stops.examine(Side.REMOTE, _STOP, message) is not Finding.PASS:
            return
        self.counters.add("stops")
        self._hub.publish(message.topic, message.payload, qos=QoS.DELIVERED, urgent=True)

    def _report_flood(self, topic: str) -> None:
        self.counters.add("too_often")
        self._quiet_log.warning("flood", "more comes on %s than a gateway passes in a second", topic[:200])

    def _may_leave(self, topic: str) -> bool:
        """Whether it is a stop, or of a robot that is carried at this moment, or no robot's: a heartbeat."""
        address = parse_topic(topic)
        if _is_stop(topic) or address is None or address.identity.is_server:
            return True
        one = self._carried.get(address.identity.base)
        return one is not None and self._holds(one.base, one.since)

    def _is_invented(self, topic: str) -> bool:
        one = self._of(topic)
        return one is None or one.subjects.invented(topic.encode()) is not None

    def _skips_retained(self, topic: bytes) -> bool:
        one = self._of(topic.decode(errors="replace"))
        return one is not None and not topic.endswith(_STOP_END) and one.forwarder.skips_retained(Side.REMOTE, topic)

    def _of(self, topic: str) -> Carried | None:
        address = parse_topic(topic)
        return None if address is None else self._carried.get(address.identity.base)


_INCOMING = f"/{ESTOP.direction}/"
_STOP_END = f"/{ESTOP.metric}".encode()


def _is_stop(topic: str) -> bool:
    """Whether it is a stop, with the name of a sender or without."""
    return _INCOMING in topic and topic.endswith(f"/{ESTOP.metric}")
