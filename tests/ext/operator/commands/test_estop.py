"""``pebble estop`` with a real broker and robots that are played around the real latch."""

from __future__ import annotations

import itertools
import os
import pty
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, load
from pebble.extensions.operator.client.connection import me
from pebble.extensions.operator.commands import estop, repeated_stop
from pebble.transports.mqtt.transport import MqttTransport
from tests.commands.command_line import Run, config_file, program, running
from tests.ext.page.served import Served
from tests.fakes.bad_brokers import BEHAVIOURS, resolving, serving
from tests.kit.played_robot import RecordingRobot
from tests.sparing_broker import SparingBroker
from tests.support import WAIT_S, Broker, free_port, until
from tests.tcp_proxy import TcpProxy

_numbers = itertools.count(1)


Make = Callable[..., RecordingRobot]


@pytest.fixture
def url(broker: Broker) -> str:
    return f"--url=mqtt://127.0.0.1:{broker.port}"


@pytest.fixture
def robot_on(broker: Broker) -> Iterator[Make]:
    """Make robots without a heartbeat, which leave nothing at the broker; ``more``: capabilities beyond the usual."""
    robots: list[RecordingRobot] = []

    def make(*owners: str, persisted: bool | None = True, id_: str = "", **more: Any) -> RecordingRobot:
        base = f"pebble/robots/{id_ or f'robot{next(_numbers)}'}"
        robot = RecordingRobot(broker.port, base, *owners, persisted=persisted, heartbeats=False)
        robots.append(robot)
        robot.deaf = not more.get("estop", True)
        if more:
            robot.publish_capabilities(robot.motors.value | more)
        if not robot.deaf:
            robot.publish_states()
        return robot

    yield make
    for robot in robots:
        robot.silent()
        states = [f"estop/{owner.name}" for owner in robot.motors.owners]
        for metric in ("capabilities", "status", "link", "online", *states):
            robot.remove(metric)
        robot.close()


# -- stop


def test_a_stop_reaches_a_living_address_behind_dead_ones(robot_on: Make, broker: Broker) -> None:
    robot, dead = robot_on("mcu"), {"127.0.0.2": "mute", "127.0.0.3": "server unavailable"}
    with ExitStack() as opened:
        for address, how in dead.items():
            opened.enter_context(serving(address, broker.port, BEHAVIOURS[how]))
        names = resolving({"fleet.test": [*dead, "127.0.0.1"]})
        stop = program("estop", robot.id, f"--url=mqtt://fleet.test:{broker.port}", env=names)
        out, err = stop.communicate(timeout=40)
    assert (stop.returncode, robot.latched) == (0, True), out + err


@pytest.mark.parametrize("id_", ["", "b\u00e4r", "ba\u0308r"])  # of two letters that look like one
def test_a_stop_is_confirmed_by_every_owner(run: Run, robot_on: Make, url: str, id_: str) -> None:
    robot, before = robot_on("left", "right", id_=id_), signal.getsignal(signal.SIGTERM)
    assert run("estop", "b\u00e4r" if id_ else robot.id, url, "--why", "dog") == 0
    assert signal.getsignal(signal.SIGTERM) is before
    assert robot.latched
    assert run.out.splitlines()[-1].startswith(f"{robot.id}: stopped and confirmed after 0.")
    latch = robot.motors.owners[0].latch
    assert (latch.by, latch.why, latch.count) == (me()[:32], "dog", 1)
    assert until(lambda: len(robot.received) >= 2)  # it may still be on its way when the command has ended
    first, second = robot.received[:2]
    assert (first[1], second[1]) == (f"{robot.base}/incoming/estop", f"{robot.base}/incoming/drive-values")
    assert second[2]["valid_ms"] == 0


