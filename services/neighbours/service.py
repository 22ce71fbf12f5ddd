"""The service between a robot and the hub of its LAN: shares its messages, and lets others' scripts drive it."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec

from pebble.config import Config
from pebble.contract import (
    CAPABILITIES,
    DRIVE,
    ESTOP_STATE,
    FROM_NEIGHBOUR,
    NEIGHBOUR_VALUE,
    NEIGHBOURS,
    OUTGOING,
    TO_NEIGHBOUR,
    channel_of,
    codec,
)
from pebble.contract.identity import Identity
from pebble.contract.payloads import LAST_RUN, Drive, Neighbours
from pebble.errors import PebbleError
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.scripts.runs import LocalScriptsLock, next_run
from pebble.extensions.scripts.script.neighbour import PRESENT_S
from pebble.motion.arbiter import newer
from pebble.runtime.addresses import Addresses
from pebble.runtime.connections import client_of_hub
from pebble.runtime.process import view_of
from pebble.runtime.service import WAIT_LIMIT_S, Service, every, on
from pebble.runtime.whole_file import make_folder, write
from pebble.services.neighbours.config import Neighbours as NeighboursSection
from pebble.services.neighbours.visit import Visit
from pebble.transports import Message, QoS, Transport, create

HEARTBEAT_S = 0.25
MOST_BYTES = 16 * 1024  # of a message of another robot

_decode = msgspec.json.Decoder(dict[str, Annotated[int, msgspec.Meta(gt=0, le=LAST_RUN)]]).decode


class NeighboursService(Service):
    """The service of one robot for its neighbours. ``lan`` replaces the connection to the hub in tests."""

    name = "neighbours"

    def __init__(self, *arguments: Any, lan: Transport | None = None, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._section = self.config.section(NeighboursSection)
        self._me = me = self.config.identity
        #: As the process of the first motor board uses them: the config of its serial line may rename topics.
        self.addresses = Addresses(view_of(self.config, next(iter(self.config.motor_lines()), "")))
        self._lan = lan or _lan_transport(self.config)
        self._others = {name: Identity(me.system, me.type, name) for name in self._section.listens}
        self._local = LocalScriptsLock(self.config)
        self._estop = RobotEstop(self.config.base)
        # `begin` without its last two arguments, another robot and its run.
        begins = partial(begin, self.config.state_file("neighbour-runs"), self._section.commanded)
        self._visit = Visit(begins, self._number, partial(self.publish, DRIVE), self._local_runs)
        self._received_at: dict[str, float] = {}  # by robot: when its state came last, which shows its presence
        self._state: Neighbours | None = None  # as published to operators last

    def start(self) -> None:
        self._lan.open(timeout=0.0)
        self.on_stop(self._lan.close)

    def set_up(self) -> None:
        super().set_up()
        for channel in (ESTOP_STATE, CAPABILITIES):
            self.transport.subscribe(channel.filter(self.config.base), self._on_owner, direct=True)
        for metric in self._section.shares:
            declared = channel_of(f"{OUTGOING}/{metric}")
            topic = self._me.outgoing(metric) if declared is None else self.addresses[declared].topic
            self.transport.subscribe(topic, partial(self._share, metric), direct=True)
        for name, granted in self._section.commanded.items():
            if DRIVE.metric in granted:
                receive = self.refusals.reader(FROM_NEIGHBOUR, self._on_command)
                self._lan.subscribe(FROM_NEIGHBOUR.topic(self._me.base, robot=name), receive, direct=True)
        for name, metrics in self._section.listens.items():
            for metric in dict.fromkeys((NEIGHBOURS.metric, *metrics)):
                topic = self._others[name].outgoing(metric)
                self._lan.subscribe(topic, partial(self._receive, name, metric), direct=True)

    def stop(self) -> None:
        self._visit.end("its neighbours were switched off", self.clock())

    # -- to the others

    def _share(self, metric: str, message: Message) -> None:
        """Share a message that other robots may hear, unchanged, on the transport's thread; never an old value."""
        if not message.retain:
            self._lan.publish(self._me.outgoing(metric), message.payload, qos=QoS.LATEST)

    @every(HEARTBEAT_S)
    def _announce(self) -> None:
        """Publish this robot's state: to the hub repeatedly, to operators when it changes."""
        now = self.clock()
        state = Neighbours(
            shares=list(self._section.shares),
            commanded={name: list(granted) for name, granted in self._section.commanded.items()},
            receives={name: self._is_present(name, now) for name in self._others},
            driven_by=self._visit.driver(now),
            refused=self._visit.refused(now),
        )
        self._lan.publish(self._me.outgoing(NEIGHBOURS.metric), codec.encode(NEIGHBOURS, state), qos=QoS.LATEST)
        if state != self._state:
            self._state = state
            self.publish(NEIGHBOURS, state)

    @on(TO_NEIGHBOUR, direct=True)
    def to_neighbour(self, drive: Drive, arrived: float, robot: str) -> None:
        """Send a command of a script on this robot to another robot, on the transport's thread."""
        if robot not in self._others or not drive.signed:
            self.counters.add("refused")
            return
        now = self.clock()
        if drive.moves and (now - arrived > WAIT_LIMIT_S or not self._is_present(robot, now)):
            self.counters.add("late")
            return
        topic = FROM_NEIGHBOUR.topic(self._others[robot].base, robot=self._me.id)
        self._lan.publish(topic, codec.encode(FROM_NEIGHBOUR, drive), qos=QoS.DELIVERED, urgent=True)

    # -- from the others

    def _receive(self, name: str, metric: str, message: Message) -> None:
        """Handle a message that another robot shares, on the transport's thread."""
        if message.retain or len(message.payload) > MOST_BYTES:
            self.counters.add("refused")
            return
        if metric == NEIGHBOURS.metric:
            self._received_at[name] = self.clock()
        topic = NEIGHBOUR_VALUE.topic(self._me.base, robot=name, metric=metric)
        self.transport.publish(topic, message.payload, qos=QoS.LATEST)

    def _on_command(self, message: Message, drive: Drive, names: dict[str, str]) -> None:
        """Handle another robot's drive command, on the transport's thread."""
        if not message.retain_requested:
            job = partial(self._command, names["robot"], message, drive)
            self.post_message(FROM_NEIGHBOUR, job, newest_of=message.topic)

    def _command(self, name: str, message: Message, drive: Drive) -> None:
        if drive.moves and message.waited_s > WAIT_LIMIT_S:
            self.count_late(FROM_NEIGHBOUR)
        elif not self._visit.command(name, drive, self.clock()):
            self.counters.add("refused")
        self._set_timer()

    # -- what happens on this robot

    def _on_owner(self, message: Message) -> None:
        """Handle the state of a motor owner, on the transport's thread."""
        if self._estop.receive(message):
            self.post(self._owners_changed, newest_of="owners")

    def _owners_changed(self) -> None:
        self._visit.owners(self._estop.states, self.clock())
        self._set_timer()

    @on(DRIVE, direct=True)
    def drive(self, drive: Drive, _arrived: float) -> None:
        """Handle a drive command to this robot, on the transport's thread; any command of a person ends a visit."""
        self.post(lambda: self._visit.received(drive, self.clock()), newest_of="script" if drive.signed else "person")

    # -- what a visit needs

    def _number(self, barred: int, received: int) -> int | None:
        """Return a number here for another robot's run; None if this robot's script runs, or no number can be made.

        ``barred`` and ``received``: runs, of which it must be newer; see `next_run`.
        """
        with self._local.none_runs() as free:
            try:
                return next_run(self.config, barred, received) if free else None
            except PebbleError as error:
                self.log_limited.log("number", 30, "%s", error)  # a warning
                return None

    def _local_runs(self) -> bool:
        with self._local.none_runs() as free:
            return not free

    def _set_timer(self) -> None:
        if (due := self._visit.due) is not None:
            self.call_at(due, lambda: self._visit.tick(self.clock()))

    def _is_present(self, name: str, now: float) -> bool:
        return now - self._received_at.get(name, float("-inf")) <= PRESENT_S


