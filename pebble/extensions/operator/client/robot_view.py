"""A robot as an operator's program sees it: online or not, its capabilities, and who or what holds it. Pure."""

from collections import deque
from collections.abc import Collection
from contextlib import suppress
from typing import Any

from pebble import contract as c
from pebble.contract import codec
from pebble.contract.levels import silent_after
from pebble.contract.payloads import AutonomyStatus, Drive, EstopState, LinkLevel, LinkState
from pebble.errors import PayloadError
from pebble.extensions.operator.client import assumed
from pebble.extensions.operator.client.control import RobotControl
from pebble.extensions.operator.client.drive_reasons import SILENT_S, Situation, words
from pebble.extensions.operator.client.driveable import Driveable, driveable_of, is_held
from pebble.extensions.operator.client.pace_of_link import Pace, pace_of, way_s
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.operator.client.robot_topics import SYNONYMS, named_topic, section_of
from pebble.transports import Message

MAX_REMEMBERED = 64  # topics of one robot
_HISTORY = 10
_COMES_AND_GOES_S = 60.0
_STAMPS = 5  # heartbeats by which a clock of whole seconds is recognised


class Liveness:
    """The heartbeats of a component. As on the paper's operator page, the timeout depends on their interval."""

    def __init__(self) -> None:
        self.received_at: float | None = None  # monotonic
        self.reported_offline = False
        self.link: LinkLevel = "wide"  # as its bridge measures it
        self._intervals: deque[float] = deque(maxlen=_HISTORY)  # between the newest heartbeats
        self._latencies: deque[float] = deque(maxlen=_HISTORY)  # of the newest with a plausible time
        self._stamps: deque[int] = deque(maxlen=_STAMPS)  # times in the newest, ms of its clock
        self.latency_s: float | None = None  # of the newest heartbeat; None if its clock is wrong
        self._returns: deque[float] = deque(maxlen=2)  # when a heartbeat came after people had been told of a silence

    def heartbeat(self, now: float, latency_s: float, *, online: bool = True, t: int = 1) -> None:
        """Note a heartbeat; ``t``: its time in ms of the component's clock, for `whole_seconds` alone (1: none)."""
        self._stamps.append(t)
        interval_s = None if self.received_at is None else now - self.received_at
        # shorter than any config allows: both heartbeats waited in a queue; longer: a pause, which is no interval
        if interval_s is not None and 0.05 <= interval_s <= 10.0:
            if not self.reported_offline and self.online_to_people(now) is False:  # it was only silent
                self._returns.append(now)
            self._intervals.append(interval_s)
        has_plausible_clock = -1.0 <= latency_s <= 10.0
        self.latency_s = max(0.0, latency_s) if has_plausible_clock else None
        if self.latency_s is not None:
            self._latencies.append(self.latency_s)
        self.received_at, self.reported_offline = now, not online

    @property
    def average_latency_s(self) -> float | None:
        """Return the mean latency of the last ten heartbeats; correct only if both clocks are synchronised."""
        return _mean(self._latencies)

    @property
    def interval_s(self) -> float | None:
        """Return the mean interval of the last ten heartbeats."""
        return _mean(self._intervals)

    @property
    def whole_seconds(self) -> bool:
        """True if the component's clock counts whole seconds, so that latency cannot be measured."""
        return len(self._stamps) == _STAMPS and all(stamp % 1000 == 0 for stamp in self._stamps)

    def age_s(self, now: float) -> float | None:
        return None if self.received_at is None else now - self.received_at

    def online(self, now: float, at_least_s: float = 0.0) -> bool | None:
        """True if the robot is online; None while there are too few heartbeats.

        A silence of less than ``at_least_s`` does not count.
        """
        if self.reported_offline:
            return False
        interval = self.interval_s
        if self.received_at is None or len(self._intervals) < 2 or interval is None:
            return None
        age = now - self.received_at
        return age <= silent_after(interval, self.link, self.average_latency_s or 0.0) or age < at_least_s

    def online_to_people(self, now: float) -> bool | None:
        """True if the component is to be shown as online; None while that is unknown.

        A silence counts after 1.5 s, or later if heartbeats are irregular.
        """
        returns = sum(now - at < _COMES_AND_GOES_S for at in self._returns)
        return self.online(now, SILENT_S * (1 + returns))


def _mean(values: deque[float]) -> float | None:
    return sum(values) / len(values) if values else None


