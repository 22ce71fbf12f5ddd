"""Two robots' services and a script between them, on networks inside this process; and what is refused in configs."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from pebble.config import Config, parse
from pebble.config.raw import deep_merge
from pebble.contract import DRIVE, ESTOP_STATE, FROM_NEIGHBOUR, NEIGHBOURS, WHEEL_ODOMETRY, codec
from pebble.contract.payloads import SCRIPT, Drive, EstopState, Neighbours, WheelOdometry
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.scripts.runs import LocalScripts
from pebble.extensions.scripts.script import NotGrantedError, Robot, Stopped
from pebble.services.neighbours.config import MOST_METRICS, MOST_NEIGHBOURS
from pebble.services.neighbours.service import MOST_BYTES, NeighboursService
from pebble.transports import Message, QoS, Transport, clock
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.robot import Running
from tests.support import until

FREE = EstopState(latched=False, boot="b1", count=0, recent=[], by="", why="", since=0)


class Lan(MemoryHub):
    """Messages have waited for ``behind_s`` when it hands them over."""

    behind_s = 0.0

    def now(self) -> float:
        return clock.since_boot() - self.behind_s


class One:
    """A robot: its local network, its program, and the drive commands on it."""

    def __init__(self, folder: Path, lan: Transport, name: str, stack: ExitStack, **section: Any) -> None:
        (folder / "run").mkdir(parents=True)
        raw = {
            "robot": {"id": name},
            "transport": {"kind": "mqtt", "run_dir": str(folder / "run"), "state_dir": str(folder / "state")},
            "services": {"neighbours": {"enabled": True, "lan": {"connect": ["tcp/127.0.0.1:1"]}, **section}},
        }
        self.config: Config = parse(raw, folder=folder, env={})
        self.base, self.hub, self.drives = self.config.base, MemoryHub(), list[Drive]()
        self.state = Neighbours()  # as operators see it
        self.client = MemoryTransport("client", self.hub).open()
        stack.callback(self.client.close)
        self.client.publish(ESTOP_STATE.topic(self.base, owner="wheels"), codec.encode(ESTOP_STATE, FREE), retain=True)
        self.client.subscribe(DRIVE.topic(self.base), self._on_drive, direct=True)
        self.client.subscribe(NEIGHBOURS.topic(self.base), self._on_state, direct=True)
        transport = MemoryTransport("neighbours", self.hub)
        self.service = NeighboursService(self.config, transport, lan=lan)
        stack.callback(Running(self.service).stop)

    def _on_drive(self, message: Message) -> None:
        self.drives.append(codec.decode(DRIVE, message.payload))

    def _on_state(self, message: Message) -> None:
        self.state = codec.decode(NEIGHBOURS, message.payload)

    def publish(self, metric: str, payload: bytes, **options: Any) -> None:
        self.client.publish(f"{self.base}/{metric}", payload, **options)


class Pair:
    """goob drives fred and receives from it."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.lan = lan = Lan()
        self.stranger = MemoryTransport("stranger", lan).open()
        shared, granted = {"shares": ["wheel-odometry"]}, {"commanded": {"goob": ["drive-values"]}}
        at_hub = {name: MemoryTransport(f"{name}-lan", lan) for name in ("fred", "goob")}
        self.fred = One(folder / "fred", at_hub["fred"], "fred", stack, **shared, **granted)
        listens = {"fred": ["wheel-odometry"], "carl": []}
        self.goob = One(folder / "goob", at_hub["goob"], "goob", stack, listens=listens)
        self.robot = Robot(self.goob.config, MemoryTransport("script", self.goob.hub).open(), lambda _above: 7)
        stack.callback(self.robot.close)

    def send(self, drive: Drive, name: str = "goob", metric: str = "drive-values", **options: Any) -> None:
        topic = f"{self.fred.base}/incoming/from/{name}/{metric}"
        self.stranger.publish(topic, codec.encode(DRIVE, drive), qos=QoS.DELIVERED, **options)

    def passed(self) -> None:
        """Wait until all that was sent before has arrived: goob's newest run drives."""
        self.send(Drive(z=0.01, source=SCRIPT, run=1000))
        assert until(lambda: any(one.z == 0.01 for one in list(self.fred.drives)))


