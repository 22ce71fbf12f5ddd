"""A broker judged as a whole: as docs/brokers.md says, and without anything left behind."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import pytest

from pebble.transports import MqttSettings
from pebble.transports.mqtt.transport import MqttTransport
from tests.commands.command_line import Run, running
from tests.commands.conftest import run as run
from tests.ext.checks.brokers.document import BROKERS, DOCUMENT, columns, judged, marks
from tests.support import Broker, further, until
from tests.transports.received import Received


@pytest.mark.alone  # mosquitto's own delays are measured
@pytest.mark.thorough
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.skipif(row.missing(), reason=f"needs {name}: make long PART=brokers"))
        for name, row in BROKERS.items()
    ],
)
def test_the_document_has_what_is_found(name: str) -> None:
    row, documented = BROKERS[name], columns(DOCUMENT.read_text())[name]
    found = marks(judged(row))
    assert found == {**documented, **{probe: found[probe] for probe in row.varies}}


@pytest.mark.parametrize(
    ("lines", "code", "words"),
    [
        further(["set_tcp_nodelay true"], 0, "robots can use it"),
        further([], 1, "robots can use it, with limits: small messages"),
        (["acl_file RULES"], 2, "robots cannot use it with this account: rights"),
    ],
)
def test_doctor_finds_whether_robots_can_use_a_broker(
    lines: list[str], code: int, words: str, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "rules").write_text("topic read #\n")
    broker = Broker(tmp_path, *(line.replace("RULES", str(tmp_path / "rules")) for line in lines))
    assert run("doctor", "--broker", f"mqtt://127.0.0.1:{broker.port}", "--json") == code, run.out
    broker.stop()
    assert json.loads(run.out)["assessment"][0] == words


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_what_it_retains_is_removed_when_it_is_interrupted(number: signal.Signals, broker: Broker) -> None:
    settings, seen = MqttSettings(host="127.0.0.1", port=broker.port, as_published=True), Received()

    def retained() -> dict[str, bytes]:
        newest = {one.topic: one.payload for one in [*seen.messages] if one.retain_requested}
        return {topic: payload for topic, payload in newest.items() if payload}

    with MqttTransport("watcher", settings) as watcher:
        watcher.subscribe("pebble/doctor/#", seen, echo=False)
        with running("doctor", "--broker", f"mqtt://127.0.0.1:{broker.port}", stdout=subprocess.DEVNULL) as process:
            assert until(lambda: len(retained()) > 50, 60)
            process.send_signal(number)
            assert process.wait(30) == 130
        assert until(lambda: retained() == {})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["doctor", "--broker", "mqtt://127.0.0.1:1"], "cannot be reached: Connection refused"),
        (["doctor", "--broker", "zenoh:/tmp"], "--broker must be mqtt://"),
        (["doctor", "--broker", "broker.lab"], "--broker must be mqtt://"),
        (["doctor", "--broker", "mqtt://ann:secret@broker.lab"], "--broker holds a password"),
        (["doctor", "--broker", "mqtt://broker.lab,spare.lab"], "--broker names one broker"),
        (["doctor", "--broker", "mqtt://127.0.0.1:PORT", "--below", "pebble/+"], "contains a wildcard"),
        (["doctor", "--broker", "mqtt://127.0.0.1:1", "robot.json"], "leave out the config file"),
    ],
)
def test_what_cannot_be_judged_is_one_clear_line(arguments: list[str], words: str, broker: Broker, run: Run) -> None:
    assert run(*(one.replace("PORT", str(broker.port)) for one in arguments), columns=200) != 0
    assert [words in line for line in (run.err or run.out).splitlines()][:1] == [True], run.out + run.err