class RobotView:
    """A robot, from the messages it publishes."""

    def __init__(self, base: str) -> None:
        self.base, self.name = base, base.rpartition("/")[2]
        self.liveness = Liveness()
        self.estop = RobotEstop(base)
        self.control = RobotControl(self.estop)
        self.reset_at = float("-inf")  # when its emergency stop ended, as far as it was seen
        self.remembered: dict[str, Message] = {}  # by topic: what an emergency stop that begins later needs to know
        self.capabilities: dict[str, Any] = {}
        self.parked = False  # its broker retains a drive command: it moves a board whenever that connects
        self._status = b""  # the payload of its newest status
        self.link: LinkState | None = None  # what the way to its broker carries; None: everything
        self.autonomy: AutonomyStatus | None = None
        self.volts: float | None = None
        self.charging: bool | None = None

    # -- what arrives

    def receive(self, channel: c.Channel | None, message: Message, now: float, wall: float) -> None:
        """Handle a message of this robot that arrived at ``now`` (monotonic) and ``wall`` (epoch seconds).

        ``channel`` says what the message means (None: unknown). A malformed message changes nothing. An empty message
        removes the retained value.
        """
        if channel in _FOR_STOPS:
            self._keep_for_late_stop(message)
        if channel in (c.CAPABILITIES, c.ESTOP_STATE):
            self._update_stop(message, now)
            if channel is c.CAPABILITIES:
                self._take_capabilities(message.payload)
        elif channel is c.CONTROL_STATE:
            self.control.receive(message)
        elif channel is c.LINK:
            self.link = _link_of(message.payload)  # no link, or an unreadable one, counts as wide
            self.liveness.link = "wide" if self.link is None else self.link.level
        elif channel is c.STATUS:
            self._status = message.payload
            self._take_announced(message.payload)
        elif channel is c.DRIVE:
            self._note_retained_drive(message)
        elif channel in _DECODED:
            with suppress(PayloadError):
                self._receive_decoded(channel, message, codec.decode(channel, message.payload), now, wall)

    def _receive_decoded(self, channel: c.Channel, message: Message, payload: Any, now: float, wall: float) -> None:
        if channel is c.CHARGING_LEVEL:
            self.volts = payload.value
        elif channel is c.CHARGING_STATUS:
            self.charging = payload.value
        elif channel is c.AUTONOMY_STATUS:
            self.autonomy = payload
        else:  # a heartbeat
            self._take_announced(message.payload)
            if not message.retain:  # a heartbeat that is retained is no sign of life
                self.liveness.heartbeat(now, wall - payload.t / 1000, online=payload.online is not False, t=payload.t)

    def _take_announced(self, payload: bytes) -> None:
        """Derive capabilities from the subscriptions in a heartbeat or status, unless the robot publishes its own."""
        if not self.capabilities or "announced" in self.capabilities:
            value = assumed.announced(self.base, payload)
            if value and value != self.capabilities:
                self.capabilities = value

    def _update_stop(self, message: Message, now: float) -> None:
        """Update the emergency stop by the state of a motor owner, or by the list of owners in capabilities."""
        was_latched = self.latched
        self.estop.receive(message)
        if was_latched and not self.latched:
            self.reset_at = now

    def _take_capabilities(self, payload: bytes) -> None:
        """Store the capabilities that the robot publishes. Empty ones replace only assumed ones."""
        with suppress(PayloadError):
            published = codec.decode(c.CAPABILITIES, payload).value
            if published or self.is_assumed:
                self.capabilities = published

    def _note_retained_drive(self, message: Message) -> None:
        """Note whether a drive command that moves the robot is retained.

        An empty message, which brokers deliver without the retain flag, tells that the retained one was removed.
        """
        if message.retain or not message.payload:
            self.parked = bool(message.payload)
            with suppress(PayloadError):  # a command that cannot be read counts as one that moves it
                self.parked = self.parked and codec.decode(c.DRIVE, message.payload).moves

    def _keep_for_late_stop(self, message: Message) -> None:
        """Keep the topic's newest message: an emergency stop that this program sends later gets all kept ones first.

        Capabilities are kept even if there are MAX_REMEMBERED states of owners already.
        """
        has_place = message.topic in self.remembered or message.topic == c.CAPABILITIES.topic(self.base)
        if not message.payload:
            self.remembered.pop(message.topic, None)
        elif has_place or len(self.remembered) < MAX_REMEMBERED:
            self.remembered[message.topic] = message

    # -- what is assumed

    @property
    def silent(self) -> bool:
        """True if the robot has published neither capabilities nor its subscriptions."""
        return not self.estop.has_capabilities and (not self.capabilities or self.is_assumed)

    @property
    def is_assumed(self) -> bool:
        """True if the robot published no capabilities, and people have said what it can do: see :meth:`assume`."""
        return "assumed" in self.capabilities

    def assume(self, axes: Collection[str], name: str = "") -> bool:
        """Assume that a board which has published no capabilities drives along ``axes``; none: it cannot drive.

        Return True if that changes anything.
        """
        before = self.capabilities
        if self.silent:
            self.capabilities = assumed.assumed(self.base, axes, name)
        return self.capabilities != before

    def encode(self, drive: Drive) -> bytes:
        """Return a drive command in the form that this robot reads."""
        axes = section_of(self.capabilities, "drive").get("axes") if self.is_assumed else None
        return codec.encode(c.DRIVE, drive) if axes is None else assumed.encode(drive, axes)

    # -- what is known

    @property
    def live(self) -> bool:
        """True if any message of the robot has arrived that is not retained."""
        return self.liveness.received_at is not None

    @property
    def transport(self) -> str:
        return str(section_of(self.capabilities, "transport").get("kind", "?"))

    @property
    def latched(self) -> bool:
        """True if any of the robot's motor owners is stopped by an emergency stop: it must not be driven."""
        return bool(self.estop.latched)

    @property
    def stopped_by(self) -> EstopState | None:
        """Return the state with the newest stop; None if it is not stopped."""
        return self.estop.stopped_by

    @property
    def drives(self) -> bool:
        """True if the robot offers driving; nothing is assumed without capabilities (paper A.8.6)."""
        drive = section_of(self.capabilities, "drive")
        return drive.get("available") is True and drive.get("controls") is not False

    @property
    def arbitrates(self) -> bool:
        """True if the robot itself decides between a script and a person."""
        return section_of(self.capabilities, "drive").get("arbitrates") is True

    @property
    def controlled(self) -> bool:
        """True if the robot itself decides which person drives it."""
        return section_of(self.capabilities, "drive").get("control") is True

    @property
    def driveable(self) -> Driveable | None:
        """Return the robot's judgement whether its motors obey; None if its status has none."""
        return driveable_of(self._status)

    def holds(self, program: str) -> bool:
        """True if that program is requested and waits while a person drives over a thin link."""
        return is_held(self._status, program)

    @property
    def named(self) -> bool:
        """True if the robot takes only commands with the sender's account in the topic."""
        return self.estop.named

    @property
    def slow_s(self) -> float | None:
        """Return how many seconds commands take over a thin link; None if the robot is offline or its link wide."""
        if self.link is None or self.link.level == "wide" or self.liveness.reported_offline:
            return None
        return way_s(self.link)

    @property
    def pace(self) -> Pace:
        """Return the rate of commands to the robot, also while it is offline."""
        return pace_of(self.link)

    def topic(self, channel: c.Channel) -> str | None:
        """Return the topic that the robot's capabilities name for ``channel``; None for none, or a foreign topic."""
        return named_topic(self.base, self.capabilities, channel)

    def offers(self, section: str) -> bool:
        """True if ``section`` of the robot's capabilities, for example ``video``, can be requested."""
        return section_of(self.capabilities, section).get("controls") is True

    def ready(self, now: float) -> bool:
        """True if the robot is online and its drive topic is known."""
        return self.topic(c.DRIVE) is not None and self.liveness.online(now) is True

    def online(self, now: float) -> bool | None:
        """True if the robot is to be shown as online; None while that is unknown."""
        return self.liveness.online_to_people(now)

    @property
    def script(self) -> str:
        """Return the title of a script that may move the robot; empty if there is none."""
        status = self.autonomy
        if status is None or not status.running or status.drives is False:
            return ""
        return (status.label if isinstance(status.label, str) else status.file) or "A script"

    @property
    def itself(self) -> str:
        """Return words that tell people that the robot drives itself, and by which script; empty if it does not."""
        is_overridden = self.autonomy is not None and self.autonomy.overridden is True
        if not self.script or self.latched or is_overridden:
            return ""
        return words("itself", self.name, script=self.script)

    def situation(self, now: float) -> Situation:
        """Return the facts for and against driving that the robot itself publishes."""
        return Situation(
            online=self.online(now),
            latched=self.latched,
            free_s=now - self.reset_at,
            # Capabilities that are assumed for it count, and its own even if they are empty.
            published=bool(self.capabilities) or self.estop.has_capabilities,
            drives=self.drives,
            arbitrates=self.arbitrates,
            script=bool(self.script),
        )


_FOR_STOPS = (c.ONLINE, c.CAPABILITIES, c.ESTOP_STATE)
_DECODED = (c.ONLINE, *SYNONYMS, c.CHARGING_LEVEL, c.CHARGING_STATUS, c.AUTONOMY_STATUS)


def _link_of(payload: bytes) -> LinkState | None:
    """Return the state in a message on ``outgoing/link``; None if it was removed, or cannot be read."""
    try:
        return codec.decode(c.LINK, payload) if payload else None
    except PayloadError:
        return None