WHY = "serial: no board\\u001b[2J"
STANDS = f"nothing confirms that its motors stand: {WHY}"
#: What a robot says of its motors, and what a stop, the status after it, and the reset say: exit code, last line.
MOTORS: dict[str, list[tuple[int, str]]] = {
    "no": [
        (1, f"latched, confirmed by left, right after T; {STANDS}"),
        (0, STANDS),
        (0, f"free; its status says: Cannot be driven: {WHY}"),
    ],
    "unknown": [
        (0, f"stopped and confirmed after T; it is not known whether its motors stand: {WHY}"),
        (0, f"it is not known whether its motors stand: {WHY}"),
        (0, f"free; its status says: Not known whether it can be driven: {WHY}"),
    ],
    "yes": [
        (0, "stopped and confirmed after T"),
        (0, "stopped by me (right)"),
        (0, "free; it moves again once drive commands have paused for half a second"),
    ],
}


@pytest.mark.parametrize("every", [False, True])
@pytest.mark.parametrize("state", MOTORS)
def test_a_stop_and_a_reset_say_whether_they_reach_the_motors(
    run: Run, robot_on: Make, url: str, state: str, every: bool
) -> None:
    robot = robot_on("left", "right")
    robot.start()
    robot.publish("status", {"value": {"driveable": {"state": state, "why": "serial: no board\x1b[2J"}}}, retain=True)
    codes = []
    for words in (["--all"] if every else [robot.id]), ["status", robot.id], ["reset", robot.id]:
        code, lines = run("estop", *words, url), [line for line in run.out.splitlines() if robot.id in line]
        last = re.sub(r", [^,]* ago", "", re.sub(r"\d\.\d\d s", "T", lines[-1].partition(": ")[2]))
        assert not any("stopped and confirmed" in line for line in lines[:-1])
        codes.append((code, last.replace(me()[:32], "me")))
    assert codes == MOTORS[state]


def test_a_robot_that_has_just_started_may_say_a_little_later_that_it_reaches_its_motors(
    run: Run, robot_on: Make, url: str
) -> None:
    robot = robot_on("serial")
    status = partial(robot.publish, "status", retain=True)
    status({"value": {"driveable": {"state": "no", "why": "starting"}}})

    def drive_later() -> None:
        until(lambda: robot.latched)
        time.sleep(0.5)
        status({"value": {"driveable": {"state": "yes"}}})

    with ThreadPoolExecutor() as pool:
        later = pool.submit(drive_later)
        code = run("estop", robot.id, url)
        later.result()
    assert (code, "stopped and confirmed after" in run.out.splitlines()[-1]) == (0, True), run.out


def test_a_robot_that_does_not_answer_is_reported_and_ctrl_c_ends_it(robot_on: Make, url: str) -> None:
    """Under nohup a hangup does not."""
    robot = robot_on("serial")
    robot.deaf = True
    with ExitStack() as opened:
        before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            process = opened.enter_context(running("estop", robot.id, url))
        finally:
            signal.signal(signal.SIGHUP, before)
        assert process.stdout is not None
        assert process.stdout.readline() == f"{robot.id}: stop sent\n"
        assert "not confirmed yet: serial has not confirmed" in process.stdout.readline()
        process.send_signal(signal.SIGHUP)
        stops = robot.count("estop")
        assert until(lambda: robot.count("estop") > stops + 1)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=WAIT_S)
    assert out.startswith(f"{robot.id}: NOT CONFIRMED, no longer sent: serial has not confirmed")
    assert (process.returncode, err) == (1, "")
    assert robot.count("drive-values") >= 2
    assert robot.count("estop") - robot.count("drive-values") in (0, 1)  # Ctrl-C may come between the two


def test_the_robots_that_are_heard_are_named_where_the_one_that_is_meant_is_not(
    robot_on: Make, broker: Broker, url: str
) -> None:
    robot = robot_on("serial")
    robot.start()
    page = RecordingRobot(broker.port, "pebble/servers/desk", capabilities={})
    with page, running("estop", "gob", url) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == f"pebble: nothing comes from gob; heard here: {robot.id}\n"


