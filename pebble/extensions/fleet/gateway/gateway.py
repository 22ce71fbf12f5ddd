"""The gateway as a program: it carries the robots that it hears at a hub to an MQTT broker, and their commands back.

Boards cannot speak Zenoh: for them, a broker of their LAN takes the place of the hub. There is one gateway for a LAN; a
second one does not start. A live emergency stop has a connection of its own, which is subscribed to nothing else, and
passes for every robot, heard or not. Only while that connection is away, the robot's forwarder passes it as well.
"""

import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import msgspec

from pebble.contract import ESTOP, ONLINE, Kind
from pebble.contract.identity import GATEWAYS, Identity, parse_topic
from pebble.contract.names import with_name
from pebble.contract.payloads import GatewayHeartbeat
from pebble.errors import PebbleError
from pebble.extensions.fleet.gateway.carried_robot import Beginning, CarriedRobot, begin
from pebble.forwarding.cycles import Cycles, Finding
from pebble.forwarding.routing import Side
from pebble.forwarding.subjects import Subject
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports import Message, QoS, State, Transport

log = logging.getLogger(__name__)

TICK_S = 0.1
HEARTBEAT_S = 0.5
FRESH_S = 1.25  # so long a heartbeat of another gateway counts; and so long a gateway listens before it begins
MAX_GATEWAYS = 16  # that are known beside this one
MAX_ROBOTS = 1000  # that one gateway carries; further ones with a warning
SILENT_S = 30.0  # without a heartbeat a robot is carried so long: three periods of the slowest heartbeats
#: Robots that begin in one turn: they wait together for hub and broker. What moves is taken for old while a turn lasts
#: longer than Beginning.LONG_S.
TOGETHER = 8
_STOP = Subject(Kind.COMMAND, ESTOP)
_STOP_END = f"/{ESTOP.metric}"

_decode, _encode = msgspec.json.Decoder(GatewayHeartbeat).decode, msgspec.json.encode


def will(name: str) -> Message:
    """Return the will, by which other gateways learn that this one is gone."""
    return Message(ONLINE.topic(Identity("pebble", GATEWAYS, name).base), b"", QoS.DELIVERED, True)


def is_stop(topic: str) -> bool:
    """True if the message is a stop, with an account's name in its topic or without."""
    return f"/{ESTOP.direction}/" in topic and topic.endswith(_STOP_END)


@dataclass(frozen=True, slots=True)
class _Other:
    heard_at: float
    run: str
    robots: frozenset[str]


class OtherGateways:
    """The newest heartbeat of each other gateway at the same broker, so that no robot is carried twice.

    ``run`` identifies this gateway: if two carry the same robot, the greater ``run`` continues. Two that begin at the
    same moment both carry it until they hear each other.
    """

    def __init__(self, run: str) -> None:
        self.run = run
        self._others: dict[str, _Other] = {}

    def forget(self) -> None:
        """Forget all gateways, because the connection on which they were heard is lost."""
        self._others.clear()

    def left(self, name: str) -> None:
        """Note that a gateway is gone: it left in order, or its will was published."""
        self._others.pop(name, None)

    def heard(self, name: str, run: str, robots: tuple[str, ...], now: float) -> None:
        """Note a live heartbeat of any gateway."""
        if run == self.run:
            return
        others = self._others.copy()  # another thread may change the table
        if name not in others and len(others) >= MAX_GATEWAYS:
            oldest = min(others, key=lambda other: others[other].heard_at)
            self._others.pop(oldest, None)
        self._others[name] = _Other(now, run, frozenset(robots))

    def carrier(self, robot: str, now: float, *, carried: bool) -> str:
        """Return the other gateway that carries ``robot``; empty if none does. ``carried``: this one carries it too."""
        for name, other in list(self._others.items()):
            is_carrier = now - other.heard_at <= FRESH_S and robot in other.robots
            if is_carrier and (not carried or other.run > self.run):
                return name
        return ""


