"""The gateway as a program: it receives robots at a hub, agrees with other gateways at the broker, and carries robots.

Where boards are, the broker of a LAN takes the place of the hub.

What only its owner forwards passes by :class:`Carried`. A live emergency stop is forwarded by every gateway, in every
state, over a connection that is subscribed to nothing else: its name makes it count once. Heartbeats of gateways have
one of their own as well, and a thread: neither floods nor a robot whose begin takes long may cost it the others.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence

import msgspec

from pebble.contract import ESTOP, ONLINE, Kind
from pebble.contract.identity import GATEWAYS, parse_topic
from pebble.contract.names import with_name
from pebble.contract.payloads import GatewayHeartbeat
from pebble.forwarding.cycles import Cycles, Finding
from pebble.forwarding.routing import Side
from pebble.forwarding.subjects import Subject
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.services.gateway.carried import Carried
from pebble.services.gateway.carried_robots import CarriedRobots, is_stop
from pebble.services.gateway.connections import Connections
from pebble.services.gateway.heartbeats import OwnHeartbeats, PresentRobots
from pebble.services.gateway.ownership import MAX_ROBOTS, Ownership
from pebble.services.gateway.pace import MOST_STOPS, Pace, Senders
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.counters import Counters

log = logging.getLogger(__name__)

TICK_S = 0.1
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
        self._connections = Connections(hub, broker, presence, stops)
        self._heartbeats, self._present = OwnHeartbeats(name, broker), PresentRobots()
        self._carried = CarriedRobots(self._connections, self.ownership, self._report_flood, clock)
        self._stops, self._stop_pace = Cycles(clock), Pace(clock, MOST_STOPS)
        self._stop_senders = Senders(self._present, clock)
        self._quiet_log = RateLimitedLog(log, period_s=60.0)
        self._wake, self._heartbeat_due = threading.Event(), threading.Event()
        self._running = True

    @property
    def carries(self) -> frozenset[str]:
        return self._carried.bases

    def carried(self, base: str) -> Carried | None:
        """What carries that robot now."""
        return self._carried.of(ONLINE.topic(base))

    # -- the life of the program

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Run until :meth:`quit`.

        Heartbeats have a thread of their own: who begins to carry a robot waits for hub and broker, and one that sends
        none meanwhile would be taken for dead, by itself too. Where turns do not end any more it is.
        """
        self.open()
        ready()
        heartbeats = threading.Thread(target=self._publish_heartbeats, name="heartbeats", daemon=True)
        heartbeats.start()
        try:
            while self._running:
                due = self.ownership.next_due(self._clock()) - self._clock()
                self._wake.wait(min(TICK_S, max(0.0, due)))
                self._wake.clear()
                self.tick()
        finally:
            self.quit()
            heartbeats.join()
            self.close()

    def quit(self) -> None:
        """End :meth:`run` soon. Safe from any thread."""
        self._running = False
        self._wake.set()
        self._heartbeat_due.set()

    def open(self) -> None:
        hub, broker = self._connections.hub, self._connections.broker
        for transport in self._connections:
            transport.judge_topics(is_stop=is_stop, may_leave=self._may_leave)
            transport.on_state(self._on_state)
        hub.judge_topics(is_invented=self._is_invented)
        broker.judge_topics(skips_retained=self._skips_retained, delivers_late=True)
        for transport in self._connections:
            transport.open(timeout=0.0)
        for base in self._robots:
            stop = ESTOP.topic(base)
            hub.subscribe(ONLINE.topic(base), self._on_robot, echo=False, direct=True)
            for topic in (stop, with_name(stop, "+")):
                self._connections.stops.subscribe(topic, self._on_stop, direct=True)
        self._connections.presence.subscribe(ONLINE.filter(_ANY), self._on_gateway, direct=True)

    def close(self) -> None:
        """Stop forwarding, and only then tell the others."""
        self.ownership.lost()
        self._carried.follow({})
        for transport in reversed([*self._connections]):
            transport.close()

    def publish_heartbeat(self) -> None:
        """Publish a heartbeat if one is due, unless this gateway does not do its work."""
        now = self._clock()
        if self._carried.stands:
            self._quiet_log.log("stands", logging.ERROR, "no turn ends any more: others have to carry the robots")
            return
        at_broker = self._connections.broker.state is State.CONNECTED
        if at_broker and self._heartbeats.due(now, TICK_S):
            self._heartbeats.publish(self._present.robots(now) if self._connections.at_hub else (), now)

    def _publish_heartbeats(self) -> None:
        try:
            while self._running:
                self.publish_heartbeat()
                self._heartbeat_due.wait(TICK_S)
                self._heartbeat_due.clear()
        finally:
            self.quit()

    def tick(self) -> None:
        """A turn: what waited for this second, who carries what, what is due."""
        for stop in self._stop_pace.due():
            self._pass_stop(stop)
        self._carried.pass_waiting()
        now = self._clock()
        self.ownership.judge(now)
        if not self._carried.follow(self.ownership.held(now)):
            self._wake.set()
        self._carried.tick(now)

    # -- the transports' threads

    def _on_state(self, _state: State) -> None:
        self._connections.look(self._on_broker, self._carried.hub_changed)
        self._wake.set()

    def _on_broker(self, connected: bool) -> None:
        if connected:
            self.ownership.connected(self._clock())
        else:
            self.ownership.lost()

    def _on_robot(self, message: Message) -> None:
        address = parse_topic(message.topic)
        if not message.payload or address is None or address.identity.is_server:
            return
        if not message.retain:
            self._present.note(address.identity.base, self._clock())
        elif self._connections.hub.as_published:
            self._present.note_copy(address.identity.base, message.payload, self._clock())

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
            self._heartbeat_due.set()
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
        self._connections.hub.publish(message.topic, message.payload, qos=QoS.DELIVERED, urgent=True)

    def _report_flood(self, topic: str) -> None:
        self.counters.add("too_often")
        self._quiet_log.warning("flood", "more comes on %s than a gateway passes in a second", topic[:200])

    def _may_leave(self, topic: str) -> bool:
        """Whether it is a stop, or of a robot that is carried at this moment, or no robot's: a heartbeat."""
        address = parse_topic(topic)
        if is_stop(topic) or address is None or address.identity.is_server:
            return True
        return self._carried.may_leave(address.identity.base)

    def _is_invented(self, topic: str) -> bool:
        one = self._carried.of(topic)
        return one is None or one.subjects.invented(topic.encode()) is not None

    def _skips_retained(self, topic: bytes) -> bool:
        one = self._carried.of(topic.decode(errors="replace"))
        return one is not None and not topic.endswith(_STOP_END) and one.forwarder.skips_retained(Side.REMOTE, topic)


_STOP_END = f"/{ESTOP.metric}".encode()
