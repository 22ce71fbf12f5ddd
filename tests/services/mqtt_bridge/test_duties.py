"""What the bridge does besides: it vouches, reboots and restarts, and clears what a name of before has left."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pebble.config import SystemControl, load
from pebble.contract import CHANNELS, CONTROL_VOUCHED, GIT_PULL, REBOOT, Kind, codec
from pebble.forwarding.routing import Drop
from pebble.forwarding.side import Side
from pebble.runtime.parent import Notifier
from pebble.services.mqtt_bridge.motor_owners import MotorOwners
from pebble.services.mqtt_bridge.requests.actions import ACTIONS, LOOK_S, Action, Row
from pebble.services.mqtt_bridge.requests.earlier_names import CallIn, EarlierNames, keep_stops
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.mqtt_bridge.vouching import Vouching
from pebble.transports import Answer, Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.services.mqtt_bridge.bridge_rig import Client, MemoryRig
from tests.support import WAIT_S, Clock, until

START_S, PERIOD_S = 100.0, 0.5
VOUCHED = CONTROL_VOUCHED.suffix

#: Each half second: does it pass, what was lost, how old and how late the answer is (None: there is none); and from
#: when to when it vouches then.
GOOD = (True, 0, (0.2, 0.0))
HISTORIES: dict[str, tuple[tuple[Any, ...], ...]] = {
    "the first one proves nothing": ((*GOOD, (100.0, 100.0)), (*GOOD, (100.0, 100.3)), (*GOOD, (100.0, 100.8))),
    "a ping that is half a second late is prompt": ((*GOOD, (100.0, 100.0)), (True, 0, (0.4, 0.5), (100.0, 100.1))),
    "a ping that is later is not": (
        *((*GOOD, (100.0, 100.0)), (*GOOD, (100.0, 100.3)), (True, 0, (0.2, 0.501), (101.0, 101.0))),
        *((*GOOD, (101.0, 101.3)), (*GOOD, (101.0, 101.8))),
    ),
    "pictures on a thin link, or a broker that stalls: no answer comes": (
        *((*GOOD, (100.0, 100.0)), (True, 0, (0.7, 0.6), (100.5, 100.5)), (True, 0, (1.2, 1.1), (101.0, 101.0))),
        (*GOOD, (101.0, 101.3)),
    ),
    "an answer of before the beginning": ((*GOOD, (100.0, 100.0)), (True, 0, (3.0, 0.0), (100.0, 100.0))),
    "the newest answer is the one of before": (
        *((*GOOD, (100.0, 100.0)), (*GOOD, (100.0, 100.3)), (True, 0, (0.9, 0.0), (100.0, 100.3))),
    ),
    "something is lost": (
        *((*GOOD, (100.0, 100.0)), (True, 1, (0.2, 0.0), (100.5, 100.5)), (True, 1, (0.2, 0.0), (100.5, 100.8))),
    ),
    "a connection is lost": (
        *((*GOOD, (100.0, 100.0)), (False, 0, None, (100.5, 100.5)), (False, 0, (0.2, 0.0), (101.0, 101.0))),
        *((*GOOD, (101.5, 101.5)), (*GOOD, (101.5, 101.8))),
    ),
    "there is no answer yet": (
        *((True, 0, None, (100.0, 100.0)), (True, 0, None, (100.5, 100.5)), (*GOOD, (100.5, 100.8))),
    ),
}  # fmt: skip


class Remote:
    """What a transport knows."""

    answer: Answer | None = None


@pytest.mark.parametrize("name", HISTORIES)
def test_vouching(name: str) -> None:
    remote = Remote()
    vouching = Vouching(remote, START_S)  # type: ignore[arg-type]
    for number, (passes, losses, answer, vouched) in enumerate(HISTORIES[name]):
        remote.answer = None if answer is None else Answer(1, 0.0, None, *answer)
        shown = vouching.check(passes, losses, START_S + number * PERIOD_S)
        assert (shown.begin / 1000, shown.end / 1000) == vouched, number


def test_of_a_transport_that_asks_nothing_a_connection_that_lasts_is_prompt() -> None:
    vouching = Vouching(Remote(), START_S, 2.0)  # type: ignore[arg-type]
    vouched = [vouching.check(passes, 0, START_S + at) for at, passes in ((0, True), (1, True), (3, True), (4, False))]
    assert [(one.begin, one.end) for one in vouched] == [
        *((100_000, 100_000), (100_000, 100_000), (100_000, 101_000), (104_000, 104_000)),
    ]


#: What may be a loss on the way to the motor owners, as a bridge counts it.
LOSSES: dict[str, Callable[[MqttBridge, MemoryRig], None]] = {
    "too late": lambda bridge, _: bridge.forwarder.counters.add(f"{Side.REMOTE.value}: {Drop.LATE.value}"),
    "refused by the robot": lambda bridge, _: bridge.forwarder.counters.add(f"{Side.LOCAL.value}: refused"),
    "dropped on the robot": lambda bridge, _: bridge.transport.counters.add("dropped"),
    "an operator's broker of another time": lambda _, rig: restarted(rig.remote_hub),
    "a robot's broker of another time": lambda _, rig: restarted(rig.local_hub),
}


def restarted(hub: MemoryHub) -> None:
    hub.stop()
    hub.start()


@pytest.mark.parametrize("loss", LOSSES)
def test_after_a_loss_it_vouches_anew(monkeypatch: pytest.MonkeyPatch, loss: str) -> None:
    rig = MemoryRig(monkeypatch)
    serial = {"enabled": True, "serial": {"port": "/dev/null"}}
    bridge = rig.bridge(serial=serial, remote={"kind": "zenoh", "connect": ["tcp/127.0.0.1:7447"]})
    begins = lambda: [codec.decode(CONTROL_VOUCHED, payload).begin for payload in rig.local.payloads(VOUCHED)]  # noqa: E731
    assert until(lambda: len(begins()) > 1 and begins()[-1] == begins()[-2]), "it goes on to vouch from that time"
    before = begins()[-1]
    LOSSES[loss](bridge, rig)
    assert until(lambda: begins()[-1] > before)
    rig.close()


#: A motor owner is reached while its repeated state arrives; a retained one proves nothing.
#: Per second: m a message, c a new connection, . nothing.
CASES = {
    "nothing yet": ("." * 14, []),
    "never": ("." * 17, [False]),
    "one, perhaps retained": ("m" + "." * 13, []),
    "only a retained one": ("m" + "." * 20, [False]),
    "repeated": ("m....m....m....m", [True]),
    "then cut off": ("m....m" + "." * 20, [True, False]),
    "and back": ("m....m" + "." * 20 + "m", [True, False, True]),
    "a new connection with a retained one": ("m....m.cm" + "." * 12, [True, False]),
    "a new connection": ("m....mcm....m....m", [True]),
}


class Notes(Notifier):
    """Records reports; the launcher is too busy for the first one."""

    def __init__(self) -> None:
        super().__init__()
        self.reports: list[bool] = []
        self._busy = True

    def reaches(self, owner: str, reached: bool) -> bool:
        assert owner == "serial"
        busy, self._busy = self._busy, False
        self.reports += [] if busy else [reached]
        return not busy


@pytest.mark.parametrize(("seconds", "reports"), CASES.values(), ids=CASES)
def test_motor_owners(seconds: str, reports: list[bool]) -> None:
    notes = Notes()
    owners = MotorOwners("pebble/robots/goob", ["serial"], notes)
    (topic,) = owners.topics
    for now, second in enumerate(seconds):
        if second == "c":
            owners.connected()
        elif second == "m":
            owners.receive(topic)
        owners.check(float(now))
    assert notes.reports == reports


PYTHON = (sys.executable, "-c")
PULL = Row(GIT_PULL, "", 0.0)


@pytest.fixture
def make(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> Iterator[Callable[..., Action]]:
    """Make actions, and end the threads that look after their output."""
    caplog.set_level(logging.DEBUG)
    actions = list[Action]()

    def action(*words: str, row: Row = PULL, clock: Clock | None = None, **options: Any) -> Action:
        control = SystemControl(command=words, **options)
        actions.append(Action(row, control, folder=tmp_path, clock=clock or Clock()))
        return actions[-1]

    yield action
    for made in actions:
        made._process = None
    for thread in followers():
        thread.join(WAIT_S)


def followers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("action ")]


def finished(action: Action) -> bool:
    assert action.request()
    return until(lambda: not action.running)


def test_the_table_has_a_row_for_every_action_of_the_contract_with_its_cooldown() -> None:
    assert {row.channel for row in ACTIONS} == {channel for channel in CHANNELS if channel.kind is Kind.ACTION}
    assert [(row.section, row.cooldown_s) for row in ACTIONS] == [
        ("reboot_control", 30), ("service_restart_control", 10), ("git_pull_control", 60)
    ]  # fmt: skip


def test_a_cooldown_begins_with_the_first_run_and_not_with_the_machine(
    make: Callable[..., Action], caplog: pytest.LogCaptureFixture
) -> None:
    clock = Clock()
    clock.now = 0.0
    action = make(*PYTHON, "pass", row=Row(REBOOT, "", 30.0), clock=clock)
    assert finished(action)
    clock.now = 29.9
    assert not action.request()
    assert "refused: it ran 30 s ago" in caplog.text
    clock.now = 30.0
    assert finished(action)


def test_refused_while_it_runs(make: Callable[..., Action], tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    action = make(*PYTHON, f"import os\nwhile not os.path.exists({str(gate)!r}): pass")
    assert action.request()
    assert not action.request()
    assert [thread.daemon for thread in followers()] == [True], "a bridge ends before the command that restarts it does"
    gate.touch()
    assert until(lambda: not action.running)
    assert finished(action)


def test_runs_without_a_shell_in_its_folder_with_its_environment(make: Callable[..., Action], tmp_path: Path) -> None:
    code = "import os, sys; open('said', 'w').write(os.environ['MARK'] + sys.argv[1])"
    assert finished(make(*PYTHON, code, "; touch oops $MARK", cwd=tmp_path, env={"MARK": "m"}))
    assert (tmp_path / "said").read_text() == "m; touch oops $MARK"
    assert not (tmp_path / "oops").exists()


def test_its_end_is_logged_without_its_words_and_its_output(
    make: Callable[..., Action], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also if it leaves a process behind."""
    assert make(*PYTHON, "import subprocess; subprocess.Popen(['sleep', '10']); print('ghp_TOKEN'); exit(3)").request()
    assert until(lambda: "flags/git-pull ended with exit code 3, its output is in " in caplog.text)
    assert "TOKEN" not in caplog.text
    output = tmp_path / "git-pull.log"
    assert (output.read_text(), output.stat().st_mode & 0o777) == ("ghp_TOKEN\n", 0o600)


