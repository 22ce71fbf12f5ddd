"""``pebble record`` beside a real broker: every message with its flags, and a word about those that are missing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from pebble.config import parse
from pebble.extensions.recordings.files.recorded import Recorded
from pebble.services.recorder.service import RobotRecorder
from pebble.transports import Message, MqttSettings, QoS, Transport, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.commands.command_line import Run, program
from tests.ext.recordings.recorder.test_recorder import events, payloads, recorded
from tests.kit.robot import Running
from tests.kit.terminal import Terminal
from tests.support import WAIT_S, AmqttBroker, Broker, until

GOOB = "pebble/robots/goob"
ONLINE, AUDIO, STATUS = f"{GOOB}/outgoing/online", f"{GOOB}/outgoing/audio", f"{GOOB}/outgoing/status"
FLAG, DRIVE = f"{GOOB}/incoming/flags/mqtt-video", f"{GOOB}/incoming/drive-values"


@contextmanager
def recording(root: Path, port: int, *options: str) -> Iterator[subprocess.Popen[str]]:
    """A recorder that is connected, and ends in order at the end."""
    with program("record", "--url", f"mqtt://127.0.0.1:{port}", "--into", root, *options) as process:
        try:
            assert until(lambda: events(root, "connected"), step=0.2)
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(WAIT_S)


def client(port: int, name: str = "robot") -> Transport:
    return create("mqtt", name, MqttSettings(host="127.0.0.1", port=port)).open()


def of(messages: list[Recorded], topic: str) -> list[bytes]:
    return [message.payload for message in messages if message.channel.topic == topic]


def old_topics(root: Path) -> set[str]:
    """Those of the many values that were retained before."""
    old = (one.channel.topic for one in recorded(root) if one.channel.metadata.get("retained") == "1")
    return {topic for topic in old if "/many/" in topic}


class Reference:
    """A subscriber beside the recorder."""

    def __init__(self, port: int) -> None:
        self.received: list[Message] = []
        self.transport = client(port, "reference")
        self.transport.subscribe("#", self.received.append, qos=QoS.DELIVERED, direct=True)

    def of(self, topic: str) -> list[bytes]:
        return [message.payload for message in self.received if message.topic == topic]


def publish_all(robot: Transport, reference: Reference, number: int = 300) -> None:
    """State, sound and commands, faster than robots are; waits until the reference has them."""
    for count in range(number):
        robot.publish(ONLINE, b'{"t":%d}' % count, qos=QoS.DELIVERED, retain=True)
        robot.publish(AUDIO, b"PBAT\x01\x01\x01\x00" + bytes(12) + count.to_bytes(4, "big"), qos=QoS.LATEST)
        robot.publish(DRIVE, b'{"x":0.1,"z":%d}' % count, qos=QoS.DELIVERED)
        time.sleep(0.002)
    assert until(lambda: len(reference.of(DRIVE)) == number)


def test_what_a_subscriber_sees_is_recorded_byte_for_byte_with_its_flags(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    robot = client(broker.port)
    for count in range(1500):
        robot.publish(f"{GOOB}/outgoing/many/{count}", b"%d" % count, retain=True)
    robot.publish(FLAG, b"true", qos=QoS.DELIVERED, retain=True)
    reference = Reference(broker.port)
    with recording(tmp_path / "rec", broker.port, "--filter", "#", "--filter", "pebble/#"):
        publish_all(robot, reference)
        robot.publish(STATUS, b"{}", qos=QoS.DELIVERED, retain=True)
        robot.publish("replay/robots/goob/outgoing/online", b"{}", retain=True)
        robot.publish("pebble/infrastructure", b"1")
        assert until(lambda: payloads(tmp_path / "rec", "pebble/infrastructure"), step=0.2)
        assert until(lambda: len(old_topics(tmp_path / "rec")) == 1500, step=0.2)  # they are fetched beside
    found = recorded(tmp_path / "rec")
    for topic in (AUDIO, DRIVE):
        assert of(found, topic) == reference.of(topic)
    assert not of(found, "replay/robots/goob/outgoing/online")
    live = [message for message in found if not message.channel.metadata.get("retained")]
    assert of(live, ONLINE) == reference.of(ONLINE)
    flags = {message.channel.topic: dict(message.channel.metadata) for message in live}
    assert flags[STATUS] == {"qos": "1", "retain": "1"}
    assert flags[AUDIO] == {"qos": "0", "retain": "0"}
    assert flags["pebble/infrastructure"]["qos"] == "0"
    old = [message for message in found if message.channel.metadata.get("retained") == "1"]
    assert of(old, FLAG) == [b"true"]
    assert len(old_topics(tmp_path / "rec")) == 1500
    robot.close()
    reference.transport.close()
    broker.stop()


def test_a_broker_that_knows_only_mqtt_3(tmp_path: Path) -> None:
    broker = AmqttBroker()
    try:
        robot = client(broker.port)
        reference = Reference(broker.port)
        with recording(tmp_path / "rec", broker.port):
            publish_all(robot, reference, 50)
            assert until(lambda: len(payloads(tmp_path / "rec", DRIVE)) == 50, step=0.2)
        found = recorded(tmp_path / "rec")
        assert of(found, DRIVE) == reference.of(DRIVE)
        assert next(one.channel.metadata for one in found if one.channel.topic == DRIVE) == {"qos": "1"}
        robot.close()
        reference.transport.close()
    finally:
        broker.stop()


def test_an_outage_is_a_gap(tmp_path: Path) -> None:
    broker, root = Broker(tmp_path), tmp_path / "rec"
    with recording(root, broker.port):
        time.sleep(1.0)
        began = time.time()
        os.kill(broker.pid, signal.SIGSTOP)
        time.sleep(3.0)
        os.kill(broker.pid, signal.SIGCONT)
        ended = time.time()
        assert until(lambda: events(root, "gap"), step=0.2)
    (gap,) = events(root, "gap")
    assert gap["why"] == "no connection"
    assert gap["since"] / 1e3 == pytest.approx(began, abs=3.0)  # a silence is noticed after two seconds
    assert ended - 0.5 <= gap["until"] / 1e3 <= ended + 4.0
    broker.stop()


def test_there_is_no_broker_yet(tmp_path: Path) -> None:
    with program("record", "--url", "mqtt://127.0.0.1:1", "--into", tmp_path / "rec", "--for", "1s") as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "pebble: connecting to mqtt://127.0.0.1:1\n"
        assert "cannot connect to mqtt://127.0.0.1:1 yet" in process.stderr.readline()
        assert process.wait(WAIT_S) == 0


def test_a_terminal_that_stands_still_delays_no_end_of_a_recording(tmp_path: Path) -> None:
    broker, root = Broker(tmp_path), tmp_path / "rec"
    options = (f"--url=mqtt://127.0.0.1:{broker.port}", f"--into={root}", "--for=2s")
    with closing(Terminal(sys.executable, "-m", "pebble", "record", *options)) as console:
        assert console.sees("Recording ")
        with console.standing_still():
            assert until(lambda: events(root, "stop"), step=0.2)
        assert console.ends() == 0
        assert "`pebble recordings info" in console.shown
    broker.stop()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ((), "where to connect is missing"),
        (("--url", "mqtt://127.0.0.1", "--rotate", "soon"), '"soon" is not a duration: 30s, 10min, 1h or 7d'),
        (("--url", "mqtt://127.0.0.1", "--keep", "much"), '"much" is not a size: 64M, 2G or 1T'),
        (("--url", "mqtt://127.0.0.1", "--into", "/proc/x"), "/proc/x: No such file or directory: name another folder"),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], problem: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("record", *arguments) != 0
    assert problem in run.err
    assert len(run.err.strip().splitlines()) == 1


def test_a_robot_without_a_remote_broker_cannot_record_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "nice", lambda _: 0)
    section = {"enabled": True, "folder": str(tmp_path), "remote": True}
    config = parse({"services": {"recorder": section}, "robot": {"id": "goob"}}, folder=tmp_path, env={})
    running = Running(RobotRecorder(config, MemoryTransport("recorder", MemoryHub())))
    assert until(lambda: not running.alive)
    assert str(running.error) == "services.recorder.remote: needs services.mqtt_bridge.remote_mqtt.host"
