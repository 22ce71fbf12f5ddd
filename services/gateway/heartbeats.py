"""Heartbeats of robots at the hub, which show who is there, and of the gateway, which show others what it carries."""

import secrets
import time
from collections.abc import Sequence

import msgspec

from pebble.contract import ONLINE
from pebble.contract.identity import GATEWAYS, Identity
from pebble.contract.levels import silent_after
from pebble.contract.payloads import GatewayHeartbeat
from pebble.services.gateway.ownership import MAX_ROBOTS
from pebble.transports import Message, QoS, Transport

HEARTBEAT_S = 0.25
#: Between two heartbeats of a robot that is not away, at most; and so that it is not away because one comes late.
LONGEST_GAP_S, SHORTEST_GAP_S = 10.0, 0.75
RIVAL_S = 5.0  # so long another gateway of the same name is there after its last heartbeat
_MOST_SENT = 16  # heartbeats that may come back

_encode = msgspec.json.encode


def will(name: str) -> Message:
    """What tells the others that this gateway has gone."""
    return Message(ONLINE.topic(Identity("pebble", GATEWAYS, name).base), b"", QoS.DELIVERED, True)


class PresentRobots:
    """The robots that publish heartbeats at the hub. Silence is judged by their own pace."""

    def __init__(self) -> None:
        self._received: dict[str, tuple[float, float]] = {}  # when, and after how many seconds of silence it is away
        self._first: dict[str, bytes] = {}  # of what may be retained

    def note_copy(self, robot: str, payload: bytes, now: float) -> None:
        """As :meth:`note`, where a live heartbeat looks as the one that is retained: which comes first."""
        if robot not in self._first and len(self._first) >= MAX_ROBOTS:
            self._first.clear()
        if self._first.setdefault(robot, payload) != payload:
            self.note(robot, now)

    def __contains__(self, robot: object) -> bool:
        """Whether it is one of those, or was until lately."""
        return robot in self._received

    def note(self, robot: str, now: float) -> None:
        before = self._received.get(robot)
        if before is None and len(self._received) >= MAX_ROBOTS:
            self._forget(now)
            if len(self._received) >= MAX_ROBOTS:
                return
        gap = 0.0 if before is None else now - before[0]
        self._received[robot] = now, silent_after(max(gap, SHORTEST_GAP_S) if gap <= LONGEST_GAP_S else SHORTEST_GAP_S)

    def robots(self, now: float) -> tuple[str, ...]:
        return tuple(sorted(robot for robot, (at, silent_s) in list(self._received.items()) if now - at <= silent_s))

    def _forget(self, now: float) -> None:
        self._received = {robot: one for robot, one in self._received.items() if now - one[0] <= one[1]}


class OwnHeartbeats:
    """Those of one run of a gateway. That they come back shows it that the others receive them."""

    def __init__(self, name: str, broker: Transport) -> None:
        self._broker, self._topic = broker, will(name).topic
        self._run, self._number = secrets.token_hex(4), 0
        self._sent: dict[int, tuple[float, tuple[str, ...]]] = {}  # heartbeats that have not come back
        self._sent_at = self._rival_at = float("-inf")

    def due(self, now: float, late_s: float) -> bool:
        """Whether to publish one now, where the next look comes after ``late_s``; not beside one of the same name."""
        return now - self._sent_at >= HEARTBEAT_S - late_s / 2 and now - self._rival_at >= RIVAL_S

    def publish(self, robots: Sequence[str], now: float) -> None:
        self._sent_at = now
        self._number += 1
        carried = tuple(robots)
        self._sent[self._number] = now, carried
        if len(self._sent) > _MOST_SENT:
            del self._sent[next(iter(self._sent))]
        heartbeat = GatewayHeartbeat(
            t=int(time.time() * 1000), run=self._run, number=self._number, robots=tuple(robots)
        )
        raw = _encode(heartbeat)  # not stored: an old one must not be sent after an outage
        self._broker.publish(self._topic, raw, qos=QoS.DELIVERED, retain=True, urgent=True, remember=False)

    def repeat(self) -> None:
        """The will of an earlier connection was published: the next one is due at once."""
        self._sent_at = float("-inf")

    def came_back(self, heartbeat: GatewayHeartbeat) -> tuple[float, tuple[str, ...]] | None:
        """When this one was sent, and with which robots; None: it is none of this run's newest."""
        return self._sent.pop(heartbeat.number, None) if heartbeat.run == self._run else None

    def yields_to(self, heartbeat: GatewayHeartbeat, now: float) -> bool:
        """Whether it is one of another gateway of this name, started with a higher number: then this one rests."""
        if heartbeat.run <= self._run:
            return False
        self._rival_at = now
        return True