def test_a_stop_is_repeated_until_it_is_confirmed_although_nothing_can_be_printed(robot_on: Make, url: str) -> None:
    robot = robot_on("serial")
    robot.deaf = True
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as unread, running("estop", robot.id, url, stdout=unread) as process:
        assert until(lambda: robot.count("estop") >= 4)
        robot.deaf = False
        _, err = process.communicate(timeout=WAIT_S)
    assert (process.returncode, err) == (0, "")
    assert robot.latched


@pytest.mark.parametrize("stream", ["stderr", "stdout"])
def test_a_terminal_that_stands_still_holds_no_stop_up(robot_on: Make, broker: Broker, stream: str) -> None:
    robot = robot_on("serial")
    robot.deaf = True
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with suppress(BlockingIOError):
        while os.write(writing, b"x" * 4096):
            pass
    os.set_blocking(writing, True)
    with (
        os.fdopen(reading),
        os.fdopen(writing, "w") as unread,
        TcpProxy(broker.port, delay_s=0.3) as proxy,
        running("estop", robot.id, f"--url=mqtt://127.0.0.1:{proxy.port}", **{stream: unread}),
    ):
        assert until(lambda: robot.count("estop") >= 4)


def test_a_slow_network_does_not_delay_repetitions(robot_on: Make, broker: Broker) -> None:
    robot = robot_on("serial")
    robot.deaf = True
    with (
        TcpProxy(broker.port, delay_s=0.2) as proxy,
        running("estop", robot.id, f"--url=mqtt://127.0.0.1:{proxy.port}"),
    ):
        assert until(lambda: robot.count("estop") >= 2)
    first, second, *_ = robot.times("estop")
    assert second - first < 1.7, "two seconds if it waited for its subscriptions"


def test_no_robot_at_all_is_a_failure(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.extensions.operator.client.estop.COLLECT_S", 0.5)
    empty = Broker(tmp_path)
    try:
        assert run("estop", "--all", f"--url=mqtt://127.0.0.1:{empty.port}") == 1
    finally:
        empty.stop()
    assert "NOTHING IS STOPPED" in run.out


def at_rest(robot: RecordingRobot) -> bool:
    """Whether no stop arrives for longer than the time between two of them."""
    before = robot.count("estop")
    time.sleep(0.8)
    return robot.count("estop") == before


def test_a_hold_stops_robots_that_come_online_later(robot_on: Make, url: str) -> None:
    early = robot_on("serial")
    with running("estop", "--all", "--hold", url) as process:
        assert until(lambda: early.latched)
        late = robot_on("serial")
        assert until(lambda: late.latched)
        latch = late.motors.owners[0].latch
        assert latch.reset(latch.boot, latch.count, 0, 0)
        late.publish_states()
        last = robot_on("serial")
        assert until(lambda: last.latched)
        assert not late.latched, "reset on purpose"
        assert until(lambda: at_rest(last)), "its confirmation has arrived"
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=WAIT_S)
    names = {robot.motors.owners[0].latch.recent[0] for robot in (early, late, last)}
    assert (process.returncode, err, len(names)) == (0, "", 1)
    assert f"stop {names.pop()} is held" in out
    assert f"{late.id}: was stopped, and reset since" in out


@pytest.mark.parametrize(
    ("is_there_at_first", "waits"),
    [
        (True, "warning: nothing is sent until there is a connection: "),
        (False, "the stop is NOT SENT YET: connecting to mqtt://127.0.0.1:"),
    ],
)
def test_a_broker_that_is_lost_or_restarts_is_waited_for(tmp_path: Path, is_there_at_first: bool, waits: str) -> None:
    with ExitStack() as opened:
        broker = Broker(tmp_path)
        opened.callback(broker.stop)
        robot = opened.enter_context(RecordingRobot(broker.port, "pebble/robots/lost", heartbeats=False))
        robot.publish_states()
        robot.deaf = True
        if not is_there_at_first:
            broker.kill()
        process = opened.enter_context(running("estop", robot.id, f"--url=mqtt://127.0.0.1:{broker.port}"))
        if is_there_at_first:
            assert until(lambda: robot.count("estop") >= 1)
            broker.kill()
        assert process.stderr is not None
        assert process.stderr.readline().startswith(f"pebble: {waits}")
        robot.deaf = False
        broker.start()
        out, _ = process.communicate(timeout=50)
        assert (process.returncode, robot.latched) == (0, True), out


