"""The robots that a gateway carries now: each begins and ends with its turn; all are synchronised and probed."""

import logging
from collections.abc import Callable, Mapping
from functools import partial

from pebble.contract import ESTOP
from pebble.contract.identity import parse_topic
from pebble.forwarding.cycles import PROBE_PERIOD_S
from pebble.forwarding.retained_window import INITIAL_SYNC_S
from pebble.services.gateway.carried import Beginning, Carried, begin
from pebble.services.gateway.connections import Connections
from pebble.services.gateway.ownership import Ownership

log = logging.getLogger(__name__)

_INCOMING = f"/{ESTOP.direction}/"
#: Robots that begin in one turn: they wait together for hub and broker. More would hold up the end of others, and what
#: moves is taken for old while a turn lasts longer than Beginning.LONG_S.
TOGETHER = 8
#: A turn that takes so long does not end. Those that begin in it wait 0.5 s and 0.7 s for a slow hub, twice if it is
#: just back, and twice 2 s for a slow broker.
STANDS_S = 10.0


class CarriedRobots:
    """Robots by base topic. ``ownership`` decides about each message whether its robot is still carried.

    ``flooded`` is called with the topic of each message that is too much at this moment.
    """

    def __init__(
        self,
        connections: Connections,
        ownership: Ownership,
        flooded: Callable[[str], None],
        clock: Callable[[], float],
    ) -> None:
        self._connections, self._ownership = connections, ownership
        self._flooded, self._clock = flooded, clock
        self._robots: dict[str, Carried] = {}
        self._beginning = Beginning()  # of those that begin now
        self._synchronize: dict[str, float] = {}  # when what is retained of it has arrived
        self._probed_at = float("-inf")
        self._ticked_at = clock()

    @property
    def stands(self) -> bool:
        """Whether what has to be done in each turn is not done any more."""
        return self._clock() - self._ticked_at > STANDS_S

    @property
    def bases(self) -> frozenset[str]:
        return frozenset(self._robots)

    def of(self, topic: str) -> Carried | None:
        address = parse_topic(topic)
        return None if address is None else self._robots.get(address.identity.base)

    def may_leave(self, base: str) -> bool:
        """Whether that robot is carried at this moment."""
        one = self._robots.get(base)
        return one is not None and self._holds(one.base, one.since)

    def follow(self, held: Mapping[str, float]) -> bool:
        """Carry those that are held, each since then; False: some have to wait for the next turn."""
        for robot, one in list(self._robots.items()):
            if held.get(robot) != one.since:
                self._end(robot)
        waiting = [robot for robot in held if robot not in self._robots]
        if waiting:
            self._begin({robot: held[robot] for robot in waiting[:TOGETHER]})
        return len(waiting) <= TOGETHER

    def pass_waiting(self) -> None:
        for one in list(self._robots.values()):
            one.pass_waiting()

    def tick(self, now: float) -> None:
        for robot, due in list(self._synchronize.items()):
            if self._clock() >= due:
                del self._synchronize[robot]
                if robot in self._robots:
                    self._robots[robot].synchronize()
        if now - self._probed_at >= PROBE_PERIOD_S:
            self._probed_at = now
            for one in self._robots.values():
                one.probe()
        self._ticked_at = self._clock()

    def hub_changed(self) -> None:
        for robot, one in list(self._robots.items()):
            one.hub_changed(self._connections.hub.state)
            self._synchronize[robot] = self._clock() + INITIAL_SYNC_S

    def _begin(self, held: Mapping[str, float]) -> None:
        hub, broker = self._connections.hub, self._connections.broker
        made = []
        for robot, since in held.items():
            holds = partial(self._holds, robot, since)
            one = Carried(robot, since, hub, broker, holds, self._clock, self._flooded, self._beginning)
            made.append(one)
            self._robots[robot] = one
        for transport in (hub, broker):
            transport.judge_topics(is_stop=is_stop)  # of all robots, not of the newest one
        with self._beginning:
            begun = begin(made, hub, broker)
        for one in made:
            if one in begun:
                self._synchronize[one.base] = self._clock() + INITIAL_SYNC_S
                log.info("carries %s", one.base)
            else:  # it was not the owner any more before it had begun
                self._end(one.base, begun=False)

    def _end(self, robot: str, *, begun: bool = True) -> None:
        self._synchronize.pop(robot, None)
        self._robots.pop(robot).end()
        log.info("carries %s no more" if begun else "was to carry %s, and is no more", robot)

    def _holds(self, robot: str, since: float) -> bool:
        return self._ownership.since(robot, self._clock()) == since


def is_stop(topic: str) -> bool:
    """Whether it is a stop, with the name of a sender or without."""
    return _INCOMING in topic and topic.endswith(f"/{ESTOP.metric}")
