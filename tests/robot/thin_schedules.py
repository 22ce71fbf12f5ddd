"""Random schedules of a robot behind a thin link: two people drive, take over and stop, while it has much to report.

``python -m tests.kit.schedules thin``. Bridge and motor owner are the real services, in virtual time; the link carries
bytes in order, so that what is sent waits behind what is on its way. Rules, beside those of the wheels:

* A stop that has come through the link has the wheels at rest at once, whatever comes with it.
* Its confirmation waits behind a bounded number of bytes, and so does who has control.
* Of each state and stream the operators have the newest value once the link is at rest, and none goes back to an older
  one.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from functools import partial
from math import inf
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec

from pebble.config import Config, load
from pebble.contract import CONTROL, CONTROL_STATE, CONTROL_TAKE, DRIVE, ESTOP, ESTOP_STATE, LINK, codec
from pebble.contract.levels import LEVELS
from pebble.extensions.operator.client.estop_states import Reset, RobotEstop
from pebble.services.mqtt_bridge import service as bridge_module
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.transports import Answer, Message, Outgoing, QoS
from tests.kit.schedules import Engine, Outcome, RandomSteps, Steps, perform_steps, shared
from tests.robot.lockstep.commands import PERSON, Command, Commands
from tests.robot.lockstep.network import Connection, Network
from tests.robot.lockstep.owner import Disk, Owner, Wheels
from tests.robot.lockstep.processes import Process, ServiceProcess
from tests.robot.lockstep.rules import WheelRules
from tests.robot.lockstep.scheduler import Scheduler

BASE = "pebble/robots/rover"
STATES = ("status", "autonomy-status", "charging-status")
CONFIRMATIONS = [one.topic(BASE, owner="serial") for one in (ESTOP_STATE, CONTROL_STATE)]
STREAMS = ("sensors/imu", "touch-sensors", "wheel-odometry")
AT_ONCE_S = 0.01  # from the arrival of a stop to wheels at rest
_BEGUN = 10_005.0  # by then the bridge forwards
_WAITS_S = (0.0, 0.0, 0.0, 0.01, 0.05, 0.2, 0.5, 1.0, 2.5)
_KBITS = (9.6, 9.6, 19.2, 64.0)
_TRAVEL_S = 0.3
_HEADERS = 66  # bytes of each packet
#: Bytes that a confirmation may wait behind, by config: what may be on its way, and what cannot wait either. Where the
#: rate is not known that is learned, and where the level is not, all is sent until it is.
_AHEAD = (12_000, 4_000, inf)
_REST_S = 10.0  # until what has waited for room is sent
_LONGEST = 11_000.0
_LAST_S = 4.0  # for what the last stop that came has caused
_FLOOD_S, _FLOODS = 0.05, 30
_SIZES = (200, 20, 600)  # there may be room for a newer value that is shorter


class Uplink(Connection):
    """The bridge's connection, which knows what is on its way."""

    @property
    def outgoing(self) -> Outgoing:
        return Outgoing(self.network.up.waiting(2 * _TRAVEL_S), 2 * _TRAVEL_S)  # type: ignore[attr-defined]

    @property
    def answer(self) -> Answer | None:
        queue_s = self.network.up.queue_s + self.network.down.queue_s  # type: ignore[attr-defined]
        return Answer(round(self.network.scheduler.now), 2 * _TRAVEL_S + queue_s, queue_s)