NOWHERE = "nothing listens there, is it up?"
REFUSED = "not authorized (bad user name or password?)"
#: Command lines whose broker, or robot, does not let them in: how it answers, the first line, a later signal, the end.
UNREACHED: dict[str, tuple[list[str], str | None, str, str, signal.Signals | None, str]] = {
    "one": (["goob"], None, "the stop is NOT SENT YET: connecting to", NOWHERE, signal.SIGINT, "STOP NOT SENT: interr"),
    "ended": (["goob"], "mute", "the stop is NOT SENT YET: connecting to", "", signal.SIGTERM, "STOP NOT SENT: interr"),
    "all": (["--all"], None, "the stop is NOT SENT YET: connecting to", NOWHERE, None, "STOP NOT SENT: cannot connect"),
    "who": (["--all"], "not authorized", "the stop is NOT SENT YET: connecting to", REFUSED, None, REFUSED),
    "reset": (
        ["reset", "goob"],
        None,
        "nothing is reset yet: connecting to",
        NOWHERE,
        signal.SIGINT,
        "NOT RESET: interr",
    ),
}


@pytest.mark.parametrize(("words", "how", "begins", "why", "ends_by", "ends"), UNREACHED.values(), ids=UNREACHED)
def test_without_a_connection_a_stop_and_a_reset_say_at_once_and_in_the_end_that_they_are_not_sent(
    words: list[str], how: str | None, begins: str, why: str, ends_by: signal.Signals | None, ends: str
) -> None:
    port = free_port()
    with ExitStack() as opened:
        if how is not None:
            opened.enter_context(serving("127.0.0.1", port, BEHAVIOURS[how]))
        process = opened.enter_context(running("estop", *words, f"--url=mqtt://127.0.0.1:{port}"))
        assert process.stderr is not None
        first = process.stderr.readline()
        if ends_by is not None:
            process.send_signal(ends_by)
        _, err = process.communicate(timeout=WAIT_S)
    assert first.startswith(f"pebble: {begins} mqtt://127.0.0.1:{port}")
    assert (process.returncode, why in first, ends in err, "Traceback" in err) == (1, True, True, False), first + err


def test_a_stop_that_waits_for_a_broker_says_why_until_it_is_ended() -> None:
    with running("estop", "goob", f"--url=mqtt://127.0.0.1:{free_port()}") as process:
        assert process.stdout is not None
        waits = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=WAIT_S)
    assert (process.returncode, waits.startswith("goob: STOP NOT SENT YET: ")) == (1, True)
    assert out == waits.replace(" YET", "")