def test_the_file_of_a_command_that_floods_stays_small_and_has_its_last_words(
    make: Callable[..., Action], tmp_path: Path
) -> None:
    """Also after its end, if it leaves a process behind."""
    code = "import sys, time; print('y' * 3_000_000, flush=True); time.sleep(0.6); sys.exit('fatal')"
    assert finished(make(*PYTHON, code))
    file = tmp_path / "git-pull.log"
    text = file.read_text()
    assert (len(text) < 100_000, text[:8], text[-6:]) == (True, "(2934465", "fatal\n")
    later = [*PYTHON, "import time; time.sleep(1); print('z' * 3_000_000)"]
    assert finished(make(*PYTHON, f"import subprocess; subprocess.Popen({later})"))
    assert until(lambda: file.read_text()[-2:] == "z\n" and file.stat().st_size < 100_000)


def test_its_thread_ends_with_the_last_program_that_it_has_left(make: Callable[..., Action], tmp_path: Path) -> None:
    waits = ["sh", "-c", "until [ -e gate ]; do sleep 0.05; done"]
    assert finished(make(*PYTHON, f"import subprocess; subprocess.Popen({waits})", cwd=tmp_path))
    follower = followers()[0]
    follower.join(2 * LOOK_S)
    assert follower.is_alive(), "it limits the output"
    (tmp_path / "gate").touch()
    assert until(lambda: not followers())


