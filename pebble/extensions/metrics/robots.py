"""The robots that are exported, as known from their messages, and Prometheus' text format. Pure."""

import re
from collections import defaultdict
from contextlib import suppress
from typing import Final, TypeVar

import msgspec

from pebble import contract as c
from pebble.contract import channel_of, codec
from pebble.contract.identity import LEVEL, parse_topic
from pebble.contract.payloads import MediaReport, ServiceState
from pebble.errors import PayloadError
from pebble.extensions.media.rate_meter import RateMeter
from pebble.extensions.operator.client.names import id_of
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message

MOST_ROBOTS: Final = 1000  # that are listed; further ones are counted, until one is forgotten
MOST_NAMES: Final = 64  # processes, or streams, of one robot
FORGOTTEN_S: Final = 3600.0  # a robot that is silent for so long is not listed
_BATTERY: Final = {"v": "pebble_battery_volts", "%": "pebble_battery_percent"}
_DRIVEABLE: Final = {"yes": 1, "no": 0, "unknown": -1}

T = TypeVar("T")


_valid_level = re.compile(LEVEL).search


class Samples:
    """The samples of one scrape, by metric."""

    def __init__(self) -> None:
        self._lines: defaultdict[str, list[str]] = defaultdict(list)

    def add(self, metric: str, value: float | None, **labels: str) -> None:
        """Add a sample, unless ``value`` is None."""
        if value is not None:
            named = ",".join(f'{name}="{_escaped(text)}"' for name, text in labels.items())
            self._lines[metric].append(f"{metric}{{{named}}} {value:.12g}\n")

    def text(self) -> str:
        """Return Prometheus' text format 0.0.4. A name that ends in ``_total`` is a counter, any other a gauge."""
        return "".join(
            f"# TYPE {metric} {'counter' if metric.endswith('_total') else 'gauge'}\n{''.join(lines)}"
            for metric, lines in self._lines.items()
        )


class Robot:
    """A robot as an operator's program sees it, with figures that such a view does not keep."""

    def __init__(self, base: str, now: float) -> None:
        self.view = RobotView(base)
        self.heard_at = now  # of its newest heartbeat, or of its first message
        self._meter = RateMeter()
        self._battery: tuple[str, float] | None = None  # metric and value
        self._services: dict[str, ServiceState] = {}
        self._media: dict[str, MediaReport] = {}  # by stream: the newest report
        self._media_t = 0  # of these reports, epoch milliseconds
        self._loss: dict[str, float] = {}  # by stream: the share that was dropped between the last two reports

    def receive(self, channel: c.Channel | None, message: Message, now: float, wall: float) -> None:
        """Handle a message that arrived at ``now`` (monotonic) and ``wall`` (epoch seconds)."""
        self.view.receive(channel, message, now, wall)
        self.heard_at = self.view.liveness.received_at or self.heard_at
        self._meter.add(now, 0 if message.retain else len(message.payload))  # the robot sent a retained one earlier
        with suppress(PayloadError, msgspec.ValidationError):
            if channel is c.CHARGING_LEVEL:
                level = codec.decode(channel, message.payload)
                unit = codec.plain(channel, message.payload).get("unit")  # a decoded level without a unit has volts
                self._battery = (_BATTERY[unit], level.value) if unit in _BATTERY else None
            elif channel is c.STATUS:
                services = codec.decode(channel, message.payload).value.get("services")
                self._services = _named(msgspec.convert(services, dict[str, ServiceState]))
            elif channel is c.MEDIA_STATUS:
                status = codec.decode(channel, message.payload)
                self._take_media(status.t, _named(status.value))

    def _take_media(self, t: int, media: dict[str, MediaReport]) -> None:
        """Replace the reports of all streams; compute each one's loss since the last report."""
        before, seconds = self._media, (t - self._media_t) / 1000
        self._media, self._media_t, self._loss = media, t, {}
        for name in media.keys() & before.keys():
            dropped = (media[name].dropped or 0) - (before[name].dropped or 0)
            handled = dropped + (media[name].rate or 0.0) * seconds
            if dropped >= 0 and handled > 0:  # less than 0: the program was restarted, and counts anew
                self._loss[name] = dropped / handled

    def add_to(self, samples: Samples, now: float) -> None:
        """Add the robot's samples; of a silent robot only its heartbeat, and which of its motor owners are stopped."""
        robot, view = id_of(self.view.base), self.view
        online = view.online(now) is True
        samples.add("pebble_robot_online", online, robot=robot)
        samples.add("pebble_heartbeat_age_seconds", view.liveness.age_s(now), robot=robot)
        for owner, state in view.estop.states.items():
            samples.add("pebble_robot_stopped", state.latched, robot=robot, owner=owner)
        if not online:
            return
        if (driveable := view.driveable) is not None:
            samples.add("pebble_robot_driveable", _DRIVEABLE[driveable.state], robot=robot)
        samples.add("pebble_robot_charging", view.charging, robot=robot)
        if not view.liveness.whole_seconds:
            samples.add("pebble_heartbeat_latency_seconds", view.liveness.average_latency_s, robot=robot)
        if self._battery is not None:
            samples.add(*self._battery, robot=robot)
        for name, service in self._services.items():
            if service.state not in ("stopped", "held"):  # these are not to run
                samples.add("pebble_service_up", service.state == "ready", robot=robot, service=name)
            samples.add("pebble_service_restarts_total", service.restarts, robot=robot, service=name)
        media = {name: report for name, report in self._media.items() if report.running}
        sent = sum(report.bitrate or 0 for report in media.values())  # the meter has no pictures, and no sound
        samples.add("pebble_link_bytes_per_second", (self._meter.bitrate(now) + sent) / 8, robot=robot)
        for name, report in media.items():
            samples.add("pebble_media_fps", report.rate, robot=robot, stream=name)
            samples.add("pebble_media_loss_ratio", self._loss.get(name), robot=robot, stream=name)


class Robots:
    """All robots of a broker."""

    def __init__(self) -> None:
        self.robots: dict[str, Robot] = {}
        self._unlisted: set[str] = set()  # robots without room in ``robots``, heard of since the last scrape

    def receive(self, message: Message, now: float, wall: float) -> None:
        """Handle a message of any robot. An empty message does not add an unknown robot."""
        address = parse_topic(message.topic)
        if address is None or address.identity.is_server:
            return
        base = address.identity.base
        if base not in self.robots and message.payload:
            if len(self.robots) < MOST_ROBOTS:
                self.robots[base] = Robot(base, now)
            elif len(self._unlisted) < MOST_ROBOTS:
                self._unlisted.add(base)
        if base in self.robots:
            self.robots[base].receive(channel_of(f"{address.direction}/{address.metric}"), message, now, wall)

    def add_to(self, samples: Samples, now: float) -> None:
        """Add the samples of all robots, and forget robots that were silent for too long."""
        self.robots = {base: robot for base, robot in self.robots.items() if now - robot.heard_at < FORGOTTEN_S}
        for robot in self.robots.values():
            robot.add_to(samples, now)
        samples.add("pebble_exporter_robots", len(self.robots))
        samples.add("pebble_exporter_unlisted", len(self._unlisted))
        self._unlisted.clear()


def _named(entries: dict[str, T]) -> dict[str, T]:
    """Return the entries with names that are valid as labels; of more than 64 entries the first 64 count."""
    return {name: entry for name, entry in list(entries.items())[:MOST_NAMES] if _valid_level(name)}


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"")  # a level of a topic has no line break
