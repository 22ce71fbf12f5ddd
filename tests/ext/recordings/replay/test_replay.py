"""``pebble replay`` as a process, with a real mosquitto and a real terminal."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.extensions.recordings.files.rewrite import rewrite
from pebble.extensions.recordings.stamps import stamp_ns
from tests.commands.command_line import Run, program
from tests.ext.recordings.playing import FRED, GOOB, Line, demo, js, ms, write, write_random
from tests.ext.recordings.recorder.test_record import Reference
from tests.support import WAIT_S, Broker, beside, until

REPLAYED = "replay/robots/goob"
ONLINE, STATUS, LOGS = (f"{REPLAYED}/outgoing/{metric}" for metric in ("online", "status", "logs"))


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"), "max_queued_messages 0")
    yield broker
    broker.stop()


def states(operator: Reference, topic: str = ONLINE) -> list[object]:
    return [json.loads(payload).get("online", True) for payload in operator.of(topic)]


def retained(port: int) -> dict[str, bytes]:
    """What a new subscriber is sent."""
    late = Reference(port)
    late.transport.close()
    return {message.topic: message.payload for message in late.received if message.retain}


@pytest.fixture
def operator(broker: Broker) -> Iterator[Reference]:
    operator = Reference(broker.port)
    yield operator
    left = retained(broker.port)
    operator.transport.close()
    assert left == {}


@pytest.fixture
def at(broker: Broker) -> tuple[str, str]:
    return "--url", f"mqtt://127.0.0.1:{broker.port}"


def walk(folder: Path, seconds: int = 60) -> Path:
    """Heartbeats, a retained state, a log and drive commands."""
    lines = [Line(0, f"{GOOB}/outgoing/status", js(t=ms(0), value={}), 1, retained=True)]
    for number in range(seconds * 4):
        at = number / 4
        lines.append(Line(at, f"{GOOB}/outgoing/online", js(t=ms(at)), 1, retain=True))
        lines.append(Line(at + 0.01, f"{GOOB}/outgoing/logs", js(t=ms(at), n=number)))
        lines.append(Line(at + 0.02, f"{GOOB}/incoming/drive-values", js(x=0, z=0.5), 1))
    return write(folder / "walk.mcap", lines)


def test_replayed_at_ten_times_its_speed_it_is_the_same(
    tmp_path: Path, operator: Reference, at: tuple[str, str], run: Run
) -> None:
    lines = list(demo(20))
    path = write(tmp_path / "demo.mcap", lines)
    began = time.monotonic()
    assert (run("replay", path, *at, "--incoming", "--speed", "10"), run.err) == (0, "")
    assert time.monotonic() - began > 2
    robots = [base.replace("pebble", "replay") for base in (GOOB, FRED)]
    assert run.out.splitlines() == [", ".join(robots), f"{len(lines)} sent, 0 skipped"]
    assert until(lambda: states(operator, f"{robots[1]}/outgoing/online")[-1] is False)
    for topic in {line.topic for line in lines}:
        sent = [_without_stamp(line.payload) for line in lines if line.topic == topic]
        received = [_without_stamp(payload) for payload in operator.of(topic.replace("pebble", "replay"))]
        assert received[: len(sent)] == sent, topic
        assert len(received) - len(sent) == topic.endswith("online")
    qualities = {line.topic.replace("pebble", "replay"): line.qos for line in lines}
    assert all(message.qos == qualities[message.topic] for message in operator.received)


def _without_stamp(payload: bytes) -> object:
    """A payload, which a replay changes in its stamp only."""
    stamp = stamp_ns(payload) // 10**6
    if stamp and payload.startswith(b"{"):
        return {name: value for name, value in json.loads(payload).items() if name not in ("t", "timestamp")}
    return payload.replace(stamp.to_bytes(8, "big"), b"") if stamp else payload


def test_by_default_it_is_harmless_and_current(
    tmp_path: Path, operator: Reference, at: tuple[str, str], run: Run
) -> None:
    period = ("--since", "2023-11-14T22:13:30Z", "--until", "+5s")  # from 10 s after its begin
    assert (run("replay", walk(tmp_path), *at, *period, "--speed", "10"), run.err) == (0, "")
    assert until(lambda: states(operator) == [*[True] * 20, False])
    assert {message.topic for message in operator.received} == {ONLINE, STATUS, LOGS}
    assert [json.loads(payload)["n"] for payload in operator.of(LOGS)] == list(range(40, 60))
    late = [time.time() * 1000 - json.loads(payload)["t"] for payload in operator.of(ONLINE)]
    assert all(-1000 < each < 20_000 for each in late)
    assert len(operator.of(STATUS)) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_orderly_end_leaves_nothing_that_moves(
    tmp_path: Path, operator: Reference, at: tuple[str, str], number: signal.Signals
) -> None:
    process = program("replay", walk(tmp_path), *at, "--incoming")
    assert until(lambda: len(operator.of(LOGS)) > 2)
    process.send_signal(number)
    assert (process.communicate(timeout=WAIT_S)[1], process.returncode) == ("", 0)
    assert until(lambda: states(operator)[-1] is False)
    assert json.loads(operator.of(f"{REPLAYED}/incoming/drive-values")[-1])["valid_ms"] == 0


def test_when_it_is_killed_the_broker_publishes_that_its_robots_are_offline(
    tmp_path: Path, operator: Reference, at: tuple[str, str]
) -> None:
    heartbeats = [f"replay/robots/{robot}/outgoing/online" for robot in ("goob", "fred")]
    process = program("replay", write(tmp_path / "demo.mcap", demo(20)), *at)
    assert until(lambda: all(len(operator.of(topic)) > 2 for topic in heartbeats))
    process.kill()
    process.communicate()
    assert until(lambda: all(states(operator, topic)[-1] is False for topic in heartbeats))


def test_a_broker_that_restarts_gets_the_rest(tmp_path: Path, run: Run) -> None:
    broker = Broker(tmp_path)
    operator = Reference(broker.port)

    def restart() -> None:
        assert until(lambda: len(operator.of(LOGS)) > 2)
        broker.kill()
        time.sleep(0.2)
        broker.start()  # it ends with this thread
        assert until(lambda: states(operator)[-1] is False)

    with beside(restart, threading.Event()):
        assert run("replay", walk(tmp_path, 3), "--url", f"mqtt://127.0.0.1:{broker.port}") == 0
    numbers = [json.loads(payload)["n"] for payload in operator.of(LOGS)]
    assert numbers == sorted(numbers)
    assert numbers[-1] == 11
    assert len(numbers) >= 10
    assert "no connection" in run.err
    assert run.err.splitlines()[-1] == "pebble: it goes on"
    assert retained(broker.port) == {}
    operator.transport.close()
    broker.stop()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("--incoming", "--speed", "0.5"), "--speed 0.5 would drive a robot for longer"),
        (("--only", "other/#"), "no topic other/# in "),
        (("--only", "+/+/+/incoming/#"), "there is nothing to publish"),
        ((), "cannot connect"),
    ],
)
def test_errors_are_one_line(tmp_path: Path, run: Run, arguments: tuple[str, ...], problem: str) -> None:
    assert run("replay", walk(tmp_path, 1), "--url", "mqtt://127.0.0.1:9", *arguments) == 1
    assert problem in run.err
    assert len(run.err.splitlines()) == 1


def test_what_damage_has_taken_is_counted(tmp_path: Path, at: tuple[str, str], run: Run) -> None:
    path, mended = tmp_path / "x.mcap", tmp_path / "mended.mcap"
    write_random(path, 400, channels=3)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 20] = bytes(20)
    path.write_bytes(data)
    assert rewrite(path, mended).missing == 100
    assert run("replay", mended, *at, "--speed", "100") == 0
    assert run.err == "pebble: 100 messages missing in this recording: files were damaged\n"
    assert run("replay", path, *at, "--speed", "100") == 1
    assert "damaged parts: 1, messages missing: 100" in run.err
    assert run.out.splitlines()[-1] == "300 sent, 0 skipped"