class Way:
    """One direction of the link: bytes in order."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self.kbit = 64.0
        self._free_at = 0.0
        self._sent: list[tuple[float, int]] = []  # when each message has passed, and its size

    @property
    def queue_s(self) -> float:
        return max(0.0, self._free_at - self._scheduler.now)

    @property
    def ahead(self) -> int:
        """Bytes that the next message has to wait for."""
        return sum(size + _HEADERS for at, size in self._sent if at > self._scheduler.now)

    def carry(self, message: Message) -> float:
        """When it arrives."""
        size = len(message.topic) + len(message.payload)
        self._free_at = max(self._free_at, self._scheduler.now) + (size + _HEADERS) / self.kbit / 125
        self._sent.append((self._free_at, size))
        return self._free_at + _TRAVEL_S

    def waiting(self, round_trip_s: float) -> int:
        """Bytes whose acknowledgement has not come back."""
        self._sent = [(at, size) for at, size in self._sent if at + round_trip_s > self._scheduler.now]
        return sum(size for _, size in self._sent)


class Link(Network):
    """The remote broker: what bridge and people send each other passes the link."""

    def __init__(self, scheduler: Scheduler, *noted: Any) -> None:
        super().__init__(scheduler, *noted)
        self.up, self.down = Way(scheduler), Way(scheduler)
        self._up_at = 0.0

    def distribute(self, message: Message, publisher: Any) -> None:
        if isinstance(publisher, Uplink):
            self.published(publisher.process, message)
            self._up_at = self.up.carry(message)
        super().distribute(message, publisher)

    def _send(self, delivery: Any, client: Connection, number: int, sender: Process | None) -> None:
        if isinstance(client, Uplink):
            at = self.down.carry(delivery.message)
        else:
            at = self._up_at if isinstance(delivery.publisher, Uplink) and delivery.only is None else 0.0
        self.scheduler.at(at, lambda: client.process.do(lambda: client.arrive(delivery, number)))


class Bridge(ServiceProcess):
    def __init__(self, inside: Network, link: Link, config: Config) -> None:
        super().__init__("bridge", inside.scheduler, lambda process: self._service(inside, link, config))

    def _service(self, inside: Network, link: Link, config: Config) -> MqttBridge:
        with patch.object(bridge_module, "remote_transport", lambda *_arguments, **_options: Uplink(self, link)):
            return MqttBridge(config, Connection(self, inside), clock=self.scheduler.clock)


class Program(Process):
    """A program of the robot, or a person: what it publishes, and the newest it has received of each topic."""

    def __init__(self, name: str, network: Network, listens: str) -> None:
        super().__init__(name, network.scheduler)
        self.alive = True
        self.newest: dict[str, bytes] = {}
        self._connection = Connection(self, network).open(0.0)
        self._connection.subscribe(f"{BASE}/{listens}", self.receive, direct=True)

    def receive(self, message: Message) -> None:
        self.newest[message.topic.removeprefix(f"{BASE}/outgoing/")] = message.payload

    def publish(self, topic: str, value: Any, *, qos: QoS = QoS.DELIVERED, retain: bool = False) -> None:
        self._connection.publish(topic, msgspec.json.encode(value), qos=qos, retain=retain)


class Person(Program):
    """Drives as often as the robot says, with the key of control if it has it, in virtual time."""

    def __init__(self, number: int, network: Network, commands: Commands) -> None:
        super().__init__(f"person-{number}", network, "outgoing/#")
        self.id = f"{number:08x}"
        self.robot = RobotEstop(BASE)
        self.drives = self.wants = False
        self._commands = commands
        self._asked_at = -10.0
        self._go_on()

    def receive(self, message: Message) -> None:
        super().receive(message)
        self.robot.receive(message)

    def request(self, channel: Any, want: str = "hold") -> None:
        self.wants, self._asked_at = want == "hold", self.scheduler.now
        self.publish(channel.topic(BASE), {"want": want, "id": self.id, "by": self.name, "for_ms": 10_000})

    def drive(self) -> None:
        command = Command(PERSON, self.name, self.scheduler.now, 0.75, may_move=True)
        x, z = self._commands.add(command)
        state = codec.decode(CONTROL_STATE, self.newest.get("control/serial", b'{"t":0}'))
        key = {"key": state.key} if state.id == self.id else {}
        self.publish(DRIVE.topic(BASE), {"x": x, "z": z, "valid_ms": 750, **key}, qos=QoS.LATEST)

    def zero(self) -> None:
        self.drives = False
        self.publish(DRIVE.topic(BASE), {"x": 0, "z": 0})

    def stop(self, name: str) -> None:
        self.drives = False
        self.publish(ESTOP.topic(BASE), {"stop": name, "by": self.name})

    def reset(self) -> None:
        for message in Reset(self.robot, self.name).messages():
            self._connection.publish(message.topic, message.payload, qos=QoS.DELIVERED)

    def _go_on(self) -> None:
        link = self.newest.get("link")
        level = LEVELS["wide" if link is None else codec.decode(LINK, link).level]
        if self.wants and self.scheduler.now - self._asked_at >= 1.0:
            self.request(CONTROL)
        if self.drives:
            self.drive()
        self.scheduler.after(1 / level.drive_hz, self._go_on)


class Folder:
    """The files of a robot, and its configs: thin, of a known rate, and measured; worlds share them."""

    def __init__(self) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="pbl")
        folder = Path(self._temporary.name)
        self.configs = [
            self._config(folder, number, link)
            for number, link in enumerate(({"profile": "thin"}, {"profile": "thin", "kbit": 9.6}, {"profile": "auto"}))
        ]

    def _config(self, folder: Path, number: int, link: dict[str, Any]) -> Config:
        services = {
            "serial_mcu_bridge": {"enabled": True, "serial": {"port": str(folder / "tty")}},
            "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}, "link": link},
        }
        transport = {"kind": "mqtt", "state_dir": str(folder / "state"), "run_dir": str(folder / "run")}
        raw = {"robot": {"id": "rover"}, "transport": transport, "local_mqtt": {"host": "127.0.0.1"}}
        path = folder / f"{number}.json"
        path.write_text(json.dumps({**raw, "services": services}))
        return load(path)


class World:
    """``layout`` chooses the config and the rate of the link."""

    def __init__(self, layout: int, folder: Folder) -> None:
        self.scheduler = scheduler = Scheduler(10_000.0)
        config = folder.configs[layout % 3]
        self._bound = _AHEAD[layout % 3]
        self.commands, self.wheels, disk = Commands(), Wheels(scheduler), Disk()
        self.inside = Network(scheduler, self._arrived, self._published)
        self.link = Link(scheduler, lambda *_: None, self._leaves)
        self.owner = Owner(self.inside, config, disk, self.wheels)
        self.wheel_rules = WheelRules(self.owner, self.commands, scheduler)
        self.bridge = Bridge(self.inside, self.link, config)
        self.robot = Program("robot", self.inside, "outgoing/#")
        self.people = [Person(number, self.link, self.commands) for number in (1, 2)]
        self.counts = Counter[str]()
        self._numbers: dict[str, int] = {}  # the newest of each state and stream at the robot,
        self._seen: dict[str, int] = {}  # and of what has left it
        self._stops = self._samples = 0
        self._owed: dict[bytes, float] = {}  # confirmations that have not left the robot, and since when
        self.owner.start()
        self.bridge.start()
        scheduler.run(5.0)
        self.link.up.kbit = self.link.down.kbit = _KBITS[layout // 3 % len(_KBITS)]
        for state in STATES:
            self._report(state)
        scheduler.run(5.0)

    # -- rules

    def _arrived(self, process: Process, message: Message) -> None:
        if process is self.owner:
            self.wheel_rules.arrived(message)
            if message.topic == ESTOP.topic(BASE):
                self.counts["stops"] += 1
                self.scheduler.after(AT_ONCE_S, self._rests)

    def _rests(self) -> None:
        self.scheduler.check(self.wheels.speeds is None, "the wheels turn after a stop has come")

    def _published(self, process: Process, message: Message) -> None:
        if message.topic in CONFIRMATIONS and self.scheduler.now > _BEGUN:
            published = self._owed[message.payload] = self.scheduler.now
            self.scheduler.after(AT_ONCE_S, lambda: self._has_left(message.payload, published))

    def _has_left(self, payload: bytes, published: float) -> None:
        self.scheduler.check(self._owed.get(payload) != published, "a confirmation waits in the robot")

    def _leaves(self, process: Process, message: Message) -> None:
        metric = message.topic.removeprefix(f"{BASE}/outgoing/")
        if message.topic in CONFIRMATIONS:
            self._owed.pop(message.payload, None)
            self.counts["confirmations"] += 1
            self.scheduler.check(self.link.up.ahead < self._bound, "a confirmation waits behind what could wait")
        elif metric in (*STATES, *STREAMS):
            number = json.loads(message.payload)["n"]
            self.scheduler.check(number >= self._seen.get(metric, 0), "an older value follows a newer one")
            self._seen[metric] = number

    def rest(self) -> None:
        """Nothing more is published: the link comes to rest, and all is known."""
        for person in self.people:
            person.drives = person.wants = False
        self.scheduler.run(_REST_S)
        while self._is_busy and self.scheduler.now < _LONGEST:
            self.scheduler.run(_REST_S)
        self.scheduler.run(_LAST_S)
        self.scheduler.check(self._seen == self._numbers, "the newest value is lost")
        self.scheduler.check(self.wheels.speeds is None, "the wheels turn though nobody drives")
        mine, theirs = (one.newest.get("estop/serial") for one in (self.robot, self.people[0]))
        self.scheduler.check(mine == theirs, "the people do not know whether the robot is stopped")

    @property
    def _is_busy(self) -> bool:
        return self.link.up.queue_s + self.link.down.queue_s > 1.0 or self._seen != self._numbers

    # -- steps

    def do_wait(self, a: int, b: int) -> None:
        self.scheduler.run(_WAITS_S[b % len(_WAITS_S)])

    def do_drive(self, a: int, b: int) -> None:
        self.people[a % 2].drives = True

    def do_zero(self, a: int, b: int) -> None:
        self.people[a % 2].zero()

    def do_take(self, a: int, b: int) -> None:
        self.people[a % 2].request(CONTROL_TAKE)

    def do_ask(self, a: int, b: int) -> None:
        self.people[a % 2].request(CONTROL)

    def do_release(self, a: int, b: int) -> None:
        self.people[a % 2].request(CONTROL, want="release")

    def do_stop(self, a: int, b: int) -> None:
        """One stops while the other goes on; sometimes what both have sent arrives with it."""
        self._stops += 1
        if b % 3 == 0:
            self.people[(a + 1) % 2].request(CONTROL_TAKE)
            self.people[(a + 1) % 2].drive()
        self.people[a % 2].stop(f"{self._stops:016x}")
        if b % 2 == 0:
            self.people[(a + 1) % 2].drive()

    def do_reset(self, a: int, b: int) -> None:
        self.people[a % 2].reset()

    def do_report(self, a: int, b: int) -> None:
        """States change, many times."""
        for number in range(1 + b % 20):
            size = _SIZES[(b + number) % len(_SIZES)]
            self.scheduler.after(number * _FLOOD_S, partial(self._report, STATES[a % len(STATES)], size))

    def do_flood(self, a: int, b: int) -> None:
        """Streams of sensors, and a program of somebody's."""
        for number in range(_FLOODS):
            self.scheduler.after(number * _FLOOD_S, lambda: self._stream(b))

    def do_squeeze(self, a: int, b: int) -> None:
        self.link.up.kbit = self.link.down.kbit = _KBITS[b % len(_KBITS)]

    def _report(self, state: str, size: int = 200) -> None:
        number = self._numbers[state] = self._numbers.get(state, 0) + 1
        self.robot.publish(f"{BASE}/outgoing/{state}", {"n": number, "value": "x" * size}, retain=True)

    def _stream(self, b: int) -> None:
        self._samples += 1
        self._numbers.update(dict.fromkeys(STREAMS, self._samples))
        for stream in (*STREAMS, *(f"programs/p{number}" for number in range(b % 5))):
            value = {"n": self._samples, "value": "x" * 150}
            self.robot.publish(f"{BASE}/outgoing/{stream}", value, qos=QoS(b % 2))


def _perform(folder: Folder, schedule: Steps) -> Outcome:
    layout, steps = schedule
    world = World(layout, folder)
    perform_steps(world, steps)
    world.rest()
    return Outcome(counts=dict(world.counts))


ENGINE = Engine(
    draw=RandomSteps(
        {"wait": 20, "drive": 6, "zero": 3, "take": 6, "ask": 2, "release": 2, "stop": 6, "reset": 5, "report": 8,
         "flood": 8, "squeeze": 2},
        length=24,
        layouts=12,
        begin=[("take", 0, 0), ("drive", 0, 0), ("wait", 0, 7), ("flood", 0, None)],
    ),
    world=lambda _kind: shared(Folder()),
    perform=_perform,
    schedules=1_000,
)  # fmt: skip
