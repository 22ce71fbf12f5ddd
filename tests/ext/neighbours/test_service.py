"""Two robots' services and a script between them, on networks inside this process; what is refused in configs."""

from __future__ import annotations

import itertools
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from pebble.config import Config, Mqtt, parse
from pebble.config.raw import deep_merge
from pebble.contract import DRIVE, ESTOP_STATE, FROM_NEIGHBOUR, WHEEL_ODOMETRY, codec
from pebble.contract.payloads import SCRIPT, Drive, EstopState, WheelOdometry
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.scripts.runs import LocalScriptsLock
from pebble.extensions.scripts.script import NotGrantedError, Robot, Stopped
from pebble.extensions.scripts.script.neighbour import PRESENT_S
from pebble.motion.arbiter import PERSON, Arbiter
from pebble.motion.latch import Latch
from pebble.motion.lease import Lease
from pebble.services.neighbours.board import of_board
from pebble.services.neighbours.config import Neighbours as NeighboursSection
from pebble.services.neighbours.service import HEARTBEAT_S, MOST_BYTES, NeighboursService, begin
from pebble.services.neighbours.visit import Visit
from pebble.transports import Message, QoS, Transport, clock
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.robot import Listener, Running
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
        self.hub, self.drives = MemoryHub(), list[Drive]()
        self.world = Listener(MemoryTransport("client", self.hub), self.config.base)
        self.client, self.base = self.world.transport, self.config.base
        stack.callback(self.client.close)
        self.owner(FREE)
        self.client.subscribe(DRIVE.topic(self.base), self._on_drive, direct=True)
        transport = MemoryTransport("neighbours", self.hub)
        stack.callback(Running(NeighboursService(self.config, transport, lan=lan)).stop)

    def owner(self, state: EstopState) -> None:
        """Publish the state of its motor owner."""
        self.client.publish(ESTOP_STATE.topic(self.base, owner="wheels"), codec.encode(ESTOP_STATE, state), retain=True)

    def _on_drive(self, message: Message) -> None:
        self.drives.append(codec.decode(DRIVE, message.payload))