def test_runs_also_where_no_file_can_be_written(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    (tmp_path / "state").touch()  # a file where the folder is expected
    words = SystemControl(command=(*PYTHON, "print('done')"))
    assert Action(PULL, words, folder=tmp_path / "state", clock=Clock()).request()
    assert until(lambda: "git-pull ended with exit code 0, its output is lost: File exists: " in caplog.text)


@pytest.mark.parametrize(
    ("words", "why"), [((), "has no command for it"), (("/no/such/TOKEN",), "its command or cwd: No such file or dir")]
)
def test_a_command_that_cannot_run_is_one_line_that_does_not_quote_it(
    make: Callable[..., Action], caplog: pytest.LogCaptureFixture, words: tuple[str, ...], why: str
) -> None:
    action = make(*words)
    assert [action.request() for _ in range(5)] == [False] * 5
    assert caplog.text.count(why) == 1
    assert "TOKEN" not in caplog.text


OLD = "pebble/robots/rover"
_ARRIVES_S = 0.02  # what a hub of memory distributes
LEFT = ("outgoing/online", "outgoing/capabilities", "outgoing/mcu/x/value", "incoming/flags/mqtt-audio")


class Named:
    """A robot that is started again and again under names, at one broker."""

    def __init__(self, folder: Path, make: Callable[[str], Transport]) -> None:
        self.make, self.config = make, folder / "robot.json"
        self.state = folder / "state"
        self.client = Client(make("operator"), OLD, listen=False)

    def start(self, name: str, meanwhile: Callable[[], None] = lambda: None, *, connected: bool = True) -> None:
        """``meanwhile`` happens after it has begun to watch."""
        transport = {"kind": "zenoh", "state_dir": str(self.state)}
        self.config.write_text(json.dumps({"robot": {"id": name}, "transport": transport}))
        robots_own = MemoryHub()
        if not connected:
            robots_own.stop()
        sides = [self.make(name), MemoryTransport(f"{name}-local", robots_own)]
        for side in sides:
            side.open(5 if connected else 0.5)
        jobs: list[Callable[[], None]] = [meanwhile]
        keep_stops(load(self.config))
        names = EarlierNames(load(self.config), sides, lambda _seconds, job: jobs.append(job))  # type: ignore[arg-type]
        names.begin()
        while jobs:
            jobs.pop(0)()
            until(lambda: False, _ARRIVES_S)
        for side in sides:
            side.close()

    def leave(self) -> None:
        for suffix in LEFT:
            self.client.publish(suffix, b'{"online": false}', retain=True)

    @property
    def left(self) -> list[str]:
        looker = Client(self.make("looker"), OLD)
        until(lambda: False, _ARRIVES_S)
        found = sorted(message.topic.removeprefix(f"{OLD}/") for message in looker.seen)
        looker.transport.close()
        return found

    @property
    def known(self) -> list[str]:
        (file,) = self.state.iterdir()
        return [name.rpartition("/")[2] for name in json.loads(file.read_text())]


@pytest.fixture
def robot(tmp_path: Path) -> Named:
    hub = MemoryHub()
    return Named(tmp_path, lambda name: MemoryTransport(name, hub))


def test_what_was_retained_under_an_earlier_name_is_removed(robot: Named) -> None:
    robot.start("rover")
    robot.leave()
    robot.start("rover")
    assert robot.left == sorted(LEFT)
    robot.start("rover-two")
    assert robot.left == []
    robot.client.publish("outgoing/online", b'{"online": false}', retain=True)  # a late will
    robot.start("rover-two")
    assert (robot.left, robot.known) == ([], ["rover", "rover-two"])
    robot.start("rover-two")
    assert robot.known == ["rover-two"]


STOPPED, FREE = '{"latched": true, "recent": []}', '{"latched": false, "recent": []}'


@pytest.mark.parametrize(
    ("names", "before", "now", "kept"),
    [
        (("rover", "rover-two"), STOPPED, None, STOPPED),
        (("rover", "rover-two"), "damaged", FREE, "damaged"),
        (("rover", "rover-two"), FREE[:-4], FREE, FREE[:-4]),
        (("rover", "rover-two"), FREE, STOPPED, STOPPED),
        (("rover", "rover-two"), FREE, None, None),
        (("serial", "left"), STOPPED, None, STOPPED),
        (("serial", "left"), STOPPED, FREE, FREE),
    ],
)
@pytest.mark.parametrize("by_name", [False, True])
def test_a_stopped_robot_stays_stopped_under_another_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by_name: bool,
    names: tuple[str, str], before: str, now: str | None, kept: str | None,
) -> None:  # fmt: skip
    """``names``: of the robot, or of its motor owner. ``by_name``: each robot has a state directory of its own."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    path, files = tmp_path / "robot.json", list[Path]()
    transport = {"kind": "zenoh"} | ({} if by_name else {"state_dir": str(tmp_path / "state")})
    line = {"enabled": True, "serial": {"port": "/dev/null"}}
    for name, content in zip(names, (before, now), strict=True):
        bridge = {"instances": {"left": line}} if name == "left" else line
        robot = {"id": name if name.startswith("rover") else "goob"}
        services = {"serial_mcu_bridge": bridge}
        path.write_text(json.dumps({"robot": robot, "transport": transport, "services": services}))
        config = load(path)
        files.append(config.state_file(f"estop-{config.motor_owners[0]}"))
        files[-1].parent.mkdir(parents=True, exist_ok=True)
        if content is not None:
            files[-1].write_text(content)
        keep_stops(config)
    assert (files[1].read_text() if files[1].exists() else None) == kept
    assert files[0].exists() is not (kept == before), "a stop does not come back with its earlier name"
    files[1].write_text(FREE)
    keep_stops(load(path))
    assert files[1].read_text() == FREE, "it was reset"


@pytest.mark.parametrize(("file", "left"), [("serial-my-", "serial-my-"), ("front-", "serial-")])
def test_a_stop_of_a_robot_whose_name_ends_alike_stays(tmp_path: Path, file: str, left: str) -> None:
    """Both robots share a state directory; *front* was a motor owner of the robot itself."""
    path, line = tmp_path / "robot.json", {"enabled": True, "serial": {"port": "/dev/null"}}
    robot, transport = {"system": "pebble", "id": "goob"}, {"kind": "zenoh", "state_dir": str(tmp_path)}
    path.write_text(json.dumps({"robot": robot, "transport": transport, "services": {"serial_mcu_bridge": line}}))
    for lock in ("launcher-my-pebble+robots+goob.lock", "launcher-pebble+robots+goob.lock"):
        (tmp_path / lock).touch()
    (tmp_path / f"estop-{file}pebble+robots+goob.json").write_text(STOPPED)
    keep_stops(load(path))
    assert [path.name for path in tmp_path.glob("estop-*")] == [f"estop-{left}pebble+robots+goob.json"]


def test_a_stop_follows_a_robot_whose_new_name_ends_like_the_file_of_the_old_one(tmp_path: Path) -> None:
    path, line = tmp_path / "robot.json", {"enabled": True, "serial": {"port": "/dev/null"}}
    files = []
    for system in ("pebble", "x-pebble"):
        robot, transport = {"system": system, "id": "goob"}, {"kind": "zenoh", "state_dir": str(tmp_path)}
        services = {"serial_mcu_bridge": {"instances": {"x": line}}}
        path.write_text(json.dumps({"robot": robot, "transport": transport, "services": services}))
        config = load(path)
        (tmp_path / f"launcher-{system}+robots+goob.lock").touch()
        files.append(config.state_file(f"estop-{config.motor_owners[0]}"))
        if system == "pebble":
            files[0].write_text(STOPPED)
        keep_stops(config)
    assert [file.exists() for file in files] == [False, True]


def test_what_another_robot_retains_stays(robot: Named) -> None:
    robot.start("rover")
    robot.leave()
    beats = iter(range(1_000_000))

    def beat() -> None:
        for _ in range(2):
            robot.client.publish("outgoing/online", b'{"t": %d}' % next(beats), retain=True)

    robot.start("rover-two", beat)
    assert (robot.left, robot.known) == (sorted(LEFT), ["rover-two"])


def test_without_a_connection_it_is_tried_at_the_next_start(robot: Named) -> None:
    robot.start("rover")
    robot.leave()
    robot.start("rover-two", connected=False)
    assert (robot.left, robot.known) == (sorted(LEFT), ["rover", "rover-two"])
    robot.start("rover-two")
    assert robot.left == []


@pytest.mark.parametrize("text", ['["pebble/#/x"]', "[7]", '["pebble/robots"]'])
def test_a_damaged_file_removes_nothing(robot: Named, text: str) -> None:
    robot.start("rover")
    robot.leave()
    (file,) = robot.state.iterdir()
    file.write_text(text)
    robot.start("rover-two")
    assert (robot.left, robot.known) == (sorted(LEFT), ["rover-two"])


def test_a_bridge_looks_for_them_once_it_forwards(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    begun, later = list[float](), list[CallIn]()
    jobs = [(wait_s, partial(begun.append, wait_s)) for wait_s in (60.0, 0.0)]
    monkeypatch.setattr(EarlierNames, "__init__", lambda _names, _config, _sides, call_in: later.append(call_in))
    monkeypatch.setattr(EarlierNames, "begin", lambda _names: begun or [later[0](*job) for job in jobs])
    rig = MemoryRig(monkeypatch)
    rig.bridge()
    assert until(lambda: begun)
    assert begun[0] == 0.0, "what is to be done in a minute waits"
    rig.close()
    assert "failed at the bridge" not in caplog.text