def _lan_transport(config: Config) -> Transport:
    """Return the connection to the hub of the LAN, not yet opened."""
    lan = config.section(NeighboursSection).lan
    settings = client_of_hub(config.run_dir() / "lan", lan, lan.lease_ms, lan.account)
    return create("zenoh", f"{config.base}-lan", settings)


def begin(path: Path, names: Collection[str], name: str, run: int) -> str:
    """Note that this run of robot ``name`` begins; return why it must not, or "". A run begins only once.

    ``path`` holds the newest run of each of ``names``, the robots that may begin any. If the file cannot be read or
    written, no run begins until it can: otherwise a run that a person has stopped would continue after a restart.
    """
    try:
        newest = _decode(path.read_bytes())
    except FileNotFoundError:
        newest = {}
    except (OSError, msgspec.MsgspecError) as error:
        why = getattr(error, "strerror", None) or "it is damaged"
        return f"{path} cannot be read ({why}): delete it while the scripts of other robots are stopped"
    if not newer(run, newest.get(name, 0)):
        return "it was ended here: start it again"
    newest = {other: last for other, last in newest.items() if other in names} | {name: run}
    try:
        make_folder(path.parent)
        write(path, msgspec.json.encode(newest), 0o600, PebbleError)
    except (OSError, PebbleError) as error:
        return f"its beginning cannot be written: {error}"
    return ""