class Gateway:
    """A forwarder for all robots whose base topics match ``robots``. Its transports are not yet open.

    ``broker`` carries forwarded messages, as they were published; ``presence``, with the :func:`will`, and ``stops``
    are more connections to the same broker.
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
        self._name, self._filters, self._clock = name, tuple(robots), clock
        self._hub, self._broker, self._presence, self._stops = hub, broker, presence, stops
        self._others = OtherGateways(secrets.token_hex(4))
        self._listens_since = float("inf")  # for other gateways
        self._published_at = float("-inf")  # the newest heartbeat of this gateway
        self._heard: dict[str, float] = {}  # by robot: when its newest heartbeat came
        self._first: dict[str, bytes] = {}  # by robot: its first heartbeat, which may be a retained one
        self._carried: dict[str, CarriedRobot] = {}
        self._has_begun = False
        self._beginning = Beginning()  # measures each start of forwarding: commands wait at the broker meanwhile
        self._stop_cycles = Cycles(clock)
        self._quiet_log = RateLimitedLog(log, period_s=60.0)
        self._lost = threading.Event()  # a connection was lost: begin again with every robot
        self._wake = threading.Event()  # do the next round now
        self._running = True

    @property
    def carries(self) -> frozenset[str]:
        return frozenset(self._carried)

    # -- the life of the program

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Run until :meth:`quit`. Raises PebbleError if another gateway carries its robots at the start."""
        try:
            self.open()
            ready()
            while self._running:
                self._wake.wait(TICK_S)
                self._wake.clear()
                self.tick()
        finally:
            self.close()

    def quit(self) -> None:
        """End :meth:`run` soon. Safe from any thread."""
        self._running = False
        self._wake.set()

    def open(self) -> None:
        """Open the connections with their rules about topics, and subscribe to stops, robots and other gateways."""
        for transport in (self._hub, self._stops, self._presence, self._broker):
            transport.policy.is_stop = is_stop
            transport.on_state(self._on_state)
        self._presence.on_state(self._on_presence)
        # For these rules see TopicPolicy. `delivers_late`: a robot's forwarder decides which of two values counts.
        self._hub.policy.is_invented = self._is_invented
        self._broker.policy.skips_retained, self._broker.policy.delivers_late = self._skips_retained, True
        for transport in (self._hub, self._stops, self._presence, self._broker):
            transport.open(timeout=0.0)
        for base in self._filters:
            stop = ESTOP.topic(base)
            for topic in (stop, with_name(stop, "+")):
                self._stops.subscribe(topic, self._on_stop, direct=True)
            self._hub.subscribe(ONLINE.topic(base), self._on_robot, echo=False, direct=True)
        self._presence.subscribe(ONLINE.filter(f"+/{GATEWAYS}/+"), self._on_gateway, direct=True)

    def close(self) -> None:
        """Stop forwarding, then publish that this gateway is gone."""
        self._end(self.carries)
        for transport in (self._broker, self._presence, self._stops, self._hub):
            transport.close()

    def tick(self) -> None:
        """Do one round.

        End robots that are silent or carried by another gateway, or all if a connection was lost; begin newly heard
        ones; publish this gateway's heartbeat.
        """
        if self._lost.is_set():
            self._lost.clear()
            self._end(self.carries)
        now = self._clock()
        for base, heard_at in list(self._heard.items()):
            if now - heard_at > SILENT_S:
                self._heard.pop(base, None)
        self._end(self.carries - self._heard.keys())
        if self._is_connected and now - self._listens_since >= FRESH_S:
            self._leave_to_others(now)
            self._begin(now)
        for robot in self._carried.values():
            robot.tick(now)
        if now - self._published_at >= HEARTBEAT_S and self._presence.state is State.CONNECTED:
            self._published_at = now
            topic, robots = will(self._name).topic, tuple(sorted(self._carried))
            heartbeat = GatewayHeartbeat(t=int(time.time() * 1000), run=self._others.run, robots=robots)
            self._presence.publish(topic, _encode(heartbeat), qos=QoS.DELIVERED, retain=True, remember=False)

    @property
    def _is_connected(self) -> bool:
        """True if all connections that forwarding needs are open."""
        return all(transport.state is State.CONNECTED for transport in (self._hub, self._broker, self._presence))

    def _leave_to_others(self, now: float) -> None:
        """Stop carrying robots that another gateway carries; at the start, raise PebbleError for them."""
        for base in list(self._heard):
            other = self._others.carrier(base, now, carried=base in self._carried)
            if not other:
                continue
            if not self._has_begun:
                raise PebbleError(
                    f"gateway {self._name} does not start: {other} carries {base} already. One gateway carries the "
                    "robots of a LAN"
                )
            self._quiet_log.warning(base, "gateway %s carries %s: this one leaves it", other, base)
            self._end(self.carries & {base})  # it may be heard, but not carried

    def _begin(self, now: float) -> None:
        """Begin to carry robots that were heard and that no gateway carries, at most TOGETHER of them."""
        waiting = [
            base
            for base in list(self._heard)
            if base not in self._carried and not self._others.carrier(base, now, carried=False)
        ]
        if not waiting:
            return
        hub, broker = self._hub, self._broker
        robots = [
            CarriedRobot(base, hub, broker, self._stops_pass, self._report_large, self._clock, self._beginning)
            for base in waiting[:TOGETHER]
        ]
        for transport in (hub, broker):
            transport.policy.is_stop = is_stop  # each Forwarder has set it for its own robot only
        self._has_begun = True
        self._carried |= {robot.base: robot for robot in robots}
        with self._beginning:  # measures how long this takes
            begin(robots, hub, broker)
        log.info("carries %s", ", ".join(robot.base for robot in robots))
        if len(waiting) > TOGETHER:
            self._wake.set()

    def _end(self, bases: Iterable[str]) -> None:
        for base in bases:
            self._carried.pop(base).end()
            log.info("carries %s no more", base)

    # -- on the transports' threads; the last two are rules of pebble.transports.base.TopicPolicy

    def _on_state(self, state: State) -> None:
        if state is not State.CONNECTED:
            self._lost.set()
        self._wake.set()

    def _on_presence(self, state: State) -> None:
        self._others.forget()
        self._listens_since = self._clock() if state is State.CONNECTED else float("inf")

    def _on_robot(self, message: Message) -> None:
        """Note a live heartbeat of a robot."""
        address, payload = parse_topic(message.topic), message.payload
        if not payload or address is None or address.identity.is_server:
            return
        base = address.identity.base
        if message.retain:
            may_be_live = self._hub.as_published  # then a live heartbeat has the flag, too, as it was published with it
            if not (may_be_live and self._differs_from_first(base, payload)):
                return
        if base in self._heard or len(self._heard) < MAX_ROBOTS:
            self._heard[base] = self._clock()
        else:
            self._quiet_log.warning("many", "the hub has more than %d robots: give it accounts", MAX_ROBOTS)

    def _differs_from_first(self, base: str, heartbeat: bytes) -> bool:
        """True if the robot's first heartbeat was a different one, so that this one is live. Stores the first one.

        Needed where a transport cannot tell live messages from retained ones.
        """
        if base not in self._first and len(self._first) >= MAX_ROBOTS:
            self._first.clear()  # costs a robot one heartbeat
        return self._first.setdefault(base, heartbeat) != heartbeat

    def _on_gateway(self, message: Message) -> None:
        """Note a gateway's heartbeat, or its end, an empty message. A retained one shows no live gateway."""
        address = parse_topic(message.topic)
        if address is None:
            return
        name = address.identity.id
        if not message.payload:
            self._others.left(name)
        elif not message.retain:
            try:
                heartbeat = _decode(message.payload)
            except msgspec.MsgspecError:
                self._quiet_log.warning(name[:40], "%s is no heartbeat of a gateway", message.topic[:200])
                return
            self._others.heard(name, heartbeat.run, heartbeat.robots[:MAX_ROBOTS], self._clock())

    def _on_stop(self, stop: Message) -> None:
        if not stop.retain and self._stop_cycles.examine(Side.REMOTE, _STOP, stop) is Finding.PASS:
            self._hub.publish(stop.topic, stop.payload, qos=QoS.DELIVERED, urgent=True)

    def _report_large(self, topic: str) -> None:
        self._quiet_log.warning("large", "a message on %s is larger than a gateway passes", topic[:200])

    def _stops_pass(self) -> bool:
        """True if stops arrive on their own connection."""
        return self._stops.state is State.CONNECTED and not self._stops.not_received

    def _robot_of(self, topic: str) -> CarriedRobot | None:
        address = parse_topic(topic)
        return None if address is None else self._carried.get(address.identity.base)

    def _is_invented(self, topic: str) -> bool:
        robot = self._robot_of(topic)
        return robot is None or robot.subjects.invented(topic.encode()) is not None

    def _skips_retained(self, topic: bytes) -> bool:
        robot = self._robot_of(topic.decode(errors="replace"))
        return (
            robot is not None
            and not topic.endswith(_STOP_END.encode())
            and robot.forwarder.skips_retained(Side.REMOTE, topic)
        )