class Pair:
    """goob drives fred and receives from it."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.lan = lan = Lan()
        self.stranger = MemoryTransport("stranger", lan).open()
        shared, granted = {"shares": ["wheel-odometry"]}, {"commanded": {"goob": ["drive-values"]}}
        self.fred = One(folder / "fred", MemoryTransport("fred-lan", lan), "fred", stack, **shared, **granted)
        listens = {"fred": ["wheel-odometry"], "carl": []}
        self.goob = One(folder / "goob", MemoryTransport("goob-lan", lan), "goob", stack, listens=listens)
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
        pair.fred.client.publish(WHEEL_ODOMETRY.topic(pair.fred.base), odometry)
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
    pair.goob.owner(replace(FREE, latched=True, count=1))
    assert until(lambda: not pair.fred.drives[-1].moves)
    with pytest.raises(Stopped):
        fred.drive(z=0.4)


def test_a_script_learns_why_its_commands_have_no_effect(pair: Pair) -> None:
    fred = pair.robot.neighbour("fred")
    assert fred.drive(z=0.4)
    pair.fred.world.command("drive-values", {"z": 0})
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
    for metric in ("from/goob/drive-values", "to/fred/drive-values"):
        pair.fred.client.publish(f"{pair.fred.base}/incoming/{metric}", codec.encode(FROM_NEIGHBOUR, signed))
    pair.lan.behind_s = 0.6
    pair.send(signed)
    pair.lan.behind_s = 0.0
    local = LocalScriptsLock(pair.fred.config)
    local.hold()
    pair.send(signed)
    assert until(lambda: "its own" in str(pair.fred.world.newest("neighbours")))
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
    assert pair.goob.world.became("neighbours", receives={"fred": True, "carl": False})
    pair.robot.neighbour("fred").drive(z=0.4)
    assert pair.fred.world.became("neighbours", driven_by="goob", commanded={"goob": ["drive-values"]})
    assert 3 * HEARTBEAT_S < PRESENT_S, "two lost messages leave it present"


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


# -- what of another robot's script moves this one: histories in virtual time, with the arbiter of the motor owners


NAMES = ("goob", "ann")
STEP_S, LONG_S = 0.05, 60.0


class Fred:
    """A robot with one motor owner; goob's script drives it. ``moved`` are the senders whose commands moved it."""

    def __init__(self, folder: Path) -> None:
        self.now, self.file = 10.0, folder / "state" / "runs.json"
        self.local: int | None = None  # the run of its own script
        self.moved: list[str] = []
        self._boots, self._runs = itertools.count(1), itertools.count(100)
        self.restart()
        self.start_owner()
        self.wait(3)

    def restart(self) -> None:
        self.visit = Visit(partial(begin, self.file, NAMES), self._number, self.publish, lambda: self.local is not None)

    def start_owner(self) -> None:
        latch = Latch(f"boot{next(self._boots)}", 8, self._diff)
        lease = Lease(self._ms, self._diff, lambda count: "0badf00d"[: 2 * count], 0)
        self.owner = Arbiter(latch, lease, self._ms, self._diff, 750)
        self.publish_state()

    @staticmethod
    def _diff(later: int, earlier: int) -> int:
        return later - earlier

    @property
    def _ms(self) -> int:
        return int(1000 * self.now)

    def _number(self, _barred: int, _received: int) -> int | None:
        return next(self._runs) if self.local is None else None

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_S
            self.owner.tick(self._ms)
            self.publish_state()
            self.visit.tick(self.now)

    def publish_state(self) -> None:
        latch = self.owner.latch
        state = EstopState(**latch.state(True), barred=self.owner.barred)
        self.visit.owners({"wheels": state}, self.now)

    def publish(self, drive: Drive, sender: str = "neighbour") -> bool:
        run = drive.run if drive.signed else PERSON
        if self.owner.judge(drive.moves, run, drive.valid_ms if isinstance(drive.valid_ms, int) else -1, self._ms) > 0:
            self.moved.append(sender)
        self.visit.received(drive, self.now)
        self.publish_state()
        return True

    # -- what happens

    def goob(self, run: int = 7, seconds: float = 1.0, *, name: str = "goob", z: float = 0.5) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.visit.command(name, Drive(z=z, source=SCRIPT, run=run), self.now)
            self.wait(STEP_S)

    def person(self, z: float = 0.0) -> None:
        self.publish(Drive(z=z), "person")

    def drives_and_lets_go(self) -> None:
        self.person(0.3)
        self.wait(0.2)
        self.person()

    def script(self) -> None:
        """Its own is started: as the manager does it."""
        self.local = next(self._runs)
        self.publish(Drive(source=SCRIPT, run=self.local))

    def script_ended(self) -> None:
        self.script()
        self.wait(1)
        self.local = None

    def stopped_and_reset(self) -> None:
        self.owner.stop("0" * 16, "ann", "", 0)
        self.publish_state()
        self.wait(0.5)
        latch = self.owner.latch
        assert latch.reset(latch.boot, latch.count, 0, self._ms)
        self.publish_state()

    def unwritable(self) -> None:
        self.file.unlink()
        self.file.mkdir()

    def restart_unread(self) -> None:
        self.file.write_text("{")
        self.restart()


Happens = Callable[[Fred], None]


@pytest.fixture
def fred(tmp_path: Path) -> Fred:
    return Fred(tmp_path)


#: What ends goob's run at fred; whether a new start of its script moves fred after it.
ENDS: dict[str, tuple[Happens, bool]] = {
    "a person's zero": (Fred.person, True),
    "a person's zero between two commands, long after the last": (lambda fred: (fred.wait(1), fred.person())[1], True),
    "a person who drives and lets go": (Fred.drives_and_lets_go, True),
    "a person whose connection is lost": (lambda fred: fred.person(0.3), True),
    "an emergency stop and its reset": (Fred.stopped_and_reset, True),
    "a restart of the motor owner": (Fred.start_owner, True),
    "a restart of neighbours": (Fred.restart, True),
    "a script of fred's own": (Fred.script, False),
    "a script of fred's own that has ended": (Fred.script_ended, True),
    "a newer run of goob": (lambda fred: fred.goob(run=8), True),
    "a run of another robot": (lambda fred: fred.goob(run=1, name="ann"), True),
    "a damaged file at a restart": (Fred.restart_unread, False),
}


