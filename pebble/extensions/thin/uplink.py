"""Adapts the bridge to a link that may be thin, and publishes the link's level."""

import logging
import threading
from collections.abc import Callable, Collection
from contextlib import suppress
from math import inf

from pebble.config import Config
from pebble.contract import DRIVE, LINK, WIRE, Channel, codec
from pebble.contract.levels import LEVELS, Level
from pebble.contract.payloads import SCRIPT, Drive, LinkState
from pebble.errors import PayloadError
from pebble.extensions.thin.group_gate import install_gate
from pebble.extensions.thin.link import LateRun, LinkMeter, Room
from pebble.extensions.thin.sieve import Rank, Sieve
from pebble.extensions.thin.sifter import Sifter
from pebble.extensions.thin.stream_groups import StreamGroups
from pebble.forwarding.forwarder import Forwarder
from pebble.runtime.addresses import Address, Addresses
from pebble.runtime.parent import Notifier
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.services.mqtt_bridge.same_broker import now_ms
from pebble.services.mqtt_bridge.uplink import POLL_S, Uplink
from pebble.transports import QoS, Transport

log = logging.getLogger(__name__)

_STATE_S, _STATES_S = 2.0, 10.0  # between two publications of the state at least, and at most
_CROWDED_STATE_S = 1.0  # while a queue stands operators have to know soon how long it still is
_CHANGE_S = 0.05  # a queue that has changed by less is the same, and by less than half a round trip
_CROWDED_DRIVE, _CROWDED_STREAMS = 2 / 3, 1 / 4  # of what is sent at a level, while a queue stands
_PAUSE = 25  # so much longer on a thin link what can wait is spread
_HEARTBEAT_BYTES = 80  # about
_LATE, _LATE_S = 8, 1.5  # as many late commands in a row, and for so long: more of them wait in the broker
_FLOODED_S = 60.0  # how long the link counts as flooded after they were dropped
_HELD = ("camera_publisher", "video_stream", "audio_publisher")
_HOLD_S = 5.0  # after the newest command that moves something: each beginning costs 2 KB of states and logs
RENEW_S = 30.0  # between two connections that are renewed for it, at least: who floods must not keep the robot away


class LinkReport:
    """The retained state that tells others the level of the link: a new level at once, a change of its queue soon."""

    def __init__(self, meter: LinkMeter, address: Address, remote: Transport) -> None:
        self._meter, self._address, self._remote = meter, address, remote
        self._level, self._crowded, self._queue_s = "", False, 0.0  # as published last; crowded: a queue stands
        self._at = -inf  # when that was

    @property
    def is_outdated(self) -> bool:
        """True if the level of the link, or whether it is crowded, has changed, so that others must adapt."""
        return (self._meter.level, self._meter.crowded) != (self._level, self._crowded)

    def is_due(self, now: float) -> bool:
        """True if the link's figures have changed enough since they were published, or were published long ago."""
        change_s = abs(self._meter.queue_s - self._queue_s)
        state_s = _CROWDED_STATE_S if self._crowded else _STATE_S
        changed = now - self._at >= state_s and change_s >= max(_CHANGE_S, self._meter.round_trip_s / 2)
        return changed or now - self._at >= _STATES_S

    def publish(self, now: float) -> None:
        """Publish the state as a retained message. Without a connection it is sent on the next one."""
        meter, earlier_level = self._meter, self._level
        self._level, self._crowded, self._queue_s, self._at = meter.level, meter.crowded, meter.queue_s, now
        trip_ms, queue_ms = round(1000 * meter.round_trip_s), round(1000 * meter.queue_s)
        if earlier_level not in ("", meter.level):
            log.info(
                "the link to the remote broker is %s now (it was %s): a round trip of %d ms, and %d ms of queue",
                meter.level, earlier_level, trip_ms, queue_ms
            )  # fmt: skip
        drive_hz = round(LEVELS[meter.level].drive_hz * (_CROWDED_DRIVE if meter.crowded else 1), 2)
        state = LinkState(level=meter.level, drive_hz=drive_hz, rtt_ms=trip_ms, queue_ms=queue_ms, t=now_ms())
        address = self._address
        self._remote.publish(address.topic, codec.encode(LINK, state), qos=QoS(address.qos), retain=address.retain)


class MediaHold:
    """A pause of the programs with pictures or sound while a person drives over the same modem.

    ``request(program, on)`` asks the launcher to begin a program's pause, or to end it if ``on`` is False.
    It returns False if the launcher is busy.
    """

    def __init__(self, programs: Collection[str], request: Callable[[str, bool], bool]) -> None:
        self._requested = dict.fromkeys((name for name in _HELD if name in programs), False)  # by program
        self._request = request
        self._driven_at = -inf

    def note_drive(self, now: float) -> None:
        """Note a command over a thin link that moves something. Any thread may call this."""
        self._driven_at = now

    def send(self, now: float) -> None:
        """Ask for the pause once a person drives, and later for its end; ask again if the launcher was busy."""
        on = now - self._driven_at < _HOLD_S
        for program, requested in self._requested.items():
            if requested is not on and self._request(program, on):
                self._requested[program] = on


def make_uplink(
    config: Config,
    addresses: Addresses,
    remote: Transport,
    forwarder: Forwarder,
    notifier: Notifier,
    clock: Callable[[], float],
) -> Uplink:
    """Return the uplink of a robot: a thin one if its link may be thin, else a plain one.

    A page may send streams in groups on any link. Beside a plain uplink a gate takes them apart.
    """
    if config.services.mqtt_bridge.link.profile != "wide":
        return ThinUplink(config, addresses, remote, forwarder, notifier, clock)
    uplink = Uplink()
    install_gate(config, addresses, forwarder, uplink.note_drive)
    return uplink