@pytest.mark.parametrize("place", ["target_of", "_repeat"])
def test_a_stop_says_also_after_an_error_whether_it_was_sent(
    run: Run, monkeypatch: pytest.MonkeyPatch, broker: Broker, url: str, place: str
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("a mistake")

    monkeypatch.setattr(repeated_stop, place, fail)
    assert run("estop", "nobody", url) == 1
    assert ("STOP NOT SENT: an unexpected error" in run.err) is (place == "target_of")
    assert (run.out.startswith("nobody: ") and " NOT " in run.out) is (place == "_repeat")


#: What a broker keeps, too long to arrive, of a stranger or of the robot itself, and who stops the robot all the same.
KEPT = {
    "capabilities of a stranger": ("pebble/robots/attic", "capabilities", ("estop", "--all")),
    "a heartbeat of a stranger": ("pebble/robots/attic", "online", ("estop", "--all")),
    "its own capabilities, by name": ("", "capabilities", ("estop", "{id}")),
    "a state that a stranger invents of it": ("", "estop/invented", ("estop", "{id}")),
    "capabilities of a stranger, on a page": ("pebble/robots/attic", "capabilities", ("page", "")),
    "capabilities of a stranger, in its status": ("pebble/robots/attic", "capabilities", ("estop", "status", "{id}")),
    "capabilities of a stranger, at its reset": ("pebble/robots/attic", "capabilities", ("estop", "reset", "{id}")),
    "its own status": ("", "status", ("estop", "{id}")),
    "its own status, at its reset": ("", "status", ("estop", "reset", "{id}")),
}


@pytest.mark.parametrize(("base", "metric", "words"), KEPT.values(), ids=KEPT)
def test_a_stop_waits_for_nothing_that_a_broker_keeps(
    broker: Broker, robot_on: Make, base: str, metric: str, words: tuple[str, ...]
) -> None:
    robot = robot_on("serial")
    robot.start()
    sparing = SparingBroker(broker.port, longest=1500)
    program_, *more = (word.format(id=robot.id, base=robot.base) for word in words)
    with ExitStack() as opened:
        stranger = partial(RecordingRobot, broker.port, base, capabilities={}, heartbeats=False)
        keeper = opened.enter_context(stranger()) if base else robot
        keeper.publish(metric, {"value": "x" * 5000}, retain=True)
        for end in (sparing.close, robot.silent, lambda: keeper.remove(metric)):
            opened.callback(end)
        if more[0] in ("reset", "status"):
            robot.stop()
            out, err = program(program_, *more, f"--url=mqtt://127.0.0.1:{sparing.port}").communicate(timeout=40)
            assert (": free" if more[0] == "reset" else "stopped by ann@desk") in out, err
            return
        robot.deaf = True
        if program_ == "page":
            page = opened.enter_context(opened.enter_context(Served(sparing.port)).page())
            page.send("estop", ref=more[0], stop="a" * 16)
        else:
            opened.enter_context(running(program_, *more, f"--url=mqtt://127.0.0.1:{sparing.port}"))
        assert until(lambda: robot.count("estop") > 3), "it is repeated"
        assert sparing.stalled or metric == "online"


def test_a_config_file_leads_to_the_robots_own_side_and_to_the_remote_one(
    run: Run, robot_on: Make, broker: Broker, tmp_path: Path
) -> None:
    robot = robot_on("serial")
    nowhere = {"host": "127.0.0.1", "port": 1}
    there = {"host": "127.0.0.1", "port": broker.port}
    local = config_file(tmp_path, robot={"id": robot.id}, local_mqtt=there)
    assert run("estop", local) == 0
    assert run("estop", robot.id, "--config", local) == 0
    assert run("estop", "reset", local) == 0
    bridge = {"enabled": True, "remote_mqtt": there}
    remote = config_file(tmp_path, robot={"id": robot.id}, local_mqtt=nowhere, services={"mqtt_bridge": bridge})
    assert run("estop", remote, "--remote") == 0
    assert robot.latched


def test_a_config_file_that_vanishes_ends_no_stop(
    run: Run, robot_on: Make, broker: Broker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = robot_on("serial")
    file = Path(config_file(tmp_path, robot={"id": robot.id}, local_mqtt={"host": "127.0.0.1", "port": broker.port}))

    def load_once(path: Path, **options: Any) -> Config:
        config = load(path, **options)
        file.unlink()
        return config

    monkeypatch.setattr("pebble.extensions.operator.client.connection.load", load_once)
    assert run("estop", file) == 0
    assert ": stopped and confirmed after " in run.out


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (("--all",), 1, "--config CONFIG or --url URL"),
        (("--hold", "--url", "mqtt://127.0.0.1:1"), 2, "--all"),
        (("goob", "--all", "--url", "mqtt://127.0.0.1:1"), 2, "either --all or goob"),
        ((), 2, "nothing was stopped: name the robot, or add --all"),
        (("stauts", "goob", "--url", "mqtt://127.0.0.1:1"), 2, 'did you mean "pebble estop status goob"?'),
        (("reset", "--all", "--url", "mqtt://127.0.0.1:1"), 2, "not for reset"),
        (("reset", "reset", "--url", "mqtt://127.0.0.1:1"), 2, "system/type/id"),
    ],
)
def test_wrong_command_lines(run: Run, arguments: tuple[str, ...], code: int, named: str) -> None:
    assert run("estop", *arguments) == code
    assert run.err.count("\n") == 1
    assert named in run.err