@pytest.mark.parametrize("what", ENDS)
def test_what_ends_a_run_ends_it_for_good_and_a_new_start_drives(fred: Fred, what: str) -> None:
    happens, drives_again = ENDS[what]
    fred.goob()
    assert set(fred.moved) == {"neighbour"}
    happens(fred)
    fred.moved.clear()
    fred.goob(seconds=LONG_S)
    assert fred.moved == []
    assert fred.visit.refused(fred.now)["goob"].run == 7
    fred.goob(run=9)
    assert bool(fred.moved) == drives_again


def test_a_damaged_file_of_runs_is_named_with_the_fix(tmp_path: Path) -> None:
    (file := tmp_path / "runs.json").write_text("{")
    assert begin(file, NAMES, "goob", 7).startswith(f"{file} cannot be read (it is damaged): delete it")


def test_fred_s_own_script_is_never_barred(fred: Fred) -> None:
    """Whichever started first, and however often goob's is started."""
    fred.goob()
    fred.script()
    for run in range(8, 20):
        fred.goob(run=run, seconds=0.2)
        fred.moved.clear()
        fred.publish(Drive(z=0.2, source=SCRIPT, run=fred.local), "own script")
        assert fred.moved == ["own script"]


#: What begins no run: a command of goob, and what happens before.
BEGINS_NOT: dict[str, tuple[Happens, Drive]] = {
    "no script": (lambda _: None, Drive(z=0.5)),
    "a script without a number": (lambda _: None, Drive(z=0.5, source=SCRIPT)),
    "a zero": (lambda _: None, Drive(source=SCRIPT, run=7)),
    "an older run": (lambda fred: fred.goob(run=8, seconds=STEP_S), Drive(z=0.5, source=SCRIPT, run=7)),
    "while a person drives": (lambda fred: fred.person(0.3), Drive(z=0.5, source=SCRIPT, run=7)),
    "while a script of its own runs": (Fred.script, Drive(z=0.5, source=SCRIPT, run=7)),
    "while what has begun cannot be written": (
        lambda fred: (fred.goob(run=6, seconds=STEP_S), fred.unwritable())[1],
        Drive(z=0.5, source=SCRIPT, run=7),
    ),
}


@pytest.mark.parametrize("what", BEGINS_NOT)
def test_what_begins_no_run(fred: Fred, what: str) -> None:
    happens, command = BEGINS_NOT[what]
    happens(fred)
    fred.moved.clear()
    assert not fred.visit.command("goob", command, fred.now)
    assert fred.moved == []


def test_a_zero_of_the_driver_stops_at_once_and_a_command_lasts_no_longer_than_a_third_of_a_second(fred: Fred) -> None:
    sent: list[Drive] = []
    number = itertools.count(1)
    visit = Visit(lambda *_: "", lambda *_: next(number), lambda one: not sent.append(one), lambda: False)
    for drive in (Drive(z=0.5, source=SCRIPT, run=7, valid_ms=5000, key="0badf00d"), Drive(source=SCRIPT, run=7)):
        assert visit.command("goob", drive, fred.now)
    assert [(one.z, one.run, one.valid_ms, one.key) for one in sent] == [
        (0.5, 1, 300, sent[0].key), (0.0, 1, 300, sent[0].key)
    ]  # fmt: skip
    assert not isinstance(sent[0].key, str)
    assert visit.command("goob", Drive(z=0.2, source=SCRIPT, run=7), fred.now)
    visit.tick(fred.now + 1)
    assert sent[-1].z == 0.2, "it came before its turn, and is sent then"


def test_only_the_user_of_a_gateway_reaches_the_sockets_of_a_board(tmp_path: Path) -> None:
    of_board("pebble/robots/lamp", NeighboursSection(), Mqtt(), tmp_path)
    assert [folder.stat().st_mode & 0o777 for folder in tmp_path.iterdir()] == [0o700]