class ThinUplink(Uplink):
    """The link to the remote broker, for a config that says that it may be thin."""

    channels: tuple[Channel, ...] = (LINK,)

    def __init__(
        self,
        config: Config,
        addresses: Addresses,
        remote: Transport,
        forwarder: Forwarder,
        notifier: Notifier,
        clock: Callable[[], float],
    ) -> None:
        section = config.services.mqtt_bridge
        self._remote, self._forwarder, self._clock = remote, forwarder, clock
        # Heartbeats of QoS 0 save acknowledgements of MQTT. Zenoh has none, and may reorder messages of different QoS.
        self._saves_acks = section.remote is None or section.remote.kind == "mqtt"
        self._heartbeat_s = section.heartbeat.interval_seconds
        self._meter, self._room = LinkMeter(section.link.profile, section.link.kbit), Room(section.link.kbit)
        self._report = LinkReport(self._meter, addresses[LINK], remote)
        self._guard = threading.Lock()  # of the room: messages take it on the thread that received them
        gate = install_gate(config, addresses, forwarder, self.note_drive)  # None if the robot takes no groups
        self._sieve = Sieve(self._takes, forwarder.counters, clock)  # keeps what finds no room
        self._groups: StreamGroups | None = None
        if section.link.group_hz:
            self.channels = (LINK, WIRE)
            self._groups = StreamGroups(config, addresses, remote, forwarder.counters, clock)
        self._sifter = Sifter(forwarder, gate or forwarder, self._groups)  # leads messages to the sieve, or to groups
        self._late, self._hold = LateRun(), MediaHold(config.on_demand_programs(), notifier.hold)
        # Late commands show that the broker's queue for this link is long: see _drop_late.
        forwarder.note_age = lambda late: self._late.note(late, clock())
        self._quiet_log = RateLimitedLog(log, period_s=60.0)
        self._heartbeat_at = self._flooded_at = -inf
        self._shed = 0  # messages that were dropped for lack of room, as logged last
        self._suit_transport()

    @property
    def level(self) -> Level:
        return LEVELS[self._meter.level]

    @property
    def is_flooded(self) -> bool:
        return self._clock() - self._flooded_at < _FLOODED_S

    @property
    def heartbeat_qos(self) -> int | None:
        return self.level.heartbeat_qos if self._saves_acks else None

    def heartbeat_due(self) -> bool:
        """True if a heartbeat is due, and the link has room for it; then it counts as sent."""
        now, level_s = self._clock(), self.level.heartbeat_s  # 0: the level sets no period, only the bridge's timer
        if level_s:
            # This is called every POLL_S: of all calls, the one nearest to the due time counts.
            if now - self._heartbeat_at < max(level_s, self._heartbeat_s) - POLL_S / 2:
                return False
            if not self._takes(Rank.HEARTBEAT, _HEARTBEAT_BYTES):
                return False
        self._heartbeat_at = now
        return True

    def pause(self, seconds: float) -> float:
        return seconds * _PAUSE if self._meter.level == "thin" else seconds

    def poll(self) -> bool:
        """Measure the link, and send what has room now; return True to have :meth:`heartbeat_due` asked, too."""
        now = self._clock()
        outgoing = self._remote.outgoing
        with self._guard:
            self._room.poll(outgoing.waiting, outgoing.round_trip_s, now)
        self._meter.follow(self._remote.answer, now)
        if self._report.is_outdated:
            self._suit(now)
        self._drop_late()
        self._sifter.send_waiting()
        if self._groups is not None:
            self._groups.send(lambda size: self._takes(Rank.STREAM, size), crowded=self._meter.crowded)
        self._hold.send(now)
        self._report_shed()
        if self._report.is_due(now) and self._takes(Rank.STATE, _HEARTBEAT_BYTES):
            self._report.publish(now)
        return self.level.heartbeat_s > 0  # 0: the level sets no period, and the bridge's timer is enough

    def note_drive(self, payload: bytes) -> None:
        """Let media wait if a person's command moves the robot and the link is thin."""
        with suppress(PayloadError):
            command: Drive = codec.decode(DRIVE, payload)
            if self._meter.level == "thin" and command.moves and command.source != SCRIPT:
                self._hold.note_drive(self._clock())

    def _drop_late(self) -> None:
        """Connect again if so many late commands come that a stop would wait behind them in the broker's queue.

        This drops the commands that wait there: they would be useless by the time they come. From then on stops have a
        connection of their own.
        """
        late, now = self._late, self._clock()
        is_flood = self._meter.level == "thin" and late.count >= _LATE and late.seconds(now) >= _LATE_S
        if is_flood and now - self._flooded_at >= RENEW_S:
            late.count = 0
            self._flooded_at = now
            self._remote.renew_connection("only late commands come over a thin link: those that wait there are dropped")

    def _suit(self, now: float) -> None:
        """Adapt to a new level, or to a queue that has formed or drained."""
        self._suit_transport()
        stream_hz = (self.level.stream_hz or 0.0) * (_CROWDED_STREAMS if self._meter.crowded else 1)
        self._sieve.stream_s = 1 / stream_hz if stream_hz else 0.0
        self._sifter.use(None if self._meter.level == "wide" else self._sieve)
        self._report.publish(now)

    def _suit_transport(self) -> None:
        self._remote.suit_link(thin=self._meter.level != "wide")

    def _takes(self, rank: Rank, size: int) -> bool:
        with self._guard:
            return self._room.takes(rank, size, self._clock())

    def _report_shed(self) -> None:
        shed = self._forwarder.counters["shed"]
        if shed > self._shed:
            self._quiet_log.warning(
                "shed", "the link to the remote broker has no room: older values were not sent", times=shed - self._shed
            )
            self._shed = shed