# -- reset and status


@contextmanager
def terminal() -> Iterator[tuple[int, int]]:
    """Both ends of one."""
    ends = pty.openpty()
    yield ends
    for end in ends:
        os.close(end)


@pytest.mark.parametrize("id_", ["", "ba\u0308r"])
def test_a_reset_shows_who_stopped_the_robot_and_frees_it(run: Run, robot_on: Make, url: str, id_: str) -> None:
    robot = robot_on("left", "right", id_=id_)
    robot.stop(by="ann@desk", why="dog")
    assert run("estop", "reset", "b\u00e4r" if id_ else robot.id, url) == 0
    lines = run.out.splitlines()
    assert lines[0].startswith(f"{robot.id}: stopped by ann@desk, ")
    assert all(line.endswith(f": dog ({owner})") for line, owner in zip(lines, ("left", "right"), strict=False))
    assert lines[2] == f"{robot.id}: free; it moves again once drive commands have paused for half a second"
    assert not any(owner.latch.latched for owner in robot.motors.owners)
    assert run("estop", "reset", robot.id, url) == 0
    assert run.out == f"{robot.id}: free\n"
    assert robot.count("estop-reset") == 2


def test_a_robot_called_reset_can_be_stopped(run: Run, robot_on: Make, url: str) -> None:
    robot = robot_on("serial", id_="reset")
    assert run("estop", robot.base, url) == 0
    assert robot.latched
    assert run("estop", "reset", robot.base, url) == 0
    assert not robot.latched


def test_over_a_thin_link_an_answer_may_take_longer(run: Run, robot_on: Make, url: str) -> None:
    robot = robot_on("serial")
    link = {"level": "thin", "drive_hz": 4, "rtt_ms": 600, "queue_ms": 0, "t": 1}
    robot.publish("link", link, retain=True)
    robot.late_s = 2.2
    heartbeat = threading.Timer(robot.late_s, robot.beat)
    heartbeat.start()
    assert (run("estop", "status", robot.id, url), run.out) == (0, f"{robot.id}: free\n")
    heartbeat.join()
    robot.stop()
    assert run("estop", "reset", robot.id, url) == 0
    assert not robot.latched


def test_a_declined_reset_resets_nothing(robot_on: Make, url: str) -> None:
    robot = robot_on("serial")
    robot.stop()
    with terminal() as (master, slave), running("estop", "reset", robot.id, url, stdin=slave) as process:
        os.write(master, b"n\n")
        assert process.wait(WAIT_S) == 1
    assert (robot.latched, robot.count("estop-reset")) == (True, 0)


def test_a_stop_that_was_not_shown_is_not_reset(robot_on: Make, url: str) -> None:
    robot = robot_on("serial")
    robot.stop()
    with terminal() as (master, slave), running("estop", "reset", robot.id, url, stdin=slave) as process:
        assert process.stdout is not None
        assert "stopped by ann@desk" in process.stdout.readline()
        robot.stop("fedcba9876543210", by="bob@door")
        os.write(master, b"y\n")
        _, err = process.communicate(timeout=WAIT_S)
    why = "serial: stopped again meanwhile by bob@door"
    assert err == f"pebble: {robot.id} is still stopped: {why}; look again, then repeat\n"
    assert (process.returncode, robot.latched, robot.count("estop-reset")) == (1, True, 1)


