"""Discovery of robots by their outgoing topics."""

from pebble.contract import OUTGOING, channel_of
from pebble.contract.identity import parse_topic
from pebble.contract.levels import silent_after
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message

ALL_OUTGOING = f"+/+/+/{OUTGOING}/#"


class Discovery:
    """All robots that have published anything, by base topic. One thread calls ``receive``; others only read."""

    def __init__(self) -> None:
        self.robots: dict[str, RobotView] = {}

    def all_robots(self) -> list[RobotView]:
        return list(self.robots.values())  # a copy: robots may be added meanwhile

    def awaits_heartbeat(self, waited_s: float) -> bool:
        """True if a first heartbeat may still come after ``waited_s``: a known robot's, or any while none is known."""
        robots = self.all_robots()
        if not robots:
            return waited_s < silent_after()
        silent = [robot.liveness for robot in robots if not robot.live]
        return any(waited_s < silent_after(link=liveness.link) for liveness in silent)

    def receive(self, message: Message, now: float, wall: float) -> None:
        """Update from a message that arrived at ``now`` (monotonic) and ``wall`` (epoch seconds)."""
        address = parse_topic(message.topic)
        if address is None or address.identity.is_server:
            return
        base = address.identity.base
        robot = self.robots.get(base)
        if robot is None:
            robot = self.robots[base] = RobotView(base)
        robot.receive(channel_of(f"{address.direction}/{address.metric}"), message, now, wall)