@pytest.fixture
def pair() -> Iterator[Pair]:
    with tempfile.TemporaryDirectory(prefix="pbl") as folder, ExitStack() as stack:
        pair = Pair(Path(folder), stack)
        assert until(lambda: pair.robot.neighbour("fred").online)
        yield pair


def test_a_script_receives_from_and_drives_another_robot_and_stops_it_at_its_end(pair: Pair) -> None:
    fred = pair.robot.neighbour("fred")
    odometry = codec.encode(WHEEL_ODOMETRY, WheelOdometry(value={"x_mm": 5.0}, timestamp=0.0))

    def received() -> object:
        pair.fred.publish("outgoing/wheel-odometry", odometry)
        return fred.latest(WHEEL_ODOMETRY)

    assert until(received)
    assert fred.latest(WHEEL_ODOMETRY).value["x_mm"] == 5.0
    assert fred.drive(x=0.1, z=0.4)
    assert until(lambda: pair.fred.drives)
    first = pair.fred.drives[0]
    assert (first.x, first.z, first.source, first.valid_ms) == (0.1, 0.4, SCRIPT, 300)
    assert first.run != 7, "it is a number of fred's own"
    pair.robot.close()
    assert until(lambda: not pair.fred.drives[-1].moves)
    assert [one.moves for one in pair.goob.drives] == [False], "that of its own end"


def test_an_emergency_stop_of_the_sender_ends_what_it_drives_elsewhere(pair: Pair) -> None:
    fred = pair.robot.neighbour("fred")
    assert fred.drive(z=0.4)
    assert until(lambda: pair.fred.drives), "else the zero takes its place"
    stopped = replace(FREE, latched=True, count=1)
    topic = ESTOP_STATE.topic(pair.goob.base, owner="wheels")
    pair.goob.client.publish(topic, codec.encode(ESTOP_STATE, stopped), retain=True)
    assert until(lambda: not pair.fred.drives[-1].moves)
    with pytest.raises(Stopped):
        fred.drive(z=0.4)


def test_a_script_learns_why_its_commands_have_no_effect(pair: Pair) -> None:
    fred = pair.robot.neighbour("fred")
    assert fred.drive(z=0.4)
    pair.fred.publish("incoming/drive-values", b'{"z": 0}')
    assert until(lambda: "person" in fred.why_refused), fred.why_refused
    assert not fred.drive(z=0.4)
    with pytest.raises(PebbleError, match=r"'ann' is not in services.neighbours.listens"):
        pair.robot.neighbour("ann")
    assert not pair.robot.neighbour("carl").drive(z=0.1), "it is not heard"


def test_who_is_not_granted_learns_so(pair: Pair) -> None:
    state = json.dumps({"shares": [], "commanded": {"ann": ["drive-values"]}}).encode()
    carl = pair.robot.neighbour("carl")

    def present() -> bool:
        pair.stranger.publish("pebble/robots/carl/outgoing/neighbours", state)
        return carl.online

    assert until(present)
    with pytest.raises(NotGrantedError, match="carl does not let goob drive it"):
        carl.drive(z=0.1)


@pytest.mark.parametrize("name", ["ann", "fred", "goob/by", "-"])
def test_who_has_no_grant_moves_nothing(pair: Pair, name: str) -> None:
    for z in (0.5, 0.0):
        pair.send(Drive(z=z, source=SCRIPT, run=8), name)
    pair.passed()
    assert [one.z for one in pair.fred.drives] == [0.01]