def test_a_reset_that_some_owners_may_have_got_is_not_confirmed(
    run: Run, robot_on: Make, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, publish, resets = robot_on("left", "right"), MqttTransport.publish, itertools.count()
    robot.stop()

    def publish_first(transport: MqttTransport, topic: str, *rest: Any, **options: Any) -> bool:
        if topic.endswith("/estop-reset") and next(resets):
            return False
        return publish(transport, topic, *rest, **options)

    monkeypatch.setattr(MqttTransport, "publish", publish_first)
    assert run("estop", "reset", robot.id, url) == 1
    assert run.err == f"pebble: the reset of {robot.id} is NOT CONFIRMED: the connection was lost\n"


def test_a_reset_of_an_unknown_robot_is_a_failure(run: Run, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estop, "ANSWER_S", 0.3)
    assert run("estop", "reset", "unknown", url) == 1
    assert run.err == "pebble: NOT RESET: unknown publishes no emergency stop: is it on, and is this its broker?\n"


def test_status_of_all(run: Run, robot_on: Make, url: str) -> None:
    free, stopped, old, silent, off = (
        robot_on("serial"),
        robot_on("mcu", persisted=None),
        robot_on(estop=None),
        robot_on("serial"),
        robot_on("serial"),
    )
    stopped.stop()
    silent.remove("estop/serial")
    for robot in (free, stopped, old, silent):
        robot.start()
    assert run("estop", "status", url) == 0
    lines = dict(line.split(": ", 1) for line in run.out.splitlines())
    assert lines[free.id] == "free"
    assert lines[stopped.id].startswith("stopped by ann@desk, ")
    assert lines[stopped.id].endswith(": dog (mcu, NOT SAVED)")
    assert lines[old.id] == "its firmware has none"
    assert lines[silent.id] == "unknown, no state of serial"
    assert lines[off.id] == "no heartbeat; its last state: free"


def test_states_that_come_only_if_their_exact_topics_are_asked_for(run: Run, robot_on: Make, broker: Broker) -> None:
    robot = robot_on("serial")
    robot.start()
    with closing(SparingBroker(broker.port, by_name=True)) as sparing:
        assert run("estop", "status", robot.id, f"--url=mqtt://127.0.0.1:{sparing.port}") == 0
    assert run.out == f"{robot.id}: free\n"


# -- other commands


def test_a_stopped_robot_is_not_driven_unless_forced(run: Run, robot_on: Make, url: str) -> None:
    robot = robot_on("left", "right")
    drive = ("topic", "pub", "drive-values", '{"z": 0.3}', url, f"--robot={robot.id}")
    assert run(*drive) == 0
    robot.stop()
    assert run(*drive) == 1
    assert run.err.count("\n") == 1
    assert run.err.startswith(f"pebble: {robot.id} is stopped by ann@desk, ")
    assert f"pebble estop reset {robot.id}" in run.err
    assert run("topic", "pub", f"{robot.base}/incoming/drive-values", "{}", url) == 0, "a zero moves nothing"
    assert run("topic", "pub", "lights-solid", "{}", url, f"--robot={robot.id}") == 0
    assert until(lambda: robot.count("drive-values") == 2)
    assert run(*drive, "--force") == 0
    assert until(lambda: robot.count("drive-values") == 3)


def test_driving_ends_when_the_robot_is_stopped(robot_on: Make, url: str) -> None:
    robot = robot_on("serial")
    with running("topic", "pub", "drive-values", '{"z": 0.3}', "--rate=50", url, f"--robot={robot.id}") as process:
        assert until(lambda: robot.count("drive-values") >= 3)
        robot.stop()
        _, err = process.communicate(timeout=WAIT_S)
    assert process.returncode == 1
    assert f"{robot.id} is stopped by ann@desk" in err