def test_what_is_no_command_of_a_running_script_moves_nothing(pair: Pair) -> None:
    signed = Drive(z=0.5, source=SCRIPT, run=8)
    pair.send(signed, metric="lights-solid")
    pair.send(signed, retain=True)
    pair.send(Drive(z=0.5))
    pair.fred.publish("incoming/from/goob/drive-values", codec.encode(FROM_NEIGHBOUR, signed))
    pair.fred.publish("incoming/to/fred/drive-values", codec.encode(FROM_NEIGHBOUR, signed))
    pair.lan.behind_s = 0.6
    pair.send(signed)
    pair.lan.behind_s = 0.0
    local = LocalScripts(pair.fred.config)
    local.hold()
    pair.send(signed)
    assert until(lambda: "its own" in str(pair.fred.state.refused))
    local.release()
    pair.send(signed)
    pair.passed()
    assert [one.z for one in pair.fred.drives] == [0.01]


def test_nothing_old_or_large_is_received(pair: Pair) -> None:
    received: list[Message] = []
    pair.goob.client.subscribe(f"{pair.goob.base}/outgoing/neighbours/fred/wheel-odometry", received.append)
    topic = WHEEL_ODOMETRY.topic(pair.fred.base)
    pair.stranger.publish(topic, b"x" * (MOST_BYTES + 1))
    pair.stranger.publish(topic, b"{}")
    assert until(lambda: received)
    assert [one.payload for one in received] == [b"{}"]


def test_operators_see_who_receives_what_and_who_drives(pair: Pair) -> None:
    assert until(lambda: pair.goob.state.receives == {"fred": True, "carl": False})
    pair.robot.neighbour("fred").drive(z=0.4)
    assert until(lambda: pair.fred.state.driven_by == "goob")
    assert pair.fred.state.commanded == {"goob": ["drive-values"]}


# -- what is refused in `services.neighbours`

LAN = {"connect": ["tls/hub.lab:7447"]}
LISTENS = {"transport": {"kind": "zenoh", "listen": ["tcp/0.0.0.0:7447"]}}
BRIDGE = {"mqtt_bridge": {"enabled": True, "remote": {"kind": "zenoh", **LAN}}}
#: A section, what else the config has, and why it is refused.
WRONG: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"lan": {}}, {}, r"lan\.connect: is missing"),
    ({"lan": LAN | {"account": "goob-lan"}}, {}, r"lan\.account: needs tls\.client_cert"),
    ({"shares": ["front-camera"]}, {}, "front-camera cannot be shared"),
    ({"listens": {"fred": ["control/wheels"]}}, {}, "control/wheels cannot be shared"),
    ({"commanded": {"goob": ["estop-reset"]}}, {}, r'must be \["drive-values"\]'),
    ({"listens": {f"r{n}": [] for n in range(MOST_NEIGHBOURS + 1)}}, {}, "are the most"),
    ({"shares": [f"m{n}" for n in range(MOST_METRICS + 1)]}, {}, "are the most"),
    ({"lan": {"connect": ["tcp/hub.lab:7447"]}}, {"security": {"level": "login"}}, "is not encrypted"),
    ({"lan": {"connect": ["tcp/hub.lab:7447"]}}, {"security": {"level": "login"}}, r"lan\.account: is missing"),
    ({"lan": {"connect": ["tls/hub.lab:7447#x=1"]}}, {"services": BRIDGE}, r"also services\.mqtt_bridge\.remote\.conn"),
    ({"lan": {"connect": ["tcp/127.0.0.1:7447"]}}, LISTENS, r"is also transport\.listen"),
]


@pytest.mark.parametrize(("section", "more", "why"), WRONG)
def test_what_is_refused(section: dict[str, Any], more: dict[str, Any], why: str) -> None:
    raw = {"robot": {"id": "goob"}, "services": {"neighbours": {"enabled": True, "lan": LAN, **section}}}
    with pytest.raises(ConfigError, match=why):
        parse(deep_merge(raw, more), folder=Path("/"), env={})
